"""Laws of the first communication step size, where none is given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from master_node import load_system, simulate
from master_node.numerics.initial_step_size import initial_step_size, trial_step_size
from tests.support.places import ROOT
from tests.support.slow import quick_at

EXAMPLES = ROOT / "examples"
OSCILLATORS = EXAMPLES / "oscillators"

scales = st.floats(1e-8, 1e3)


@given(scales, st.floats(1e-3, 1e3), st.floats(1e-4, 1e4))
def test_the_trial_changes_the_outputs_by_a_hundredth(
    size: float, slope: float, scale: float
) -> None:
    """Law: H of the trial is 0.01 |y| / |y'|, bounded by a thousandth of the simulated time."""
    y, dy = np.array([size]), np.array([slope])
    trial = trial_step_size(y, dy, np.array([scale]), 10.0)
    if min(size, slope) / scale < 1e-5:
        assert trial == pytest.approx(1e-5)
    else:
        assert trial == pytest.approx(min(0.01 * size / slope, 1e-2))


@given(st.floats(1e-9, 1e-2), st.floats(-5, 5), st.floats(-50, 50), st.integers(1, 5))
def test_time_scales_with_the_solution(trial: float, slope: float, bend: float, p: int) -> None:
    """Law: never more than a hundred times the trial, and never beyond what ERR allows."""
    tau = np.array([0.0, trial, 2 * trial])
    y = 1.0 + slope * tau + bend * tau**2
    scale = np.array([1e-4])
    for norm in (0.0, 1e-6, 1.0):
        h = initial_step_size(y[:1], y[1:2], y[2:], scale, trial=trial, error_norm=norm, exponent=p)
        assert 0.0 < h <= 100.0 * trial
        if norm:
            assert h <= trial * norm ** (-1.0 / p) * (1 + 1e-12)


def test_a_system_at_rest_gets_the_largest() -> None:
    """Where nothing moves nothing bounds H but the trial."""
    y = np.zeros(2)
    h = initial_step_size(y, y, y, np.full(2, 1e-4), trial=1e-3, error_norm=0.0, exponent=3)
    assert h == 0.1


@pytest.mark.parametrize("estimator", quick_at(["mod"], ["mod", "rich"]))
@pytest.mark.parametrize("tolerance", quick_at([1e-3], [1e-3, 1e-6]))
@pytest.mark.parametrize("order", ["auto", 1, 3])
@pytest.mark.parametrize("name", ["two_mass", "van_der_pol", "chain", "kick"])
def test_the_first_steps_are_hardly_ever_rejected(
    oscillator_dir: Path, name: str, estimator: str, tolerance: float, order: Any
) -> None:
    """At most one rejection in the first five attempts, and H is not absurdly small."""
    result = simulate(
        load_system(OSCILLATORS / f"{name}.toml"),
        in_process=True,
        estimator=estimator,
        order=order,
        relative_tolerance=tolerance,
        absolute_tolerance=tolerance,
        stop_time=2.0,
        discontinuities=False,
    )
    steps = result.steps
    assert np.count_nonzero(~steps["accepted"][:5]) <= 1
    assert steps["step_size"][0] >= 1e-4 * steps["step_size"].max()


def test_a_given_first_step_size_is_taken(fmu_dir: Path) -> None:
    """``initial_step_size`` wins, and no trial is made."""
    system = load_system(EXAMPLES / "quarter_car" / "displacement.toml")
    given_one = simulate(system, in_process=True, stop_time=0.1, initial_step_size=2e-4)
    assert given_one.steps["step_size"][0] == 2e-4
    attempts = len(given_one.steps)
    assert given_one.summary["do_steps"] == dict.fromkeys(("chassis", "wheel"), 3 * attempts)
