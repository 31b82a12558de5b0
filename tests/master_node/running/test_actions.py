"""Actions: what a run does by itself at points in time, as its user would do it in a session."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_node import Result, System, load_system, open_run, simulate
from protocol.errors import ConfigurationError
from tests.master_node.resuming.test_resume import interrupted
from tests.master_node.running.test_steering import METHODS, car, drive, files
from tests.support.places import ROOT
from tests.support.quarter_car_case import EXAMPLES

Tables = tuple[Mapping[str, Any], ...]

HARDER = {"chassis.k": 3e4, "wheel.k_c": 3e4}
STUCK = {"wheel.x_c": 0.02}
CHANGES: Tables = (
    {"at": 0.2, "override": STUCK},
    {"at": 0.1, "set": HARDER},
    {"at": 0.3, "release": ("wheel.x_c",)},
)
"""Actions in no order."""


def acting(system: System, *actions: Mapping[str, Any]) -> System:
    """The system with these actions."""
    parts = {name for name, field in System.model_fields.items() if not field.exclude}
    kept = {name: getattr(system, name) for name in parts}
    return System(**kept | {"actions": actions}, base=system.base)


@pytest.mark.parametrize("method", METHODS)
def test_actions_are_what_a_session_does(tmp_path: Path, method: str) -> None:
    """Law: with every method, a run with actions writes the files of a session byte for byte that
    stops at their times and does the same.
    """
    system = car(**METHODS[method])
    simulate(acting(system, *CHANGES), output=tmp_path / "actions", in_process=True)
    with open_run(system, output=tmp_path / "session", in_process=True) as run:
        run.until(0.1)
        run.set(HARDER)
        run.until(0.2)
        run.override(STUCK)
        run.until(0.3)
        run.release("wheel.x_c")
        while run.step():
            pass
    assert files(tmp_path / "actions") == files(tmp_path / "session")


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("state", ["native", "fork", "replay", "none"])
def test_they_are_done_at_their_times(capability_dir: Path, version: int, state: str) -> None:
    """Law: the output of y' = gain u is exact, so that each value holds from its time on, the first
    ones from the start time.
    """
    system = acting(
        drive(capability_dir, version, state=state),
        {"at": 0.0, "set": {"drive.u": 2.0, "drive.gain": 1.0}},
        {"at": 0.25, "set": {"drive.gain": 4.0}},
        {"at": 0.5, "set": {"drive.u": -1.0}},
        {"at": 0.5, "set": {"drive.gain": 1.0}},
    )
    result = simulate(system, in_process=True)
    t = result.time
    expected = 2.0 * np.minimum(t, 0.25) + 8.0 * np.clip(t - 0.25, 0.0, 0.25)
    expected -= np.clip(t - 0.5, 0.0, None)
    np.testing.assert_allclose(result["drive.y"], expected, rtol=0.0, atol=1e-12)
    assert {0.25, 0.5} <= set(t.tolist())


def test_they_are_told(caplog: pytest.LogCaptureFixture) -> None:
    """Each action has a row without a step in ``steps.csv``, and a line in the log."""
    caplog.set_level(logging.INFO, logger="master_node")
    result = simulate(acting(car(), *CHANGES), in_process=True)
    rows = result.steps[result.steps["step_size"] == 0.0]
    assert rows["time"].tolist() == [0.1, 0.2, 0.3]
    texts = [
        "set chassis.k = 30000.0, wheel.k_c = 30000.0",
        "override wheel.x_c = 0.02",
        "release wheel.x_c",
    ]
    assert rows["limiting_variable"].tolist() == texts
    assert rows["accepted"].all()
    told = [record.getMessage() for record in caplog.records]
    for time, text in zip((0.1, 0.2, 0.3), texts, strict=True):
        assert f"t={time} s: {text}" in told
    assert result.summary["settings"]["actions"][0]["override"] == STUCK


@pytest.mark.parametrize("in_process", [True, False])
def test_an_action_stops_a_run_in_order(tmp_path: Path, *, in_process: bool) -> None:
    """The outcome says so, what comes behind is not done, and the run is complete."""
    system = acting(car(), {"at": 0.25, "stop": True}, {"at": 0.3, "set": {"chassis.k": 1.0}})
    result = simulate(system, output=tmp_path, in_process=in_process)
    assert result.time[-1] == 0.25
    assert result.summary["outcome"] == "stopped by an action"
    assert result.summary["message"] == "stopped by an action at t=0.25 s"
    assert Result.load(tmp_path).time[-1] == 0.25
    assert not list(tmp_path.glob("*checkpoint*/*"))


@pytest.mark.parametrize("numbers", [(1,), (4, 7), (20, 20), (30, 1)])
def test_a_run_with_actions_is_resumed_to_the_same_files(
    tmp_path: Path, numbers: tuple[int, ...]
) -> None:
    """Law: wherever it is broken off, each action is done once; and so over Zenoh."""
    system = acting(car(checkpoint_interval=1e-9), *CHANGES)
    interrupted(system, tmp_path / "cut", *numbers)
    simulate(system, output=tmp_path / "whole")
    assert files(tmp_path / "cut") == files(tmp_path / "whole")


def test_a_session_with_actions_goes_back_before_them() -> None:
    """Law: a mark knows which actions are done, so a branch from before one does it again."""
    with open_run(acting(car(), {"at": 0.2, "override": STUCK}), in_process=True) as run:
        run.until(0.1)
        mark = run.save()
        ends = []
        for _ in range(2):
            run.restore(mark)
            assert not run.overridden
            run.until(0.3)
            assert run.overridden == STUCK
            ends.append(run["wheel.x"])
    assert ends[0] == ends[1]


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ({"at": 0.1}, "number 2: say what to do: set, override, release or stop"),
        ({"at": 0.1, "sat": {}}, "number 2: unknown key 'sat'; did you mean"),
        ({"set": HARDER}, "number 2: key 'at' is missing"),
        ({"at": 0.5, "set": HARDER}, "is not within the run, from 0.0 s to before 0.5 s"),
        ({"at": -0.1, "set": HARDER}, "is not within the run"),
        ({"at": 0.1 + 1e-12, "set": HARDER}, "is nearer to the action before it"),
        ({"at": 0.1, "set": {"chassis.kk": 1.0}}, "no variable 'chassis.kk'"),
        ({"at": 0.1, "set": {"chassis.x": 1.0}}, "cannot be set during a run"),
        ({"at": 0.1, "set": {"chassis.k": "stiff"}}, "is of type Real; it cannot be"),
        ({"at": 0.1, "set": {"wheel.x_c": 1.0}}, "wheel.x_c is connected to chassis.x"),
        ({"at": 0.1, "override": {"chassis.k": 1.0}}, "is no connected input"),
        ({"at": 0.2, "release": ["wheel.x_c"]}, "wheel.x_c is not overridden"),
    ],
)
def test_mistakes_are_told_before_the_first_step(
    tmp_path: Path, action: Mapping[str, Any], words: str
) -> None:
    """Law: each names the action, the cause and the remedy; no file tells of a run."""
    with pytest.raises(ConfigurationError) as caught:
        simulate(acting(car(), {"at": 0.1, "set": HARDER}, action), output=tmp_path)
    assert words in str(caught.value)
    assert "[[actions]] number 2" in str(caught.value)
    assert not (tmp_path / "steps.csv").exists()


def test_times_between_the_points_of_a_grid_are_refused() -> None:
    """With fixed steps an action is at one of their points; the error names those beside it."""
    system = car(estimator="none", initial_step_size=0.01)
    with pytest.raises(ConfigurationError, match=r"go to t=0.1\d* s or t=0.11\d* s"):
        simulate(acting(system, {"at": 0.105, "stop": True}), in_process=True)


def test_the_example_with_actions(tmp_path: Path) -> None:
    """The example runs as it stands: a harder spring, a stuck sensor, and a stop."""
    system = load_system(ROOT / "examples" / "steering" / "actions.toml")
    result = simulate(system, output=tmp_path)
    assert result.time[-1] == 3.5
    stuck = simulate(load_system(EXAMPLES / "displacement_python.toml"), in_process=True)
    assert abs(result["wheel.x"][-1] - stuck["wheel.x"][-1]) > 1e-4
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert len(summary["settings"]["actions"]) == 4
