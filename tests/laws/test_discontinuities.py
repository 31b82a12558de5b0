"""Jumps of the coupled variables are found, stepped up to, and not stepped over."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from master_node import Result, System, load_system, simulate
from master_node.numerics.discontinuities import Defects, Search
from master_node.numerics.double_step_times import DoubleStepTimes
from protocol.errors import ConfigurationError
from tests.support.quarter_car_case import EXAMPLES
from tests.support.slow import quick_at

OSCILLATORS = EXAMPLES.parent / "oscillators"
SMALLEST = 1e-8  # 1e-9 of the ten simulated seconds


def kick(oscillator_dir: Path, t_step: float = 1.0, **simulation: Any) -> Result:
    """Two masses of which the first one's wall jumps at ``t_step`` [s]."""
    system = load_system(OSCILLATORS / "kick.toml")
    slaves = {
        name: slave.model_dump(exclude_unset=True)
        | {"model": str(oscillator_dir / (slave.model or ""))}
        for name, slave in system.slaves.items()
    }
    slaves["source"]["parameters"] = {**slaves["source"]["parameters"], "t_step": t_step}
    whole = System(simulation=system.simulation, slaves=slaves, connections=system.connections)
    return simulate(whole, in_process=True, **simulation)


def largest_error(oscillators: ModuleType, result: Result, t_step: float = 1.0) -> float:
    """Largest error of all outputs but the source's, at all points."""
    names = [name for name in result.names if not name.startswith("source")]
    values = {"source.t_step": t_step}
    exact = oscillators.reference_solution("kick", names, result.time, values=values)
    y = np.column_stack([result[name] for name in names])
    return float(np.abs(y - exact).max())


def crossings(result: Result) -> np.ndarray:
    """The accepted attempts that lead over a jump."""
    steps = result.steps
    jumps = np.array(["jumps" in name for name in steps["limiting_variable"]], dtype=bool)
    found: np.ndarray = steps[jumps & steps["accepted"]]
    return found


@pytest.mark.parametrize("estimator", quick_at(["mod"], ["mod", "rich"]))
@pytest.mark.parametrize("order", quick_at([1, "auto"], [0, 1, 2, 3, "auto"]))
def test_a_jump_is_localised_to_the_smallest_step(
    oscillator_dir: Path, oscillators: ModuleType, estimator: str, order: int | str
) -> None:
    """Law: one crossing, of the smallest H, with the jump inside; every other step is beside it.

    The source's own output jumps between two neighbouring communication points that are no
    farther apart than that, and the masses are as good as without a jump.
    """
    result = kick(oscillator_dir, estimator=estimator, order=order)
    (crossing,) = crossings(result)
    assert crossing["limiting_variable"] == "source.y jumps"
    assert crossing["step_size"] == pytest.approx(SMALLEST, rel=1e-7)  # a difference of times
    assert crossing["time"] < 1.0 <= crossing["time"] + 2.0 * SMALLEST * (1 + 1e-6)
    jump = int(np.flatnonzero(np.diff(result["source.y"]))[0])
    assert result.time[jump + 1] - result.time[jump] <= SMALLEST * (1 + 1e-6)
    assert result.summary["discontinuities"] == 1
    assert result.summary["double_steps_at_discontinuities"] <= 60
    assert largest_error(oscillators, result) < (2e-2 if order in {0, 1} else 6e-3)


@settings(max_examples=5, deadline=None)
@given(t_step=st.floats(0.05, 9.0))
@example(t_step=1.3609246379327429)  # rejections alone shorten H until ERR is below 1
def test_a_jump_is_found_wherever_it_is(
    oscillator_dir: Path, oscillators: ModuleType, t_step: float
) -> None:
    """Law: one jump is found wherever it is, unless ERR alone has made it as small as any error.

    Rejections come first; they may end with an H whose ERR is within the tolerance, jump and all.
    """
    result = kick(oscillator_dir, t_step)
    found = crossings(result)
    if len(found) == 0:
        steps = result.steps[result.steps["accepted"]]
        over = steps[steps["time"] < t_step][-1]
        assert 0.1 < over["error_norm"] <= 1.0
        assert over["step_size"] < 1e-3
    else:
        (crossing,) = found
        assert crossing["time"] < t_step <= crossing["time"] + 2.0 * SMALLEST * (1 + 1e-6)
    assert result.summary["discontinuities"] == len(found)
    assert largest_error(oscillators, result, t_step) < 6e-3


def test_behind_a_jump_the_order_restarts(oscillator_dir: Path) -> None:
    """The history is cut: the polynomials behind the jump begin with one point."""
    result = kick(oscillator_dir)
    steps = result.steps
    behind = steps[steps["time"] > 1.0]
    assert behind["order"][0] == 1
    assert behind["derivative_points"][0] == 1
    assert behind["order"].max() == 3
    values_only = kick(oscillator_dir, derivative_points=0).steps
    assert values_only[values_only["time"] > 1.0]["order"][0] == 0


def test_a_declared_event_is_a_communication_point(
    oscillator_dir: Path, oscillators: ModuleType
) -> None:
    """``events``: the time itself is a point, one crossing and no search is spent on it."""
    result = kick(oscillator_dir, events=(1.0, 2.5))
    assert {1.0, 2.5} <= set(result.time.tolist())
    steps = result.steps
    assert (steps["limiting_variable"] == "event").sum() == 2
    assert result.summary["discontinuities"] == 2
    assert result.summary["double_steps_at_discontinuities"] == 2
    assert largest_error(oscillators, result) < 6e-3


def test_without_the_search_a_jump_is_stepped_over(
    oscillator_dir: Path, oscillators: ModuleType
) -> None:
    """Estimates see nothing of a jump in the second small step: the search is needed."""
    result = kick(oscillator_dir, discontinuities=False)
    assert result.summary["discontinuities"] == 0
    found = largest_error(oscillators, kick(oscillator_dir))
    assert largest_error(oscillators, result) > 5.0 * found


def test_tighter_tolerances_give_smaller_errors_beside_a_jump(
    oscillator_dir: Path, oscillators: ModuleType
) -> None:
    """A jump does not spoil the proportion of error and tolerance."""
    errors = [
        largest_error(
            oscillators,
            kick(oscillator_dir, relative_tolerance=tol, absolute_tolerance=tol),
        )
        / tol
        for tol in (1e-4, 1e-5, 1e-6)
    ]
    assert max(errors) / min(errors) < 10.0


@pytest.mark.parametrize("name", ["two_mass", "chain", "van_der_pol"])
@pytest.mark.parametrize("tolerance", quick_at([1e-4], [1e-3, 1e-4, 1e-6]))
def test_smooth_systems_give_no_alarm(oscillator_dir: Path, name: str, tolerance: float) -> None:
    """No crossing, and no double step spent on a search, where nothing jumps."""
    system = load_system(OSCILLATORS / f"{name}.toml")
    result = simulate(
        system, in_process=True, relative_tolerance=tolerance, absolute_tolerance=tolerance
    )
    assert result.summary["discontinuities"] == 0
    assert result.summary["double_steps_at_discontinuities"] == 0


def test_events_need_room() -> None:
    """An event at an end of the simulated time, or two at once, is an error before the start."""
    system = load_system(OSCILLATORS / "kick.toml")
    for events in ((1.0, 1.0 + 1e-9), (1e-9,)):
        with pytest.raises(ConfigurationError, match="too near to another event"):
            simulate(system, in_process=True, events=events)
    with pytest.raises(ConfigurationError, match="is not between start and stop time"):
        simulate(system, in_process=True, events=(11.0,))
    with pytest.raises(ConfigurationError, match="events need an estimator"):
        simulate(system, in_process=True, events=(1.0,), estimator="none")


# ---- The parts ----------------------------------------------------------------------------------


def defects(
    middle: float, end: float, expected: float = 0.0, change: float = 0.0, beside: float = 0.0
) -> Defects:
    """Defects of a double step with an input, and one beside it whose defects are all alike."""
    return Defects(
        np.array([middle, beside]),
        np.array([end, beside]),
        np.array([change, beside]),
        np.array([change, beside]),
        np.array([expected, beside]),
        np.array([expected, beside]),
        np.ones(2),
    )


def jumps(search: Search, found: Defects, step_size: float = 1.0, *, accurate: bool = True) -> bool:
    """Tell whether the first of both inputs jumps; the other one never does."""
    first, other = search.jumps(found, step_size, is_accurate=accurate).tolist()
    assert not other
    return bool(first)


@given(st.floats(0.0, 1e9))
def test_each_input_is_judged_by_itself(beside: float) -> None:
    """Law: what another input's defects are says nothing of one that jumps, or does not."""
    nothing = Search.nothing(2)
    assert jumps(nothing, defects(0.0, 5.0, beside=beside))
    assert not jumps(nothing, defects(0.0, 5.0, expected=0.6, beside=beside))


def test_a_surprise_in_the_second_step_is_a_jump_that_no_estimate_sees() -> None:
    """Ten times what was expected and twice the change foreseen; never one of the first step."""
    nothing = Search.nothing(2)
    assert jumps(nothing, defects(0.0, 5.0))
    assert not jumps(nothing, defects(0.0, 0.9))
    assert not jumps(nothing, defects(0.0, 5.0, expected=0.6))
    assert not jumps(nothing, defects(0.0, 5.0, change=3.0))
    assert not jumps(nothing, defects(6.0, 5.0))
    assert not jumps(nothing, defects(np.nan, np.nan))


def test_a_great_surprise_in_the_first_step_is_a_jump_where_err_is_content() -> None:
    """Fifty times what was expected; nothing where ERR rejects, as H will shrink then."""
    nothing = Search.nothing(2)
    assert jumps(nothing, defects(100.0, 0.0, expected=1.0))
    assert not jumps(nothing, defects(100.0, 0.0, expected=1.0), accurate=False)
    assert not jumps(nothing, defects(40.0, 0.0, expected=1.0))
    assert not jumps(nothing, defects(100.0, 0.0, expected=np.inf))  # nothing is known


def test_a_defect_that_stays_while_the_step_shrinks() -> None:
    """Only a much smaller step says something; a smooth defect is gone by then."""
    search = Search.nothing(2).after_rejection(1.0, defects(8.0, 0.0))
    assert jumps(search, defects(7.0, 0.0), 0.2, accurate=False)
    assert not jumps(search, defects(7.0, 0.0), 0.5, accurate=False)
    assert not jumps(search, defects(3.0, 0.0), 0.2, accurate=False)
    assert not jumps(search, defects(7.0, 0.0, change=20.0), 0.2, accurate=False)
    assert not jumps(Search.nothing(2), defects(7.0, 0.0), 0.2, accurate=False)


def test_false_alarms_teach_and_jumps_are_believed_again() -> None:
    """Law: after each false alarm a defect must be larger, of that input alone, until it jumps."""
    search = Search.nothing(2)
    sizes = []
    for _ in range(3):
        size = 1.01
        while not jumps(search, defects(0.0, size)):
            size *= 1.1
        sizes.append(size)
        times = DoubleStepTimes.from_step_size(0.0, 1.0)
        search = search.found(times, defects(0.0, size), np.array([True, False]), 1e-9)
        search = search.passed(2.0)  # no jump was met
        assert search.end is None
        assert search.doubts[1] == 1.0
    assert sizes[2] > 3.0 * sizes[1] > 9.0 * sizes[0]
    times = DoubleStepTimes.from_step_size(2.0, 1.0)
    found = search.found(times, defects(0.0, 1e6), np.array([True, False]), 1e-9)
    assert found.crossed().doubts.tolist() == [1.0, 1.0]


def test_a_search_keeps_to_the_inputs_that_it_began_with() -> None:
    """A defect of another input does not mislead it, nor a small part of the jump's size.

    A larger part is met: several jumps of an input may lie in one bracket.
    """
    times = DoubleStepTimes.from_step_size(0.0, 1.0)
    search = Search.nothing(2).found(times, defects(0.0, 100.0), np.array([True, False]), 1e-9)
    assert jumps(search, defects(0.0, 100.0, beside=1e6))
    assert jumps(search, defects(0.0, 40.0, beside=1e6))
    assert not jumps(search, defects(0.0, 9.0, beside=1e6))


@given(st.floats(0.0, 1.0), st.floats(1e-6, 1.0))
def test_the_search_halves_the_bracket(jump: float, size: float) -> None:
    """Law: with exact knowledge of where a jump shows, the bracket shrinks to the smallest H."""
    time, smallest = 0.0, 1e-9
    place = max(jump * size, 2e-9)
    first = DoubleStepTimes.from_step_size(0.0, size / 2.0)
    jumping = np.array([True, False])
    search, attempts = Search.nothing(2), 0
    search = search.found(first, defects(float(place <= first.middle), 1.0), jumping, smallest)
    for _ in range(200):
        h = search.step_size(time, size, smallest)
        attempts += 1
        times = DoubleStepTimes.from_step_size(time, h)
        is_inside = place <= times.end
        if h <= smallest and is_inside:
            break
        if is_inside:
            seen = defects(float(place <= times.middle), 1.0)
            search = search.found(times, seen, jumping, smallest)
        elif search.looks_at_point:
            search = search.not_at_point()
        else:
            search, time = search.passed(times.end), times.end
            assert search.end is not None
    assert time <= place <= time + 8.0 * smallest
    assert attempts <= 100
