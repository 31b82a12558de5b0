"""Events where step sizes are multiples of something: what comes behind them is crossed, and told.

An oscillator is pushed at 0.3 s. Its output, or the push itself, comes back through two slaves with
direct feed-through, of which one takes multiples of a step size only.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from master_node import System, simulate
from master_node.results import Result
from protocol.errors import StepSizeError

PUSHED = 0.3
OMEGA = 20.0
TOLERANCE = 1e-4

MODELS = """
from slave_node.model import Model, real

class Gain(Model):
    inputs = (real("u"),)
    outputs = (real("y"),)
    parameters = (real("k"),)
    feed_through = {"y": ("u",)}
    def output_values(self, t, x, u):
        return [self.k * u[0]]

class Oscillator(Model):
    inputs = (real("u"), real("f"))
    states = (real("x"), real("v"))
    outputs = (real("y"), real("push"))
    feed_through = {"push": ("f",)}
    def derivatives(self, t, x, u):
        return [x[1], 400.0 * (u[0] + u[1] - x[0]) - 2.0 * x[1]]
    def output_values(self, t, x, u):
        return [x[0], u[1]]
"""


def pushed(folder: Path, source: str, step_multiple: float | None, estimator: str) -> Result:
    """The run; ``source`` is what comes back to the oscillator, times -0.5."""
    (folder / "models.py").write_text(MODELS, encoding="utf-8")
    grid = {} if step_multiple is None else {"step_multiple": step_multiple}
    system = System(
        simulation={"stop_time": 0.6, "estimator": estimator, "coupling": "explicit"},
        slaves={
            "half": {"model": "models.py:Gain", "parameters": {"k": 0.5}},
            "minus": {"model": "models.py:Gain", "parameters": {"k": -1.0}, **grid},
            "body": {"model": "models.py:Oscillator"},
        },
        connections=((source, "half.u"), ("half.y", "minus.u"), ("minus.y", "body.u")),
        inputs={
            "body.f": {"table": (np.array([0.0, PUSHED, PUSHED, 1.0]), np.array([0.0, 0, 1, 1]))}
        },
        base=folder,
    )
    return simulate(system, in_process=True)


def error_of(result: Result, source: str) -> float:
    """The largest one of the position, in tolerances."""
    is_behind = result.time >= PUSHED
    times = result.time[is_behind]

    def slope(_: float, x: np.ndarray) -> list[float]:
        back = -0.5 * (x[0] if source == "body.y" else 1.0)
        return [x[1], OMEGA**2 * (back + 1.0 - x[0]) - 2.0 * x[1]]

    exact = solve_ivp(slope, (PUSHED, 1.0), [0.0, 0.0], t_eval=times, rtol=1e-11, atol=1e-13).y[0]
    return float(np.abs(result["body.y"][is_behind] - exact).max() / TOLERANCE)


@pytest.mark.parametrize("estimator", ["mod", "rich"])
def test_the_beginning_behind_an_event_is_crossed(
    tmp_path: Path, estimator: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The polynomials behind the event have no past, and constants are too coarse for the grid.
    Those few double steps are kept; all others have ERR up to 1, and the user is told once.
    """
    caplog.set_level(logging.WARNING, "master_node")
    result = pushed(tmp_path, "body.y", 0.001, estimator)
    steps = result.steps[result.steps["accepted"]]
    above = steps[steps["error_norm"] > 1.0]
    assert 1 <= len(above) == result.summary["steps_above_tolerance"] <= 5
    assert (above["time"] >= PUSHED).all()
    assert (above["time"] < PUSHED + 0.02).all()
    (warning,) = (r.getMessage() for r in caplog.records if "behind an event" in r.getMessage())
    assert "H cannot be below 0.001 s" in warning
    assert error_of(result, "body.y") < 20.0


@pytest.mark.parametrize("estimator", ["mod", "rich"])
def test_an_event_travels_along_direct_feed_through(tmp_path: Path, estimator: str) -> None:
    """Each communication point hands a jump on by one slave: it arrives late by two of them, so
    that the error is in proportion to H; and that is told.
    """
    errors = []
    for step_multiple in (0.002, 0.001):
        result = pushed(tmp_path, "body.push", step_multiple, estimator)
        assert result.summary["outcome"] == "completed"
        assert result.summary["steps_above_tolerance"] > 0
        errors.append(error_of(result, "body.push"))
    assert 1.7 < errors[0] / errors[1] < 2.3


def test_without_a_grid_nothing_is_kept_above_the_tolerance(tmp_path: Path) -> None:
    """H is made as small as need be."""
    result = pushed(tmp_path, "body.y", None, "mod")
    accepted = result.steps[result.steps["accepted"]]
    assert result.summary["steps_above_tolerance"] == 0
    at_event = accepted["time"] < PUSHED
    assert (accepted["error_norm"][~at_event] <= 1.0).all()
    assert error_of(result, "body.y") < 20.0


def test_a_grid_that_is_too_coarse_is_refused(tmp_path: Path) -> None:
    """Where polynomials have all their points and ERR is above 1 still."""
    with pytest.raises(StepSizeError, match=r"step sizes are multiples of 0\.01 s"):
        pushed(tmp_path, "body.y", 0.01, "mod")
