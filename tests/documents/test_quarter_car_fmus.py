"""The quarter car FMUs keep the laws that a master relies on.

Exact solutions come from the matrix exponential: each model is x' = A x + B u + c with a
polynomial input, so (x, u, u', u'', u''', 1) obeys one linear autonomous system.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import os
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy import fmi2
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from scipy.linalg import expm

MODELS = ("chassis", "wheel", "wheel_force", "chassis_force")
WARNING, DISCARD, ERROR = 1, 2, 3

# ---- The models, as mathematics -----------------------------------------------------------------

M_W, M_C, K_W, K_C, D_W, D_C, Z = 40.0, 400.0, 150000.0, 15000.0, 0.0, 1000.0, 0.1

# x' = A x + B u + c, shapes (2, 2), (2, n_u), (2,)
A_CHASSIS = np.array([[0, 1], [-K_C / M_C, -D_C / M_C]])
A_WHEEL = np.array([[0, 1], [-(K_W + K_C) / M_W, -(D_W + D_C) / M_W]])
B_WHEEL = np.array([[0, 0], [K_C / M_W, D_C / M_W]])
C_WHEEL = np.array([0, K_W * Z / M_W])
SYSTEMS = {
    "chassis": (A_CHASSIS, np.array([[0, 0], [K_C / M_C, D_C / M_C]]), np.zeros(2)),
    "wheel": (A_WHEEL, B_WHEEL, C_WHEEL),
    "wheel_force": (A_WHEEL, B_WHEEL, C_WHEEL),
    "chassis_force": (np.array([[0.0, 1], [0, 0]]), np.array([[0], [1 / M_C]]), np.zeros(2)),
}


def exact(model: str, x: np.ndarray, u: np.ndarray, time: float) -> np.ndarray:
    """The states, shape (2,), after ``time``; row j of ``u`` is the input's j-th derivative."""
    a, b, c = SYSTEMS[model]
    n_u = b.shape[1]
    system = np.zeros((3 + u.size, 3 + u.size))
    system[:2, :2], system[:2, 2 : 2 + n_u], system[:2, -1] = a, b, c
    system[2 : 2 + u.size - n_u, 2 + n_u : 2 + u.size] = np.eye(u.size - n_u)
    return np.asarray(expm(system * time) @ np.concatenate([x, u.ravel(), [1.0]]))[:2]


def polynomial_inputs(model: str, degree: int) -> np.ndarray:
    """Some input polynomial, shape (degree + 1, n_u), large enough to matter."""
    n_u = SYSTEMS[model][1].shape[1]
    rows = np.array([[0.05, 0.3], [-0.2, 0.7], [3.0, -4.0], [-20.0, 30.0]])[: degree + 1, :n_u]
    return rows * (K_C if model == "chassis_force" else 1.0)


# ---- The FMUs -----------------------------------------------------------------------------------


@dataclass
class Slave:
    """One instance, addressed by variable names. Like a strict master it checks every status."""

    fmu: Any
    variables: dict[str, Any]
    messages: list[str] = field(default_factory=list)

    def references(self, names: Sequence[str]) -> list[int]:
        return [self.variables[name].valueReference for name in names]

    @property
    def input_names(self) -> list[str]:
        return [name for name, v in self.variables.items() if v.causality == "input"]

    @property
    def output_names(self) -> list[str]:
        return [name for name, v in self.variables.items() if v.causality == "output"]

    def get(self, *names: str) -> np.ndarray:
        return np.array(self.fmu.getReal(self.references(names)))

    def set(self, **values: float) -> None:
        self.fmu.setReal(self.references(list(values)), list(values.values()))

    def set_inputs(self, u: np.ndarray) -> None:
        """Set values and derivatives; ``u`` has shape (order + 1, n_u)."""
        references = self.references(self.input_names)
        self.fmu.setReal(references, list(u[0]))
        for order in range(1, len(u)):
            orders = [order] * len(references)
            self.fmu.setRealInputDerivatives(references, orders, list(u[order]))

    def output_derivatives(self) -> np.ndarray:
        references = self.references(self.output_names)
        return np.array(self.fmu.getRealOutputDerivatives(references, [1] * len(references)))

    @property
    def time(self) -> float:
        return float(self.fmu.getRealStatus(fmi2.fmi2LastSuccessfulTime))

    def step(self, step_size: float) -> np.ndarray:
        """One do_step from where the slave stands; returns its states."""
        self.fmu.doStep(self.time, step_size)
        return self.get("x", "v")

    def initialize(
        self,
        tolerance: float | None = None,
        start_time: float = 0.0,
        stop_time: float | None = None,
        **start: float,
    ) -> Slave:
        self.set(**start)
        self.fmu.setupExperiment(tolerance=tolerance, startTime=start_time, stopTime=stop_time)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        return self


SlaveFactory = Callable[[str], Slave]


@pytest.fixture(scope="session")
def extracted(fmu_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The folders with the FMUs' contents, by model."""
    folder = tmp_path_factory.mktemp("extracted")
    return {
        model: Path(fmpy.extract(str(fmu_dir / f"{model}.fmu"), unzipdir=str(folder / model)))
        for model in MODELS
    }


@pytest.fixture(scope="session")
def descriptions(extracted: dict[str, Path]) -> dict[str, Any]:
    """The model descriptions, by model."""
    return {m: fmpy.read_model_description(str(folder)) for m, folder in extracted.items()}


@pytest.fixture
def slave(extracted: dict[str, Path], descriptions: dict[str, Any]) -> Iterator[SlaveFactory]:
    """``slave(model)`` instantiates an FMU; all are freed after the test."""
    slaves: list[Slave] = []

    def instantiate(model: str) -> Slave:
        description = descriptions[model]
        made = Slave(
            fmu=fmi2.FMU2Slave(
                guid=description.guid,
                unzipDirectory=str(extracted[model]),
                modelIdentifier=description.coSimulation.modelIdentifier,
                instanceName=f"{model}_{len(slaves)}",
            ),
            variables={v.name: v for v in description.modelVariables},
        )
        callbacks = fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(
            lambda _environment, _name, _status, _category, message: made.messages.append(
                message.decode()
            )
        )
        made.fmu.instantiate(callbacks=callbacks, loggingOn=True)
        slaves.append(made)
        return made

    yield instantiate
    for made in slaves:
        made.fmu.freeInstance()


def refusal(made: Slave, call: Callable[[], object]) -> tuple[int, str]:
    """The status of a call that must not succeed, and its message, which names the function."""
    before = len(made.messages)
    with pytest.raises(FMICallException) as caught:
        call()
    (message,) = made.messages[before:]
    assert message.startswith(f"{caught.value.function}: ")
    return caught.value.status, message


# ---- The files ----------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS)
def test_fmu_is_valid(fmu_dir: Path, model: str) -> None:
    """The archive and its model description keep the rules of FMI 2.0."""
    assert validate_fmu(str(fmu_dir / f"{model}.fmu")) == []


@pytest.mark.parametrize("model", MODELS)
def test_declared_feed_through(descriptions: dict[str, Any], model: str) -> None:
    """ModelStructure says which output jumps with which input: wheel_force.F, and no other."""
    fed_through = {
        (unknown.variable.name, known.name)
        for unknown in descriptions[model].outputs
        for known in unknown.dependencies
        if known.causality == "input"
    }
    assert fed_through == ({("F", "x_c"), ("F", "v_c")} if model == "wheel_force" else set())


@pytest.mark.slow
def test_build_is_reproducible(
    build_script: ModuleType, fmu_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Equal sources give equal bytes; FMUs that are up to date are left alone unless forced."""
    script = build_script
    fmus = script.build(tmp_path)
    contents = [fmu.read_bytes() for fmu in fmus]
    assert contents == [(fmu_dir / fmu.name).read_bytes() for fmu in fmus]

    stamps = [fmu.stat().st_mtime_ns for fmu in fmus]
    script.build(tmp_path)
    assert [fmu.stat().st_mtime_ns for fmu in fmus] == stamps

    os.utime(fmus[0], (0, 0))  # older than its sources
    fmus[1].write_bytes(b"PK, but not a zip")
    script.build(tmp_path)
    assert [fmu.read_bytes() for fmu in fmus] == contents
    assert [fmu.stat().st_mtime_ns for fmu in fmus[2:]] == stamps[2:]

    monkeypatch.setattr(script, "MODELS", (fmus[2].stem,))
    script.build(tmp_path, force=True)
    assert fmus[2].stat().st_mtime_ns > stamps[2]
    assert sorted(tmp_path.iterdir()) == sorted(fmus)  # nothing is left behind


def test_build_without_a_compiler_says_so(
    build_script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error names what to install, or the compiler that CC names in vain."""
    script = build_script
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(script.BuildError, match="install"):
        script.build(tmp_path)
    monkeypatch.setenv("CC", "no-such-compiler -m64")
    with pytest.raises(script.BuildError, match="no-such-compiler"):
        script.build(tmp_path)
    assert list(tmp_path.iterdir()) == []


# ---- Accuracy -----------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("model", MODELS)
def test_error_follows_the_tolerance(slave: SlaveFactory, model: str, degree: int) -> None:
    """With inputs of degree 0 to 3 the solution is exact up to the tolerance, 1e-4 to 1e-10.

    Over one long do_step, so that the integrator and not the caller chooses the micro steps.
    """
    u, time = polynomial_inputs(model, degree), 0.7
    start = np.array([0.02, -0.1])
    expected = exact(model, start, u, time)
    errors = []
    for tolerance in 10.0 ** -np.arange(4, 11):
        made = slave(model).initialize(tolerance, x=start[0], v=start[1])
        made.set_inputs(u)
        errors.append(np.max(np.abs(made.step(time) - expected) / (1.0 + np.abs(expected))))
        assert errors[-1] <= 5.0 * tolerance
    floor = 1e-13
    assert errors[-1] <= max(errors[0] / 1e4, floor)


@pytest.mark.parametrize("model", MODELS)
def test_inputs_are_expanded_anew_after_a_step(slave: SlaveFactory, model: str) -> None:
    """Inputs set once go on along their polynomial, over any number of steps."""
    u, start = polynomial_inputs(model, 3), np.array([0.02, -0.1])
    made = slave(model).initialize(1e-11, x=start[0], v=start[1])
    made.set_inputs(u)
    time = 0.0
    for step_size in (0.1, 0.01, 0.25, 0.003):
        time += step_size
        np.testing.assert_allclose(
            made.step(step_size), exact(model, start, u, time), rtol=1e-9, atol=1e-9
        )
        inputs = sum(u[j] * time**j / math.factorial(j) for j in range(4))
        np.testing.assert_allclose(made.get(*made.input_names), inputs, rtol=1e-13)


def test_setting_an_input_clears_its_derivatives_only(slave: SlaveFactory) -> None:
    """Setting a value makes that input a constant; the other input keeps its polynomial."""
    u = polynomial_inputs("chassis", 3)
    made = slave("chassis").initialize(1e-11)
    made.set_inputs(u)
    made.set(x_w=0.25)
    u[:, 0] = (0.25, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(made.step(0.2), exact("chassis", np.zeros(2), u, 0.2), rtol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_output_derivatives(slave: SlaveFactory, model: str) -> None:
    """Output derivatives are the slopes of the outputs, also where these contain u itself."""
    made = slave(model).initialize(1e-13, x=0.02, v=-0.1)
    made.set_inputs(polynomial_inputs(model, 3))
    made.step(0.1)
    h, y, dy = 1e-4, [], []
    for _ in range(5):
        y.append(made.get(*made.output_names))
        dy.append(made.output_derivatives())
        made.step(h)
    five_point_formula = (y[0] - 8 * y[1] + 8 * y[3] - y[4]) / (12 * h)
    np.testing.assert_allclose(dy[2], five_point_formula, rtol=1e-6)


def test_force_is_the_spring_and_damper_law(slave: SlaveFactory) -> None:
    """F follows its inputs at once, in initialization mode and between steps."""
    made = slave("wheel_force")
    made.fmu.setupExperiment()
    made.set(x=0.3, v=0.4)
    made.fmu.enterInitializationMode()
    made.set(x_c=0.1, v_c=-0.1)
    assert made.get("F")[0] == pytest.approx(K_C * 0.2 + D_C * 0.5)
    made.fmu.exitInitializationMode()
    made.set(x_c=0.3, v_c=0.4)
    assert made.get("F")[0] == 0.0


@pytest.mark.parametrize(
    ("models", "wires"),
    [
        (("chassis", "wheel"), {"x_w": "x", "v_w": "v", "x_c": "x", "v_c": "v"}),
        (("chassis_force", "wheel_force"), {"F": "F", "x_c": "x", "v_c": "v"}),
    ],
)
def test_coupled_slaves_converge_to_the_quarter_car(
    slave: SlaveFactory, models: tuple[str, str], wires: dict[str, str]
) -> None:
    """Both couplings, with constant extrapolation, approach the exact quarter car with order 1."""
    a = np.zeros((4, 4))  # chassis, wheel
    a[:2, :2], a[2:, 2:] = A_CHASSIS, A_WHEEL
    a[:2, 2:], a[2:, :2] = SYSTEMS["chassis"][1], B_WHEEL
    system = np.zeros((5, 5))
    system[:4, :4], system[2:4, 4] = a, C_WHEEL
    expected = (expm(system * 0.5) @ [0, 0, 0, 0, 1])[:4]

    errors = []
    for steps in (500, 1000, 2000):
        pair = [slave(model).initialize(1e-10) for model in models]
        for _ in range(steps):
            inputs = [
                {name: pair[1 - i].get(wires[name])[0] for name in made.input_names}
                for i, made in enumerate(pair)
            ]
            for made, values in zip(pair, inputs, strict=True):
                made.set(**values)
                made.step(0.5 / steps)
        states = np.concatenate([made.get("x", "v") for made in pair])
        errors.append(np.linalg.norm(states - expected))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 1.0, atol=0.1)


# ---- Time ---------------------------------------------------------------------------------------


def test_time_is_one_addition(slave: SlaveFactory) -> None:
    """After do_step(T, H) the slave stands at the double T + H, with T as the master says it."""
    made = slave("wheel").initialize()
    made.fmu.doStep(0.0, 0.1)
    made.fmu.doStep(0.1, 0.2)
    assert made.time == 0.1 + 0.2 != 0.3
    status, message = refusal(made, lambda: made.fmu.doStep(0.3, 0.1))  # one ulp beside it
    assert status == ERROR
    assert "stands at" in message
    assert made.time == 0.1 + 0.2


@pytest.mark.parametrize("point", [0.0, 0.1 + 1e-12, 0.1 - 1e-12, 0.2, math.nan, math.inf])
def test_wrong_communication_point_is_refused(slave: SlaveFactory, point: float) -> None:
    """A do_step from where the slave does not stand is an error, says so, and leaves no trace."""
    made, twin = (slave("wheel").initialize() for _ in range(2))
    made.step(0.1)
    twin.step(0.1)
    status, _ = refusal(made, lambda: made.fmu.doStep(point, 0.1))
    assert status == ERROR
    assert bits(made.step(0.1)) == bits(twin.step(0.1))


@pytest.mark.parametrize("step_size", [0.0, -0.1, math.nan, math.inf, 1e-30])
def test_step_that_does_not_advance_is_refused(slave: SlaveFactory, step_size: float) -> None:
    """A step size must move the time: positive, finite, and not lost in rounding."""
    made = slave("wheel").initialize(start_time=1.0)
    status, message = refusal(made, lambda: made.fmu.doStep(1.0, step_size))
    assert (status, made.time) == (ERROR, 1.0)
    assert "does not advance" in message


def test_no_step_leads_past_the_stop_time(slave: SlaveFactory) -> None:
    """Not even by rounding: 0.2 + 0.1 is beyond 0.3 by one unit in the last place."""
    made = slave("wheel").initialize(stop_time=0.3)
    for _ in range(2):
        made.step(0.1)
    status, message = refusal(made, lambda: made.step(0.1))
    assert status == ERROR
    assert "beyond the stop time" in message
    made.step(math.nextafter(0.1, 0.0))
    assert made.time == 0.3


def test_discard_tells_how_far_it_came(slave: SlaveFactory) -> None:
    """Beyond max_step a step is discarded; the slave stands, exactly, at the time that it tells."""
    u = polynomial_inputs("wheel_force", 3)
    made = slave("wheel_force").initialize(1e-10, max_step=0.02)
    short = slave("wheel_force").initialize(1e-10)
    saved = made.fmu.getFMUstate()
    for one in (made, short):
        one.set_inputs(u)

    status, _ = refusal(made, lambda: made.fmu.doStep(0.0, 0.05))
    assert status == DISCARD
    assert made.fmu.getStatus(fmi2.fmi2DoStepStatus) == DISCARD
    assert not made.fmu.getBooleanStatus(fmi2.fmi2Terminated)
    assert made.time == 0.02
    short.step(0.02)
    assert bits(made.get("x", "v", "F")) == bits(short.get("x", "v", "F"))
    assert refusal(made, lambda: made.fmu.doStep(0.02, 0.02))[0] == ERROR

    made.fmu.setFMUstate(saved)
    made.set_inputs(u)
    assert bits(made.step(0.02)) == bits(short.get("x", "v"))
    made.fmu.freeFMUstate(saved)


# ---- Saved states -------------------------------------------------------------------------------


def bits(values: np.ndarray) -> bytes:
    """Values to be compared bit for bit."""
    return values.tobytes()


def run(made: Slave, steps: int = 5) -> bytes:
    """All that can be seen of a slave over some steps with new inputs, bit for bit."""
    seen = []
    for i in range(steps):
        u = polynomial_inputs(made.fmu.modelIdentifier, 3) * math.cos(i)
        if i:  # the first step goes on with the inputs there are
            made.set_inputs(u)
        made.step(0.013 * (i + 1))
        seen += [made.get(*made.variables), made.output_derivatives(), np.array([made.time])]
    return bits(np.concatenate(seen))


def prepared(slave: SlaveFactory, model: str) -> Slave:
    """A slave in the middle of its life, with everything away from its default."""
    made = slave(model).initialize(1e-7, start_time=0.5, x=0.02, v=-0.1, m=55.0, max_step=0.3)
    made.set_inputs(polynomial_inputs(model, 3))
    made.step(0.037)
    return made


@pytest.mark.parametrize("model", MODELS)
def test_restored_state_repeats_bit_for_bit(slave: SlaveFactory, model: str) -> None:
    """Saving leaves no trace, and restoring does: as often as wanted, the same bits as without."""
    made, untouched = prepared(slave, model), prepared(slave, model)
    saved = made.fmu.getFMUstate()
    first = run(made)
    assert first == run(untouched)
    for _ in range(3):
        made.fmu.setFMUstate(saved)
        assert run(made) == first
    made.fmu.freeFMUstate(saved)
    assert not saved.value


@pytest.mark.parametrize("model", MODELS)
def test_serialized_state_continues_elsewhere(slave: SlaveFactory, model: str) -> None:
    """A serialized state, put into a new instance, goes on with the same bits."""
    made = prepared(slave, model)
    saved = made.fmu.getFMUstate()
    block = made.fmu.serializeFMUstate(saved)
    made.fmu.freeFMUstate(saved)

    other = slave(model)
    restored = other.fmu.deSerializeFMUstate(block)
    assert other.fmu.serializeFMUstate(restored) == block
    other.fmu.setFMUstate(restored)
    assert run(other) == run(made)
    other.fmu.freeFMUstate(restored)


def test_saving_into_a_used_state_reuses_it(slave: SlaveFactory) -> None:
    """A state handed in again is overwritten in its place."""
    made = prepared(slave, "wheel")
    saved = made.fmu.getFMUstate()
    place = saved.value
    made.step(0.01)
    made.fmu.fmi2GetFMUstate(made.fmu.component, ctypes.byref(saved))
    assert saved.value == place
    first = run(made)
    made.fmu.setFMUstate(saved)
    assert run(made) == first
    made.fmu.freeFMUstate(saved)


def damage(block: bytes, offset: int) -> bytes:
    """The block with one bit flipped."""
    return block[:offset] + bytes([block[offset] ^ 0x40]) + block[offset + 1 :]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda block: block[:-1], "bytes"),
        (lambda block: block + b"\0", "bytes"),
        (lambda _: b"", "bytes"),
        (lambda block: damage(block, 0), "not a saved state"),
        (lambda block: damage(block, 4), "version"),
        (lambda block: damage(block, 8), "bytes"),
        (lambda block: damage(block, 16), "model"),
        (lambda block: block[:-8] + struct.pack("i", 77) + block[-4:], "mode"),
    ],
)
def test_damaged_state_is_refused(
    slave: SlaveFactory, change: Callable[[bytes], bytes], reason: str
) -> None:
    """Bytes that are not a whole state of this model are refused with the reason."""
    made = prepared(slave, "wheel")
    saved = made.fmu.getFMUstate()
    block = change(made.fmu.serializeFMUstate(saved))
    status, message = refusal(made, lambda: made.fmu.deSerializeFMUstate(block))
    assert status == ERROR
    assert reason in message
    made.fmu.freeFMUstate(saved)


def test_state_of_another_model_is_refused(slave: SlaveFactory) -> None:
    """The message names both models."""
    made, other = prepared(slave, "wheel"), prepared(slave, "chassis")
    saved = made.fmu.getFMUstate()
    block = made.fmu.serializeFMUstate(saved)
    for call in (
        lambda: other.fmu.deSerializeFMUstate(block),
        lambda: other.fmu.setFMUstate(saved),
    ):
        status, message = refusal(other, call)
        assert status == ERROR
        assert "'wheel'" in message
        assert "'chassis'" in message
    made.fmu.freeFMUstate(saved)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc/self/statm")
def test_saved_states_do_not_leak(slave: SlaveFactory) -> None:
    """10 000 times saved, serialized, restored and freed: the process is as large as before."""
    made = prepared(slave, "wheel")

    def cycle(times: int) -> int:
        for _ in range(times):
            saved = made.fmu.getFMUstate()
            restored = made.fmu.deSerializeFMUstate(made.fmu.serializeFMUstate(saved))
            made.fmu.setFMUstate(restored)
            made.fmu.freeFMUstate(saved)
            made.fmu.freeFMUstate(restored)
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    before = cycle(1000)
    assert cycle(10_000) - before < 10_000 * 100  # one state has more than 200 bytes


# ---- Life cycle ---------------------------------------------------------------------------------


def drive_to(mode: str, made: Slave) -> None:
    """Bring a new instance into a mode."""
    if mode == "instantiated":
        made.fmu.setupExperiment()
        return
    if mode == "initialization":
        made.fmu.setupExperiment()
        made.fmu.enterInitializationMode()
        return
    made.initialize(max_step=0.5 if mode == "step failed" else 0.0)
    if mode == "step failed":
        refusal(made, lambda: made.fmu.doStep(0.0, 1.0))
    elif mode == "error":
        made.set(x_c=math.nan)
        refusal(made, lambda: made.fmu.doStep(0.0, 1.0))
    elif mode == "terminated":
        made.fmu.terminate()


MODES = ("instantiated", "initialization", "step complete", "step failed", "terminated", "error")
X_C, F = [0], [300]
SETTABLE = {"instantiated", "initialization", "step complete"}
READABLE = set(MODES) - {"instantiated"}
AFTER_STEPS = set(MODES) - {"instantiated", "initialization"}
CALLS: dict[str, tuple[set[str], Callable[[Any], object]]] = {
    "setupExperiment": ({"instantiated"}, lambda f: f.setupExperiment()),
    "enterInitializationMode": ({"instantiated"}, lambda f: f.enterInitializationMode()),
    "exitInitializationMode": ({"initialization"}, lambda f: f.exitInitializationMode()),
    "doStep": ({"step complete"}, lambda f: f.doStep(0.0, 0.1)),
    "cancelStep": (set(), lambda f: f.cancelStep()),
    "terminate": ({"step complete", "step failed"}, lambda f: f.terminate()),
    "reset": (set(MODES), lambda f: f.reset()),
    "setDebugLogging": (set(MODES), lambda f: f.setDebugLogging(True, ["logStatusError"])),
    "setReal": (SETTABLE, lambda f: f.setReal(X_C, [1.0])),
    "setReal of a parameter": (SETTABLE - {"step complete"}, lambda f: f.setReal([400], [1.0])),
    "setRealInputDerivatives": (SETTABLE, lambda f: f.setRealInputDerivatives(X_C, [1], [1.0])),
    "getReal": (READABLE, lambda f: f.getReal(F)),
    "getRealOutputDerivatives": (AFTER_STEPS, lambda f: f.getRealOutputDerivatives(F, [1])),
    "getRealStatus": (AFTER_STEPS, lambda f: f.getRealStatus(fmi2.fmi2LastSuccessfulTime)),
    "getFMUstate": (set(MODES) - {"error"}, lambda f: f.freeFMUstate(f.getFMUstate())),
}


@pytest.mark.parametrize(("mode", "call"), list(itertools.product(MODES, CALLS)))
def test_calls_are_allowed_only_in_their_modes(slave: SlaveFactory, mode: str, call: str) -> None:
    """Every call in every mode: done, or refused with a message that names both."""
    made = slave("wheel_force")
    drive_to(mode, made)
    allowed, action = CALLS[call]
    if mode in allowed:
        action(made.fmu)
        return
    status, message = refusal(made, lambda: action(made.fmu))
    assert status == ERROR
    assert mode in message or call == "setReal of a parameter"


def test_initialization_needs_an_experiment(slave: SlaveFactory) -> None:
    """Without fmi2SetupExperiment there is no start time."""
    made = slave("wheel")
    assert refusal(made, made.fmu.enterInitializationMode)[0] == ERROR


@pytest.mark.parametrize("tolerance", [0.0, -1e-6, 1.0, math.nan])
def test_senseless_tolerance_is_refused(slave: SlaveFactory, tolerance: float) -> None:
    """A tolerance lies between 0 and 1."""
    made = slave("wheel")
    assert refusal(made, lambda: made.fmu.setupExperiment(tolerance=tolerance))[0] == ERROR


def test_tolerance_out_of_reach_is_a_warning(slave: SlaveFactory) -> None:
    """A tolerance below rounding is replaced by the smallest that works, and the slave says so."""
    made = slave("wheel")
    assert made.fmu.setupExperiment(tolerance=1e-18) == WARNING
    assert "out of reach" in made.messages[-1]
    made.fmu.enterInitializationMode()
    made.fmu.exitInitializationMode()
    expected = exact("wheel", np.zeros(2), np.zeros((1, 2)), 0.1)
    np.testing.assert_allclose(made.step(0.1), expected, rtol=1e-11)


@pytest.mark.parametrize(
    "fault", [{"x_c": math.nan}, {"v_c": math.inf}, {"m": 0.0}, {"x": math.nan}]
)
def test_failed_step_is_an_error_that_can_be_undone(
    slave: SlaveFactory, fault: dict[str, float]
) -> None:
    """Infinite values end in an error with a reason, not in NaN; a saved state leads back."""
    made = slave("wheel")
    made.fmu.setupExperiment()
    made.fmu.enterInitializationMode()
    made.fmu.exitInitializationMode()
    saved = made.fmu.getFMUstate()
    good = run(made)

    made.fmu.reset()
    made.initialize(**fault)
    status, message = refusal(made, lambda: made.fmu.doStep(0.0, 0.1))
    assert status == ERROR
    assert "underflow" in message
    made.fmu.setFMUstate(saved)
    assert run(made) == good
    made.fmu.freeFMUstate(saved)


def test_reset_is_as_good_as_new(slave: SlaveFactory) -> None:
    """After fmi2Reset nothing is left of the life before, parameters included."""
    made = prepared(slave, "wheel")
    run(made)
    made.fmu.reset()
    assert run(made.initialize()) == run(slave("wheel").initialize())


def test_refused_values_change_nothing(slave: SlaveFactory) -> None:
    """One wrong entry in a list, and none of the list is taken."""
    made, twin = (slave("wheel").initialize() for _ in range(2))
    fmu = made.fmu
    for call in (
        lambda: fmu.setReal([0, 99], [1.0, 1.0]),
        lambda: fmu.setReal([0, 200], [1.0, 1.0]),
        lambda: fmu.setReal([0, 100], [1.0, 1.0]),
        lambda: fmu.setRealInputDerivatives([0, 0], [1, 4], [1.0, 1.0]),
        lambda: fmu.setRealInputDerivatives([0, 0], [1, 0], [1.0, 1.0]),
        lambda: fmu.setRealInputDerivatives([0, 100], [1, 1], [1.0, 1.0]),
        lambda: fmu.getReal([1000]),
        lambda: fmu.getRealOutputDerivatives([100], [2]),
        lambda: fmu.getRealOutputDerivatives([0], [1]),
        lambda: fmu.getInteger([0]),
        lambda: fmu.setString([0], ["a"]),
        lambda: fmu.fmi2GetReal(fmu.component, None, 1, None),
        lambda: fmu.fmi2SetReal(fmu.component, None, 1, None),
        lambda: fmu.fmi2GetFMUstate(fmu.component, None),
        lambda: fmu.setFMUstate(None),
        lambda: fmu.setDebugLogging(True, ["no such category"]),
    ):
        assert refusal(made, call)[0] == ERROR
    assert run(made) == run(twin)


def test_message_survives_percent_signs(slave: SlaveFactory) -> None:
    """The logger gets a format: what is a command in it arrives doubled, as text."""
    made = slave("wheel")
    refusal(made, lambda: made.fmu.setDebugLogging(True, ["100 %s #r1#"]))
    assert made.messages[-1].endswith("'100 %%s ##r1##'")


def test_wrong_guid_is_refused(extracted: dict[str, Path]) -> None:
    """A description that does not belong to the binary gives no instance."""
    fmu = fmi2.FMU2Slave(
        guid="{0}",
        unzipDirectory=str(extracted["wheel"]),
        modelIdentifier="wheel",
        instanceName="wheel",
    )
    messages: list[str] = []
    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda *args: messages.append(args[4].decode()))
    with pytest.raises(Exception, match="instantiate"):
        fmu.instantiate(callbacks=callbacks)
    assert "guid" in messages[0]
    fmu.freeLibrary()


def test_instances_are_independent(slave: SlaveFactory) -> None:
    """Instances in one process, of one model and of several, do not see each other."""
    alone = {model: run(prepared(slave, model)) for model in MODELS}
    mixed = [prepared(slave, model) for model in (*MODELS, *MODELS)]
    for made in mixed[: len(MODELS)]:
        slave(made.fmu.modelIdentifier).initialize(1e-3, m=1000.0).step(0.5)
    assert [run(made) for made in mixed] == [alone[m] for m in (*MODELS, *MODELS)]
