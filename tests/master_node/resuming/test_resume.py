"""A run that was broken off goes on where it stood: its files end up the same, byte for byte."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from typing_extensions import TypeAliasType

from master_node import Result, System, load_system, open_system, resume, simulate
from master_node.coupling.outputs import Outputs
from master_node.methods.position import Position
from master_node.numerics.discontinuities import Search, SmoothStep
from master_node.numerics.extrapolation import CouplingHistory, InputPolynomial
from master_node.numerics.order_control import OrderMemory
from master_node.results.files import cannot_write
from master_node.resuming.json_values import from_plain, to_plain
from protocol.errors import ConfigurationError, InterruptedRunError, ResultsError
from tests.faults.test_processes import (
    MainCommand,
    Start,
    command,
    has_stepped,
    slave_processes,
    start,
    system_file,
    worker_of,
)
from tests.support.interrupting import Interrupt
from tests.support.places import SUPPORT
from tests.support.quarter_car_case import EXAMPLES
from tests.support.slow import quick_at
from tests.support.waiting import wait_until

__all__ = ["command", "start"]

pytestmark = pytest.mark.usefixtures("no_process_left")

TRAPPED = f"{SUPPORT / 'trap_models.py'}:Trapped"


def car(folder: Path, simulation: str, results: str = "", **models: Any) -> System:
    """The quarter car with these settings."""
    folder.mkdir(parents=True, exist_ok=True)
    file = system_file(folder, simulation=simulation, **models)
    with file.open("a") as text:
        text.write(f"[results]\n{results}")
    return load_system(file)


def contents(folder: Path) -> dict[str, bytes]:
    """The files with rows."""
    return {name: (folder / name).read_bytes() for name in ("results.csv", "steps.csv")}


def interrupted(system: System, folder: Path, *numbers: int) -> None:
    """Begin a run, break it off after so many attempts each, and bring it to its end."""
    first, *rest = numbers
    with pytest.raises(InterruptedRunError):
        simulate(system, output=folder, in_process=True, observers=(Interrupt(first),))
    for number in rest:
        with pytest.raises(InterruptedRunError):
            resume(folder, observers=(Interrupt(number),))
    resume(folder)


COUNTERS = (
    "communication_steps",
    "rejected_double_steps",
    "discontinuities",
    "outcome",
    "settings",
)
JUMP = "stop_time = 1.0\nevents = [0.5]\n"


@pytest.mark.parametrize(
    ("simulation", "numbers"),
    [
        ("stop_time = 1.0\n", (3, 5, 20)),
        ("stop_time = 1.0\nestimator = 'rich'\nrelative_tolerance = 1e-6\n", (1, 20, 17)),
        ("stop_time = 1.0\nsequence = 'gauss-seidel'\norder = 2\n", (12, 13)),
        (JUMP, (15, 6)),
        (JUMP + "output_interval = 0.013\n", (15, 6)),
        ("stop_time = 0.2\nestimator = 'none'\noutput_interval = 0.013\n", (50, 100)),
        ("stop_time = 1.0\npreset = 'paper'\nderivative_points = 0\n", (9, 9)),
        ("stop_time = 0.2\ncheckpoint_interval = 1e-6\nlargest_step_size = 1e-3\n", (60, 30)),
    ],
)
@pytest.mark.parametrize("every", quick_at([1], [1, 3]))
def test_an_interrupted_run_goes_on_to_the_same_bits(
    simulation: str, numbers: tuple[int, ...], every: int, tmp_path: Path
) -> None:
    """Law: history, controller, order, brackets, grids and counters go on as if nothing was."""
    system = car(tmp_path, simulation, f"every = {every}\n")
    simulate(system, output=tmp_path / "whole", in_process=True)
    whole = Result.load(tmp_path / "whole")
    assert len(whole.steps) > sum(numbers)
    interrupted(system, tmp_path / "parts", *numbers)
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    summary = Result.load(tmp_path / "parts").summary
    for name in COUNTERS:
        assert summary[name] == whole.summary[name]
    assert not (tmp_path / "parts" / "checkpoint").exists()


@pytest.mark.parametrize("which", quick_at(["wheel"], ["wheel", "both"]))
def test_slaves_without_rollback(which: str, tmp_path: Path, capability_dir: Path) -> None:
    """Slaves that cannot be saved are replayed from T_0, in mixed runs and all together."""
    names = {"wheel": ("wheel",), "both": ("chassis", "wheel")}[which]
    models = {name: capability_dir / f"{name}_no_state.fmu" for name in names}
    system = car(tmp_path, "stop_time = 0.5\n", **models)
    whole = simulate(system, output=tmp_path / "whole", in_process=True)
    attempts = len(whole.steps)
    assert attempts > 12
    interrupted(system, tmp_path / "parts", attempts // 3, attempts // 4)
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


def test_all_formats(tmp_path: Path) -> None:
    """Arrow, Parquet and MAT of a resumed run hold the same rows; nothing else is left."""
    system = car(tmp_path, JUMP, "formats = ['csv', 'arrow', 'parquet', 'mat']\n")
    simulate(system, output=tmp_path / "whole", in_process=True)
    interrupted(system, tmp_path / "parts", 12, 5)
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    for suffix in ("arrow", "parquet", "mat"):
        a = Result.load(tmp_path / "whole" / f"results.{suffix}")
        b = Result.load(tmp_path / "parts" / f"results.{suffix}")
        assert a.time.tobytes() == b.time.tobytes()
        assert a.outputs.tobytes() == b.outputs.tobytes()
    names = [{p.name for p in (tmp_path / name).iterdir()} for name in ("whole", "parts")]
    assert names[0] == names[1]


def test_parquet_alone(tmp_path: Path) -> None:
    """The stream from which it is made outlives the interruption, and not the end."""
    system = car(tmp_path, "stop_time = 0.3\n", "formats = ['parquet']\n")
    whole = simulate(system, in_process=True)
    interrupted(system, tmp_path / "parts", 4, 3)
    result = Result.load(tmp_path / "parts")
    assert result.outputs.tobytes() == whole.outputs.tobytes()
    files = {path.name for path in (tmp_path / "parts").iterdir()}
    assert files == {"results.parquet", "steps.csv", "summary.json"}


OUTER = """<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription version="1.0" name="outer"
  xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription">
  <ssd:System name="outer"><ssd:Elements>
    <ssd:Component name="car" type="application/x-ssp-package" source="inner.ssp"/>
  </ssd:Elements></ssd:System>
</ssd:SystemStructureDescription>
"""


@pytest.mark.parametrize("kind", ["a package", "a description that names a package"])
@pytest.mark.parametrize(
    "when", quick_at(["behind a checkpoint"], ["behind a checkpoint", "before the first one"])
)
def test_what_was_unpacked_is_unpacked_again(
    kind: str, when: str, tmp_path: Path, quarter_car_ssp: Path
) -> None:
    """The folder of the first time is gone; the models are found in that of the second time."""
    shutil.copy(quarter_car_ssp, tmp_path / "inner.ssp")
    (tmp_path / "outer.ssd").write_text(OUTER)
    path = tmp_path / ("inner.ssp" if kind == "a package" else "outer.ssd")

    def run(out: str, *observers: Interrupt) -> None:
        with open_system(path) as opened:
            system = opened.with_simulation(stop_time=0.3)
            simulate(system, output=tmp_path / out, in_process=True, observers=observers)

    run("whole")
    with pytest.raises(InterruptedRunError):
        run("parts", Interrupt(6))
    if when == "before the first one":
        (tmp_path / "parts" / "checkpoint" / "run.zip").unlink()
    with pytest.raises(InterruptedRunError):
        resume(tmp_path / "parts", observers=(Interrupt(2),))
    resume(tmp_path / "parts")
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


# ---- The end ------------------------------------------------------------------------------------


class Untold:
    """An observer of a run that takes no step."""

    def started(self, _: object) -> None:
        """Never."""
        raise AssertionError("the run was done again")

    attempted = ended = started


KILLED = """
import os, signal, sys
from master_node import load_system, simulate
from importlib import import_module
module, name = sys.argv[1].split()
setattr(import_module(module), name, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
simulate(load_system(sys.argv[2]), output=sys.argv[3], in_process=True)
"""


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def _disk_full(path: Path, *_: object) -> None:
    raise cannot_write(path, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))


@pytest.mark.parametrize("what", ["parquet_file write_parquet", "dymola_mat write_mat"])
@pytest.mark.parametrize("interval", quick_at([60], [60, 0]))
@pytest.mark.parametrize("accident", ["kill", "Ctrl-C", "full disk"])
def test_results_that_were_not_completed(
    what: str, interval: int, accident: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Broken off while Parquet or MAT is made: resume makes them, and takes no step again.

    Until then all rows can be read, and nothing says that the run is complete.
    """
    module, name = f"master_node.results.{what}".split()
    settings = f"stop_time = 0.3\ncheckpoint_interval = {interval}\n"
    system = car(tmp_path, settings, "formats = ['csv', 'parquet', 'mat']\n")
    out = tmp_path / "out"
    simulate(system, output=tmp_path / "whole", in_process=True)
    if accident == "kill":
        words = [
            sys.executable,
            "-c",
            KILLED,
            f"{module} {name}",
            str(tmp_path / "car.toml"),
            str(out),
        ]
        assert subprocess.run(words, timeout=60, check=False).returncode == -signal.SIGKILL
        assert Result.load(out).summary == {}
    else:
        error, words = (
            (InterruptedRunError, "while the results were completed; all rows are there")
            if accident == "Ctrl-C"
            else (ResultsError, "No space left on device; free space")
        )
        with monkeypatch.context() as patch:
            accident_of = _interrupt if accident == "Ctrl-C" else _disk_full
            patch.setattr(f"{module}.{name}", accident_of)
            remedy = f"`master-node resume {out}` completes them$"
            with pytest.raises(error, match=f"{words}.*; (then )?{remedy}"):
                simulate(system, output=out, in_process=True)
            outcome = Result.load(out).summary.get("outcome")
            assert outcome == (None if accident == "Ctrl-C" else "failed")
    assert contents(out) == contents(tmp_path / "whole")
    resume(out, observers=(Untold(),))
    assert_complete(out, tmp_path / "whole")


def assert_complete(out: Path, whole: Path) -> None:
    """Asserts that two directories hold equal files with equal content."""
    assert {p.name for p in out.iterdir()} == {p.name for p in whole.iterdir()}
    names = [p.name for p in whole.iterdir() if p.suffix in (".csv", ".parquet", ".mat")]
    assert {name: (out / name).read_bytes() for name in names} == {
        name: (whole / name).read_bytes() for name in names
    }
    assert Result.load(out).summary["outcome"] == "completed"


@pytest.mark.slow
def test_a_master_that_is_killed_at_its_very_end(tmp_path: Path) -> None:
    """Results are complete before the checkpoint goes; resume only removes it then."""
    out = broken_off(tmp_path)
    shutil.copytree(out / "checkpoint", tmp_path / "checkpoint")
    resume(out)
    files = {path.name: path.read_bytes() for path in out.iterdir()}
    shutil.copytree(tmp_path / "checkpoint", out / "checkpoint")
    resume(out, observers=(Untold(),))
    assert {path.name: path.read_bytes() for path in out.iterdir()} == files


@pytest.mark.parametrize("interval", [60.0, 0.05])
@pytest.mark.slow
def test_a_disk_that_is_full_for_the_last_rows(interval: float, tmp_path: Path) -> None:
    """The run has failed, and its rows are whole; with room it goes on to the same bytes."""
    settings = f"stop_time = 2.0\nlargest_step_size = 1e-3\ncheckpoint_interval = {interval}\n"
    system = car(tmp_path, settings)
    out = tmp_path / "out"
    simulate(system, output=tmp_path / "whole", in_process=True)
    limit = (tmp_path / "whole" / "results.csv").stat().st_size - 10
    code = (
        f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}));"
        "from master_node import load_system, simulate;"
        f"simulate(load_system({str(tmp_path / 'car.toml')!r}), output={str(out)!r},"
        " in_process=True)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert "ResultsError: cannot write" in done.stderr
    assert Result.load(out).summary["outcome"] == "failed"
    resume(out)
    assert contents(out) == contents(tmp_path / "whole")
    assert not (out / "checkpoint").exists()


def test_a_run_that_was_broken_off_before_its_first_checkpoint(tmp_path: Path) -> None:
    """Not even the place of T_0 was written: it begins anew, to the same bits."""
    system = car(tmp_path, "stop_time = 0.3\n")
    simulate(system, output=tmp_path / "whole", in_process=True)
    out = broken_off(tmp_path)
    (out / "checkpoint" / "run.zip").unlink()
    with pytest.raises(InterruptedRunError, match="interrupted at t="):
        resume(out, observers=(Interrupt(5),))
    resume(out)
    assert contents(out) == contents(tmp_path / "whole")


def test_ctrl_c_before_a_resumed_run_has_begun(tmp_path: Path) -> None:
    """The checkpoint from which it would have gone on stays."""
    out = broken_off(tmp_path)
    observer = Interrupt(1)
    observer.started = _interrupt  # type: ignore[method-assign]
    with pytest.raises(InterruptedRunError, match="before the next step"):
        resume(out, observers=(observer,))
    resume(out)
    assert Result.load(out).summary["outcome"] == "completed"


# ---- Real processes -----------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="uses signals and /proc")
@pytest.mark.parametrize("accident", quick_at(["kill master"], ["kill master", "interrupt master"]))
def test_a_master_that_is_killed(
    accident: str, start: Start, command: MainCommand, tmp_path: Path
) -> None:
    """SIGKILL and Ctrl-C in mid step: slaves end with it, results are readable, resume goes on."""
    settings = "stop_time = 0.5\nlargest_step_size = 1e-3\ncheckpoint_interval = 0.1\n"
    whole = car(tmp_path / "whole", settings)
    simulate(whole, output=tmp_path / "whole" / "out", in_process=True)
    out = tmp_path / "out"
    file = system_file(
        tmp_path,
        TRAPPED,
        simulation=settings,
        chassis_parameters={"traps": f"0.31 {accident}", "folder": tmp_path},
    )
    master = start("master_node", "run", file, "--no-plot", "--output", out)
    assert master.wait() == (-signal.SIGKILL if accident == "kill master" else 130), master.text
    before = Result.load(out)
    assert len(before.time) > 1
    assert before.time[-1] < 0.32
    code, text = command("resume", out, "--no-plot")
    assert code == 0, text
    assert contents(out) == contents(tmp_path / "whole" / "out")
    assert not (out / "checkpoint").exists()
    code, text = command("resume", out, "--no-plot")
    assert code == 0
    assert "is complete: there is nothing to go on with" in text


@pytest.mark.skipif(os.name != "posix", reason="uses signals")
@pytest.mark.slow
def test_fmus_and_a_ctrl_c_in_mid_run(start: Start, tmp_path: Path, fmu_dir: Path) -> None:
    """Serialised states of FMUs lead a resumed run to the bits of one that was not broken off."""
    settings = "stop_time = 4.0\nlargest_step_size = 1e-3\n"
    models = {name: fmu_dir / f"{name}.fmu" for name in ("chassis", "wheel")}
    system = car(tmp_path, settings, **models)
    out = tmp_path / "out"
    master = start("master_node", "run", tmp_path / "car.toml", "--no-plot", "--output", out)
    master.wait_for("simulating")
    wait_until(lambda: has_stepped(out))
    processes = [worker_of(node) for node in slave_processes(master).values()]
    assert len(processes) == 2
    master.send(signal.SIGINT)
    assert master.wait() == 130
    assert Result.load(out).time[-1] < 4.0
    resume(out)
    simulate(system, output=tmp_path / "whole", in_process=True)
    assert contents(out) == contents(tmp_path / "whole")


# ---- What cannot be resumed ---------------------------------------------------------------------


def broken_off(tmp_path: Path, simulation: str = "stop_time = 0.3\n", **models: Any) -> Path:
    """A run that was interrupted."""
    system = car(tmp_path, simulation, **models)
    with pytest.raises(InterruptedRunError):
        simulate(system, output=tmp_path / "out", in_process=True, observers=(Interrupt(4),))
    return tmp_path / "out"


def test_a_model_that_has_changed(tmp_path: Path) -> None:
    """Another model would go on to other results: refused, and what is there stays."""
    model = tmp_path / "quarter_car.py"
    shutil.copy(EXAMPLES / "quarter_car.py", model)
    out = broken_off(tmp_path, chassis=f"{model}:Chassis")
    before = contents(out)
    model.write_text(model.read_text() + "\n# another one\n")
    with pytest.raises(ConfigurationError, match=r"^chassis: resume: the model .* is not the one"):
        resume(out)
    assert contents(out) == before
    assert (out / "checkpoint" / "run.zip").exists()


@pytest.mark.parametrize("what", ["calls", "zip", "rows", "system"])
def test_damaged_files(what: str, tmp_path: Path) -> None:
    """Each is named, and nothing is made up."""
    out = broken_off(tmp_path)
    folder = out / "checkpoint"
    if what == "calls":
        path = folder / "wheel.0.calls"
        path.write_bytes(b"?" + path.read_bytes()[1:])
    elif what == "zip":
        path = folder / "run.zip"
        path.write_bytes(path.read_bytes()[:100])
    elif what == "rows":
        path = out / "results.csv"
        path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    else:
        path = folder / "system.json"
        path.write_text("{}")
    with pytest.raises(ResultsError, match=path.name if what != "system" else "malformed"):
        resume(out)


def test_no_checkpoint_was_wanted(tmp_path: Path) -> None:
    """``checkpoint_interval = 0``: none is written, and resume says what to do."""
    out = broken_off(tmp_path, "stop_time = 0.3\ncheckpoint_interval = 0\n")
    assert not (out / "checkpoint").exists()
    with pytest.raises(ResultsError, match=r"holds no checkpoint.*checkpoint_interval"):
        resume(out)


def test_a_new_run_replaces_the_checkpoint(tmp_path: Path) -> None:
    """Resuming continues the last run in a directory, not one before it."""
    out = broken_off(tmp_path)
    system = load_system(tmp_path / "car.toml").with_simulation(stop_time=0.2)
    simulate(system, output=out, in_process=True)
    assert not (out / "checkpoint").exists()
    resume(out, observers=(Untold(),))
    assert Result.load(out).time[-1] == 0.2


def test_a_new_run_without_checkpoints_leaves_none_of_an_old_one(tmp_path: Path) -> None:
    """An old checkpoint beside new results would resume another run than theirs."""
    out = broken_off(tmp_path)
    system = load_system(tmp_path / "car.toml").with_simulation(
        checkpoint_interval=0.0, relative_tolerance=1e-6
    )
    with pytest.raises(InterruptedRunError):
        simulate(system, output=out, in_process=True, observers=(Interrupt(9),))
    with pytest.raises(ResultsError, match="holds no checkpoint"):
        resume(out)


# ---- Plain values -------------------------------------------------------------------------------


def test_a_position_reads_back_to_the_same_bits() -> None:
    """Negative zero, infinities, NaN, layouts of arrays and types of numbers are kept."""
    array = np.array([[0.1, -0.0], [np.inf, 1e-310]])
    position = Position(
        CouplingHistory((0.3, np.float64(0.2)), (array, np.asfortranarray(array)), 5),  # type: ignore[arg-type]
        Outputs(array[:, :1].copy(), (1, 1.0, True, "text", b"\x00bytes", (1, 2.0))),
        1e-3,
        OrderMemory(InputPolynomial(2, 1), 3, None, 1, array),
        Search(array[0], 0.5, array[1], (1e-3, array[1]), is_confirmed=True, firsts=1),
        smooth=SmoothStep(float("nan"), array[0], array[1], array[0]),
    )
    again = from_plain(Position, json.loads(json.dumps(to_plain(position))))
    assert_same(again, position)


_T = TypeVar("_T", bound=np.generic)
Matrix = TypeAliasType("Matrix", np.ndarray[tuple[int, int], np.dtype[_T]], type_params=(_T,))
Floats = TypeAliasType("Floats", np.ndarray[tuple[int, int], np.dtype[np.float64]])


@dataclass(frozen=True)
class Aliased:
    """Its annotations are names for types, as ``NDArray`` is from NumPy 2.5 on."""

    values: Matrix[np.float64]
    others: Floats


def test_names_of_types_are_the_types() -> None:
    """With NumPy 2.5 on Python 3.12 no checkpoint was read."""
    value = Aliased(np.array([[1.0, -0.0]]), np.array([[np.inf]]))
    again = from_plain(Aliased, json.loads(json.dumps(to_plain(value))))
    assert_same((again.values, again.others), (value.values, value.others))


def assert_same(a: Any, b: Any) -> None:
    """Type by type and bit by bit."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.tobytes() == b.tobytes()
        assert (a.shape, a.strides, a.dtype) == (b.shape, b.strides, b.dtype)
    elif isinstance(a, Mapping):
        assert a == b
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif hasattr(a, "__slots__") and not isinstance(a, float):
        for name in a.__slots__:
            assert_same(getattr(a, name), getattr(b, name))
    else:
        assert repr(a) == repr(b)


@pytest.mark.parametrize("plain", [{"order": 1}, 3, {"times": [0.1], "inputs": 7, "depth": 1}])
def test_what_is_no_value_is_refused(plain: object) -> None:
    """Never anything else than the type that was asked for."""
    with pytest.raises(ValueError, match="not a CouplingHistory"):
        from_plain(CouplingHistory, plain)
