"""Laws of dense output: results between communication points."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from master_node import System, load_system, simulate
from master_node.numerics.dense_output import OutputGrid, OutputHistory
from tests.support.places import SUPPORT
from tests.support.quarter_car_case import EXAMPLES, STATES, exact_solution
from tests.support.slow import quick_at

NO, YES = np.array([False]), np.array([True])


@given(
    st.integers(0, 3),
    st.lists(st.floats(0.2, 3.0), min_size=4, max_size=4),
    st.data(),
    st.booleans(),
)
def test_polynomials_of_the_solutions_order_are_reproduced(
    order: int, gaps: list[float], data: st.DataObject, has_derivative: bool
) -> None:
    """Law: outputs that are polynomials of degree k + 1 are read without error on any grid.

    With derivatives, which three points have, up to degree 5.
    """
    degree = 5 if has_derivative else order + 1
    coefficients = data.draw(
        st.lists(st.floats(-5.0, 5.0), min_size=degree + 1, max_size=degree + 1)
    )
    y = Polynomial(coefficients)

    def outputs(t: float) -> np.ndarray:
        return np.array([[y(t)], [y.deriv()(t)]])

    history = OutputHistory((0.0,), (outputs(0.0),))
    time = 0.0
    for gap in gaps:
        time += gap
        history = history.pushed(time, outputs(time))
    times = np.array([time - f * (gaps[-1] + gaps[-2]) for f in (0.0, 0.3, 0.77)])
    scale = sum(abs(c) * max(1.0, time) ** i for i, c in enumerate(coefficients)) + 1.0
    read = history.at(times, order, YES if has_derivative else NO)
    assert read[:, 0] == pytest.approx(y(times), abs=1e-10 * scale)


def test_communication_points_are_met_bit_for_bit() -> None:
    """The polynomial has the value of the newest point there, without rounding."""
    history = OutputHistory((0.0,), (np.array([[0.1], [0.0]]),))
    for time in (0.3, 0.7, 0.9):
        history = history.pushed(time, np.array([[np.sin(time)], [np.cos(time)]]))
    for has_derivative in (NO, YES):
        assert history.at(np.array([0.9]), 2, has_derivative)[0, 0] == np.sin(0.9)


@given(
    st.lists(st.floats(0.2, 3.0), min_size=4, max_size=4),
    st.integers(0, 4),
    st.floats(0.0, 1.0),
    st.booleans(),
)
def test_no_polynomial_leads_over_a_jump(
    gaps: list[float], jump: int, place: float, has_derivative: bool
) -> None:
    """Law: beside a jump a line is read as on each side; at its place the later side counts.

    The jump lies in the gap of that number, before the first point with the last number.
    """
    points = np.cumsum([0.0, *gaps])
    after = points[jump] if jump < 4 else -1.0  # the newest point before the jump

    def outputs(t: float) -> np.ndarray:
        return np.array([[0.1 * t + 100.0 * (t > after)], [0.1]])

    history = OutputHistory((0.0,), (outputs(0.0),))
    for time in points[1:]:
        history = history.pushed(float(time), outputs(float(time)))
    times = np.array([points[2] + place * (points[4] - points[2])])
    read = history.at(times, 1, YES if has_derivative else NO, np.array([1e-4]))[0, 0]
    if jump in {2, 3} and after < times[0] < points[jump + 1]:
        assert read == outputs(float(points[jump + 1]))[0, 0]
    else:
        assert read == pytest.approx(outputs(float(times[0]))[0, 0], abs=1e-9)


def test_each_output_is_read_by_what_it_has() -> None:
    """A mixed system: an output's values do not depend on what the others have."""
    rows = [(t, np.array([[np.sin(t), np.exp(t)], [np.cos(t), 0.0]])) for t in (0.0, 0.1, 0.25)]
    history = OutputHistory(rows[0][:1], rows[0][1:])
    for time, y in rows[1:]:
        history = history.pushed(time, y)
    times = np.array([0.05, 0.2])
    mixed = history.at(times, 1, np.array([True, False]))
    both, none = (history.at(times, 1, np.array([b, b])) for b in (True, False))
    assert mixed[:, 0].tobytes() == both[:, 0].tobytes()
    assert mixed[:, 1].tobytes() == none[:, 1].tobytes()
    assert np.abs(mixed[:, 0] - np.sin(times)).max() < 1e-7


@given(
    st.floats(-10.0, 10.0),
    st.floats(1e-3, 2.0),
    st.lists(st.floats(1e-2, 5.0), min_size=1, max_size=20),
)
def test_every_time_of_the_grid_comes_once(
    start: float, interval: float, gaps: list[float]
) -> None:
    """Law: however the steps fall, the times are start + i interval, each of them once."""
    grid = OutputGrid(start, interval, start + 1e6)
    time, found = start, []
    for gap in gaps:
        time += gap
        found += grid.up_to(time, len(found) + 1)
    assert found == [start + i * interval for i in range(1, len(found) + 1)]
    following = start + (len(found) + 1) * interval
    assert following > time
    assert all(a < b for a, b in pairwise([start, *found]))
    assert not found or found[-1] <= time


def test_the_stop_time_is_on_the_grid_where_it_is_a_multiple(fmu_dir: Path) -> None:
    """3 * 0.1 is above 0.3: the last row is there all the same, at the stop time itself."""
    system = load_system(EXAMPLES / "displacement.toml")
    result = simulate(system, in_process=True, stop_time=0.3, output_interval=0.1)
    assert result.time.tolist() == [0.0, 0.1, 0.2, 0.3]


def test_rows_are_where_they_are_wanted(fmu_dir: Path) -> None:
    """A run writes T_0 and T_0 + i interval, whatever its communication points are."""
    system = load_system(EXAMPLES / "displacement.toml")
    for kw in ({}, {"order": 1}, {"estimator": "rich"}, {"estimator": "none"}):
        result = simulate(system, in_process=True, stop_time=1.0, output_interval=0.03, **kw)
        assert result.time.tolist() == [0.03 * i for i in range(34)]


@pytest.mark.parametrize(
    ("order", "points"),
    quick_at([(0, 0), (2, 1), (3, 0)], [(0, 0), (1, 0), (2, 0), (3, 0), (2, 1), (3, 2)]),
)
def test_dense_output_is_as_good_as_the_solution(fmu_dir: Path, order: int, points: int) -> None:
    """Law: on a grid that meets almost no communication point the error is of the same order.

    With fixed steps, where both fall alike with H. The start is left out: the solution has a kink
    there, behind which no polynomial is good.
    """
    system = load_system(EXAMPLES / "displacement.toml")
    for step_size in (4e-3, 2e-3, 1e-3):
        errors = []
        for interval in (None, 0.000337):
            result = simulate(
                system,
                in_process=True,
                estimator="none",
                order=order,
                derivative_points=points,
                stop_time=0.5,
                initial_step_size=step_size,
                slave_tolerance=1e-11,
                output_interval=interval,
            )
            y = np.column_stack([result[name] for name in STATES])
            error = np.abs(y - exact_solution(result.time))
            errors.append(error[result.time > 0.05].max())
        assert errors[1] <= 2.0 * errors[0]


def test_dense_output_does_not_depend_on_the_grid(fmu_dir: Path) -> None:
    """Grids change neither the communication points nor values at common times, bit for bit."""
    system = load_system(EXAMPLES / "displacement.toml")
    fine = simulate(system, in_process=True, stop_time=1.0, output_interval=0.0625)
    coarse = simulate(system, in_process=True, stop_time=1.0, output_interval=0.125)
    assert fine.outputs[::2].tobytes() == coarse.outputs.tobytes()
    assert fine.steps["time"].tolist() == coarse.steps["time"].tolist()


def test_points_too_far_apart_are_told_once(caplog: pytest.LogCaptureFixture) -> None:
    """A slave that depends on nothing moves between steps as long as the system likes them.

    Results at the points are right; those between them are not, and a warning says so. Steps as
    short as it says mend that.
    """
    system = System(
        simulation={"stop_time": 20.0, "output_interval": 0.05},
        slaves={"wave": {"model": "driven_models.py:Wave"}},
        base=SUPPORT,
    )
    coarse = simulate(system, in_process=True)
    error = np.abs(coarse["wave.x"] - np.sin(coarse.time))
    told = "results between communication points are not as accurate as those at them"
    assert error.max() > 0.01
    assert caplog.text.count(told) == 1
    caplog.clear()
    fine = simulate(system.with_simulation(largest_step_size=0.1), in_process=True)
    assert np.abs(fine["wave.x"] - np.sin(fine.time)).max() < 1e-3
    assert told not in caplog.text
