"""FMUs in Python, as PythonFMU and PythonFMU3 make them: real ones, built with the packages.

Their code runs in the interpreter of the process that loads them, which is one of ours.
"""

from __future__ import annotations

import math
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import protocol
from master_node import Result, load_system, simulate
from protocol.calls import Initialize, StepResult, StepStatus
from protocol.description import StateVerdict
from protocol.errors import FatalSlaveError, ModelError
from protocol.slave import Slave
from slave_node.loading import describe_model, load_slave
from tests.support.quarter_car_case import global_errors
from tests.support.trial_slaves import examine
from tests.support.waiting import BOUND

pytest.importorskip("pythonfmu")
pytest.importorskip("pythonfmu3")

Load = Callable[..., Slave]

LAG = '''
from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

GAIN = 1.0


class Lag(Fmi2Slave):
    """T y' = gain u - y by one Euler step; it fails, or takes no step, from a time on."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.modelName = "protocol"
        self.u = self.y = 0.0
        self.fails_at = self.discards_at = 1e9
        self.has_memory = False
        self._memory = 0.0
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("y", causality=Fmi2Causality.output))
        for name in ("fails_at", "discards_at"):
            self.register_variable(
                Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed)
            )
        self.register_variable(
            Boolean(
                "has_memory",
                causality=Fmi2Causality.parameter,
                variability=Fmi2Variability.fixed,
            )
        )

    def do_step(self, current_time, step_size):
        if current_time >= self.fails_at:
            raise ArithmeticError("the lag is overrun")
        if current_time >= self.discards_at:
            return False
        self._memory += step_size
        self.y += step_size * (GAIN * self.u - self.y + self.has_memory * self._memory)
        return True
'''
"""Its module has the name of a package of Doublestep."""


@pytest.fixture(scope="module")
def lag(python_fmu_build: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The FMU of ``LAG``, which declares saved states."""
    folder = tmp_path_factory.mktemp("lag")
    script = folder / "protocol.py"
    script.write_text(LAG, encoding="utf-8")
    fmu: Path = python_fmu_build.build_model(script, folder, "pythonfmu", "--handle-state")
    return fmu


def edited(fmu: Path, target: Path, old: str, new: str) -> Path:
    """A copy of an FMU in the file ``target``, with another text in its script."""
    with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(target, "w") as copy:
        for entry in source.infolist():
            data = source.read(entry)
            if entry.filename == f"resources/{fmu.stem}.py":
                assert old.encode() in data
                data = data.replace(old.encode(), new.encode())
            copy.writestr(entry, data)
    return target


@pytest.fixture
def load(tmp_path: Path) -> Iterator[Load]:
    """``load(fmu, x=1.0, ...)``: a slave in this process in step mode; closed after the test."""
    slaves: list[Slave] = []

    def load_fmu(
        fmu: Path,
        inputs: Sequence[str] = ("u",),
        outputs: Sequence[str] = ("y",),
        **start_values: float,
    ) -> Slave:
        scratch = tmp_path / f"slave {len(slaves)}"
        scratch.mkdir()
        slaves.append(load_slave(fmu.name, fmu.parent, "lag", scratch))
        slaves[-1].initialize(
            Initialize(
                start_time=0.0,
                stop_time=None,
                relative_tolerance=None,
                start_values=start_values,
                inputs=inputs,
                outputs=outputs,
            )
        )
        slaves[-1].set_inputs(np.ones((1, len(inputs))))
        slaves[-1].exit_initialization_mode()
        return slaves[-1]

    yield load_fmu
    for slave in slaves:
        slave.close()


# ---- The example --------------------------------------------------------------------------------


def test_the_descriptions_say_what_the_scripts_say(python_fmu_dir: Path) -> None:
    """Both versions of FMI, states as they were asked for, and where the code will run."""
    wheel, chassis = (describe_model(f"{n}.fmu", python_fmu_dir) for n in ("wheel", "chassis"))
    assert wheel.kind == "FMI 2.0 co-simulation"
    assert chassis.kind == "FMI 3.0 co-simulation"
    assert (wheel.state_kind, chassis.state_kind) == ("native", "fork")
    assert wheel.variable("z").start == 0.1
    assert chassis.variable("v").unit == "m/s"
    for described in (wheel, chassis):
        assert described.input_derivatives == "emulated"
        (remark,) = described.remarks
        assert remark == "its Python code runs in the Python of this slave-node"


@pytest.mark.usefixtures("no_process_left")
def test_the_quarter_car_in_python_is_the_quarter_car(python_fmu_dir: Path, tmp_path: Path) -> None:
    """Over Zenoh within the tolerance of the exact solution, and the same bits in this process,
    where both FMUs share an interpreter and the names of their modules.
    """
    file = python_fmu_dir / "quarter_car.toml"
    far = simulate(load_system(file), stop_time=0.5, output=tmp_path / "far")
    assert far.summary["state_kind"] == {"chassis": "fork", "wheel": "native"}
    summary = Result.load(tmp_path / "far").summary
    assert summary["settings"]["examinations"]["wheel"]["state_verdict"] == "exact"
    assert global_errors(far).max() < 1e-3
    near = simulate(load_system(file), stop_time=0.5, in_process=True, output=tmp_path / "near")
    assert near.outputs.tobytes() == far.outputs.tobytes()


def test_without_the_package_the_build_says_what_to_install(
    python_fmu_build: ModuleType, tmp_path: Path
) -> None:
    """Not a traceback."""
    script = python_fmu_build.FOLDER / "wheel.py"
    with pytest.raises(python_fmu_build.BuildError, match="No module named doublestep_absent"):
        python_fmu_build.build_model(script, tmp_path, "doublestep_absent")


DECAY = """
from pythonfmu3 import (
    Float64, Fmi3Causality, Fmi3Initial, Fmi3SlaveBase, Fmi3Variability, ModelExchange
)


class Decay(Fmi3SlaveBase, ModelExchange):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.modelName = "decay"
        self.time, self.x, self.slope = 0.0, 1.0, 0.0
        for name, causality, how in (
            ("time", Fmi3Causality.independent, {}),
            ("x", Fmi3Causality.output, {"start": 1.0, "initial": Fmi3Initial.exact}),
            ("slope", Fmi3Causality.local, {"derivative": 1}),
        ):
            variability = Fmi3Variability.continuous
            self.register_variable(
                Float64(name, causality=causality, variability=variability, **how)
            )

    def get_continuous_state_derivatives(self):
        self.slope = -self.x
        return [self.slope]
"""


def test_model_exchange_in_python_is_integrated(
    python_fmu_build: ModuleType, tmp_path: Path, load: Load
) -> None:
    """CVode integrates x' = -x, and the state comes back to the bit."""
    script = tmp_path / "decay.py"
    script.write_text(DECAY, encoding="utf-8")
    slave = load(python_fmu_build.build_model(script, tmp_path, "pythonfmu3"), (), ("x",))
    assert slave.description.kind == "FMI 3.0 model exchange"
    assert examine(slave, 0.0, 0.1).state_verdict is StateVerdict.EXACT
    slave.do_step(0.0, 1.0, False)
    assert slave.get_outputs(0)[0, 0] == pytest.approx(math.exp(-1.0), rel=1e-5)


# ---- One interpreter ----------------------------------------------------------------------------


def test_modules_of_one_name_are_kept_apart(load: Load, lag: Path, tmp_path: Path) -> None:
    """Two FMUs whose module is called like one of Doublestep's: each runs its own code, and all
    names are given back.
    """
    twin = edited(lag, tmp_path / "twin.fmu", "GAIN = 1.0", "GAIN = 3.0")
    before = set(sys.modules), list(sys.path)
    slaves = [load(lag), load(twin), load(lag)]
    assert sys.modules["protocol"] is protocol
    for slave in slaves:
        slave.set_inputs(np.array([[1.0]]))
        slave.do_step(0.0, 0.1, False)
    values = [slave.get_outputs(0)[0, 0] for slave in slaves]
    assert values == pytest.approx([0.1, 0.3, 0.1])
    for slave in slaves:
        slave.close()
    assert sys.path == before[1]
    left = {name for name in sys.modules if name.partition(".")[0] == "pythonfmu"}
    assert left <= before[0]
    assert sys.modules["protocol"] is protocol


@pytest.mark.parametrize(
    ("line", "cause", "remedy"),
    [
        ("import doublestep_absent", "No module named 'doublestep_absent'", "install doublestep_a"),
        ("import pythonfmu.absent", "No module named 'pythonfmu.absent'", ""),
        ("1 / 0", "ZeroDivisionError: division by zero", ""),
        ("raise SystemExit(3)", "SystemExit: 3", ""),
        ("def", "SyntaxError: ", ""),
    ],
)
def test_a_script_that_cannot_be_imported_says_why(
    lag: Path, tmp_path: Path, line: str, cause: str, remedy: str
) -> None:
    """The binary would go on without a module, and end the process by SIGSEGV."""
    broken = edited(lag, tmp_path / "broken.fmu", "GAIN = 1.0", line)
    path = list(sys.path)
    with pytest.raises(ModelError) as caught:
        load_slave(broken.name, tmp_path, "broken", tmp_path)
    assert "broken.fmu: its Python module 'protocol' cannot be imported: " in caught.value.cause
    assert cause in caught.value.cause
    assert caught.value.remedy.startswith(remedy)
    assert bool(caught.value.remedy) == bool(remedy)
    assert sys.path == path
    assert sys.modules["protocol"] is protocol


def test_a_model_that_cannot_be_made_says_why(lag: Path, tmp_path: Path) -> None:
    """An exception in its constructor comes with the log of the FMU."""
    broken = edited(lag, tmp_path / "broken.fmu", "self._memory = 0.0", 'raise OSError("no road")')
    with pytest.raises(ModelError, match="no road"):
        load_slave(broken.name, tmp_path, "broken", tmp_path)


# ---- Steps and states ---------------------------------------------------------------------------


def test_an_exception_in_a_step_is_told(load: Load, lag: Path) -> None:
    """PythonFMU calls it fatal."""
    slave = load(lag, fails_at=0.1)
    slave.do_step(0.0, 0.1, False)
    with pytest.raises(FatalSlaveError, match=r"ArithmeticError.*the lag is overrun"):
        slave.do_step(0.1, 0.1, False)


def test_a_step_that_is_not_taken(
    load: Load, lag: Path, python_fmu_dir: Path, tmp_path: Path
) -> None:
    """``return False`` is fmi2Discard and fmi2Terminated of PythonFMU, fmi3Discard of PythonFMU3:
    the one ends the simulation, the other asks for a smaller step.
    """
    slave = load(lag, discards_at=0.1)
    assert slave.do_step(0.0, 0.1, False).status is StepStatus.OK
    assert slave.do_step(0.1, 0.1, False) == StepResult(StepStatus.TERMINATED, 0.1)
    chassis = python_fmu_dir / "chassis.fmu"
    never = edited(chassis, tmp_path / "never.fmu", "return True", "return False")
    slave = load(never, inputs=("x_w",), outputs=("x",))
    assert slave.do_step(0.0, 0.1, False) == StepResult(StepStatus.DISCARD, 0.0)


@pytest.mark.parametrize(
    ("has_memory", "verdict"), [(False, StateVerdict.EXACT), (True, StateVerdict.DOES_NOT_REPEAT)]
)
def test_attributes_that_are_no_variables_are_not_saved(
    load: Load, lag: Path, has_memory: bool, verdict: StateVerdict
) -> None:
    """PythonFMU saves the values of variables. Trial steps tell whether that is all there is."""
    slave = load(lag, has_memory=has_memory)
    assert examine(slave, 0.0, 0.01).state_verdict is verdict


def test_a_model_in_python_can_be_validated(lag: Path) -> None:
    """In a process of its own, down to its end."""
    command = [sys.executable, "-m", "slave_node", "validate", str(lag)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=BOUND, check=False)
    assert run.returncode == 0, run.stderr
