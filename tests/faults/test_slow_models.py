"""Models that take long, and models that never answer: each wait has a bound, which names its key.

The FMU `accident` meets with an accident in the function of FMI that the environment names.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from master_node import load_system, simulate
from master_node.slaves.request_bounds import RequestBounds, RequestClock
from protocol.bus.endpoints import free_endpoint
from protocol.calls import (
    Call,
    Configure,
    Describe,
    DoStep,
    Examine,
    ExitInitializationMode,
    GetOutputs,
    Initialize,
    Reply,
    Reset,
    SetState,
)
from protocol.description import SlaveDescription, StateKind
from protocol.errors import DeadlineError, DoublestepError
from tests.faults.test_processes import Start, start
from tests.support.slow import quick_at

__all__ = ["start"]

pytestmark = pytest.mark.usefixtures("no_process_left")

BOUNDS = RequestBounds(load_timeout=5.0, initialization_timeout=70.0, step_timeout=1.0)


def lag_file(folder: Path, capability_dir: Path, bus: str = "", simulation: str = "") -> Path:
    """The lag alone, with few steps."""
    path = folder / "lag.toml"
    path.write_text(
        f"[simulation]\nstop_time = 0.1\n{simulation}"
        f'[slaves.lag]\nmodel = "{capability_dir / "accident.fmu"}"\n[bus]\n{bus}'
    )
    return path


# ---- The end of a run ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("accident", "words"),
    [("error", "an accident"), ("crash", "died by SIGSEGV"), ("hang", "raise step_timeout in")],
)
@pytest.mark.parametrize("recovery", quick_at(["auto"], ["auto", "off"]))
def test_a_terminate_that_fails_does_not_fail_the_run(  # noqa: PLR0917
    accident: str,
    words: str,
    recovery: str,
    tmp_path: Path,
    capability_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """All results are there, so the run is completed; one warning and the summary tell of it."""
    monkeypatch.setenv("ACCIDENT", f"fmi2Terminate {accident}")
    bus = "step_timeout = 3.0\n" if accident == "hang" else ""
    file = lag_file(tmp_path, capability_dir, bus, f'recovery = "{recovery}"\n')
    result = simulate(load_system(file), output=tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["outcome"], result.time[-1]) == ("completed", 0.1)
    assert words in summary["message"]
    (warning,) = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert warning == f"the run is complete, but: {summary['message']}"
    assert warning.startswith("the run is complete, but: lag: terminate at t=0.1 s: ")


@pytest.mark.parametrize("function", ["fmi2Terminate", "fmi2Reset"])
def test_a_failed_end_in_process_is_told_too(
    function: str, tmp_path: Path, capability_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In process too, and where the end of the instance meets the same accident."""
    monkeypatch.setenv("ACCIDENT", f"{function} error")
    system = load_system(lag_file(tmp_path, capability_dir))
    result = simulate(system, in_process=True)
    assert result.summary["outcome"] == "completed"
    assert ("an accident" in result.summary["message"]) == (function == "fmi2Terminate")


@pytest.mark.parametrize(("accident", "outcome"), [("error", "completed"), ("crash", "")])
def test_an_fmu_that_refuses_a_choice_of_its_log_runs_all_the_same(
    accident: str,
    outcome: str,
    tmp_path: Path,
    capability_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its log is no part of its results; a crash there is one."""
    monkeypatch.setenv("ACCIDENT", f"fmi2SetDebugLogging {accident}")
    system = load_system(lag_file(tmp_path, capability_dir))
    if outcome:
        assert simulate(system).summary["outcome"] == outcome
    else:
        with pytest.raises(DoublestepError, match="died by SIGSEGV"):
            simulate(system)


# ---- Waits --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("function", "key", "seconds"),
    [
        ("fmi2Instantiate", "load_timeout", 2.0),
        ("fmi2EnterInitializationMode", "initialization_timeout", 2.0),
        ("fmi2GetReal", "initialization_timeout", 2.0),
        ("fmi2ExitInitializationMode", "initialization_timeout", 2.0),
        ("fmi2DoStep", "step_timeout", 2.0),
    ],
)
@pytest.mark.slow
def test_an_endless_call_ends_with_the_key_of_its_bound(  # noqa: PLR0917
    function: str,
    key: str,
    seconds: float,
    tmp_path: Path,
    capability_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Exit code 5, slave, cause, and the key to raise where the model is only slow."""
    monkeypatch.setenv("ACCIDENT", f"{function} hang")
    file = lag_file(tmp_path, capability_dir, f"{key} = {seconds}\n", 'estimator = "none"\n')
    with pytest.raises(DeadlineError, match=f"within {seconds:g} s") as info:
        simulate(load_system(file))
    assert (info.value.slave, info.value.exit_code) == ("lag", 5)
    assert f"raise {key} in [bus]" in str(info.value)


@pytest.mark.parametrize(
    ("function", "bus"),
    [
        ("fmi2Instantiate", "discovery_timeout = 2.0\nstep_timeout = 2.0\n"),
        ("fmi2ExitInitializationMode", "load_timeout = 60.0\nstep_timeout = 2.0\n"),
    ],
)
def test_loading_and_initialization_may_take_longer_than_a_step(
    function: str,
    bus: str,
    tmp_path: Path,
    capability_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A start of 3 s is no reason to give up, where a step has 2 s."""
    monkeypatch.setenv("ACCIDENT", f"{function} 3.0")
    file = lag_file(tmp_path, capability_dir, bus, 'estimator = "none"\n')
    assert simulate(load_system(file)).summary["outcome"] == "completed"


@pytest.mark.slow
def test_a_served_slave_whose_reset_hangs_is_loaded_anew(
    start: Start, tmp_path: Path, capability_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It serves one run after the other; nothing waits for the reset without an end."""
    monkeypatch.setenv("ACCIDENT", "fmi2Reset hang")
    fmu, endpoint = capability_dir / "accident.fmu", free_endpoint()
    options = ("--connect", endpoint, "--load-timeout", "5.0")
    slave = start("slave_node", "serve", fmu, "--name", "lag", *options)
    path = tmp_path / "lag.toml"
    bus = f'[bus]\nlisten = ["{endpoint}"]\n'
    path.write_text(f"[simulation]\nstop_time = 0.1\n[slaves.lag]\n{bus}")
    results = [simulate(load_system(path)).outputs for _ in range(2)]
    assert np.array_equal(*results)
    slave.wait_for("no reset within 5 s (load_timeout)")


# ---- Bounds of requests -------------------------------------------------------------------------


def bound(calls: Sequence[Call], clock: RequestClock | None = None) -> tuple[float, str]:
    """Seconds and keys."""
    found = (clock or RequestClock(BOUNDS)).bound(calls)
    return found.seconds, " ".join(found.keys)


def step(number: int = 0) -> DoStep:
    """Any."""
    return DoStep(float(number), 1.0)


def test_each_kind_of_work_has_its_bound() -> None:
    """Calls of one request, one after the other, may take the sum of their bounds."""
    assert bound([Describe()]) == (1.0, "step_timeout")
    assert bound([Configure()]) == (5.0, "load_timeout")
    assert bound([Reset()]) == (5.0, "load_timeout")
    assert bound([step()] * 3) == (1.0, "step_timeout")
    assert bound([step()] * 1000) == (334.0, "step_timeout")
    assert bound([Examine(0.0, 1.0)]) == (4.0, "step_timeout")
    everything = [Configure(), Initialize(), ExitInitializationMode(), step()]
    assert bound(everything) == (76.0, "load_timeout initialization_timeout step_timeout")


@pytest.mark.parametrize("end", [ExitInitializationMode(), Reset(), Configure()])
def test_reading_in_initialization_mode_may_take_as_long_as_initializing(end: Call) -> None:
    """Many FMUs compute nothing before they are asked for values."""
    clock = RequestClock(BOUNDS)
    assert bound([GetOutputs()], clock) == (1.0, "step_timeout")
    assert bound([Initialize()], clock) == (70.0, "initialization_timeout")
    assert bound([GetOutputs()], clock) == (70.0, "initialization_timeout")
    assert "initialization_timeout" in bound([end], clock)[1]
    assert bound([GetOutputs()], clock) == (1.0, "step_timeout")


def test_a_replay_may_take_as_long_as_what_it_repeats() -> None:
    """Only where states are replayed, and from initialization on; few different bounds come."""
    clock = RequestClock(BOUNDS)
    going_back = [SetState(0), step()]
    description = SlaveDescription("model", "Python model", (), state_kind=StateKind.REPLAY)
    clock.took(Reply([], None, 100.0))
    assert bound(going_back, clock) == (1.0, "step_timeout")
    clock.took(Reply([description], None, 100.0))
    clock.bound([Initialize()])
    clock.bound([ExitInitializationMode()])
    assert bound(going_back, clock)[0] == 1.0
    found = set()
    for _ in range(1000):
        clock.took(Reply([], None, 1.0))
        found.add(bound(going_back, clock)[0])
    assert max(found) >= 2000.0
    assert len(found) < 15
