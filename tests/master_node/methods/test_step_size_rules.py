"""Rules of slaves for the size of their steps, in whole runs: every do_step of every slave."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from master_node import Result, System
from master_node.coupling.step_sizes import check_step_sizes
from master_node.numerics.double_step_times import step_end
from master_node.numerics.step_size_limits import (
    SlaveLimits,
    StepSizeLimits,
    StepSizeLimitsError,
)
from protocol.calls import StepResult
from protocol.description import Capabilities, StateKind
from protocol.errors import ConfigurationError, StepSizeError
from protocol.slave import Slave
from tests.support.quarter_car_case import (
    ALL,
    CHASSIS,
    DISPLACEMENT,
    STATES,
    WHEEL,
    LinearSlave,
    car,
    exact_solution,
    run_slaves,
)

STOP = 0.24
Rules = Mapping[str, float]


class Timed(LinearSlave):
    """Notes where its do_steps begin and how long they are."""

    def __init__(self, *arguments: Any) -> None:
        self.steps: list[tuple[float, float]] = []
        super().__init__(*arguments)

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.steps.append((communication_point, step_size))
        return super().do_step(communication_point, step_size, prior)


def run(
    chassis: Rules, wheel: Rules, can: Capabilities = ALL, **simulation: Any
) -> tuple[Result, dict[str, Timed]]:
    """The car under these rules, with loose tolerances."""
    slaves = {
        "chassis": Timed(CHASSIS, np.zeros(2), can),
        "wheel": Timed(WHEEL, np.zeros(2), can),
    }
    loose = {"relative_tolerance": 0.1, "absolute_tolerance": 0.1}
    system = System(
        simulation={"stop_time": STOP, **loose, **simulation},
        slaves={"chassis": dict(chassis), "wheel": dict(wheel)},
        connections=DISPLACEMENT,
    )
    given_slaves: dict[str, Slave] = dict(slaves)
    found = run_slaves(system, given_slaves)
    if found.error is not None:
        raise found.error
    return found.result, slaves


def assert_obeyed(rules: Rules, slave: Timed) -> None:
    """By each do_step, up to the rounding of a difference of times."""
    sizes = np.array([size for _, size in slave.steps])
    slack = 1e-12
    if "step_size" in rules:
        assert sizes == pytest.approx(np.full(len(sizes), rules["step_size"]), rel=slack)
    if "step_multiple" in rules:
        numbers = sizes / rules["step_multiple"]
        assert numbers == pytest.approx(np.round(numbers), rel=1e-9)
        assert numbers.min() > 0.5
    assert sizes.min() >= rules.get("smallest_step_size", 0.0) - slack
    assert sizes.max() <= rules.get("largest_step_size", STOP) + slack


def rules_of(multiples: st.SearchStrategy[float]) -> st.SearchStrategy[Rules]:
    """Some rules of a slave; each may be missing."""
    return st.fixed_dictionaries(
        {},
        optional={
            "step_multiple": multiples,
            "smallest_step_size": st.sampled_from([1e-4, 1e-3, 1.5e-3]),
            "largest_step_size": st.sampled_from([4e-3, 5e-3, 0.013]),
        },
    )


some_rules = rules_of(st.sampled_from([1e-4, 5e-4, 1e-3]))


@settings(max_examples=30)
@example({"smallest_step_size": 1.5e-3, "largest_step_size": 5e-3}, {}, "rich", "jacobi", (0.08,))
@given(
    some_rules,
    some_rules,
    st.sampled_from(["rich", "mod"]),
    st.sampled_from(["jacobi", "gauss-seidel"]),
    st.sampled_from([(), (0.08,), (0.08, 0.16)]),
)
def test_every_do_step_of_every_slave_obeys_its_rules(
    chassis: Rules, wheel: Rules, estimator: str, sequence: str, events: tuple[float, ...]
) -> None:
    """Law: whatever the rules, the steps keep to them, and end exactly on the stop time.

    Long comparison steps and rejected attempts too, and those at declared events.
    """
    options = {"estimator": estimator, "sequence": sequence, "events": events, "order": 2}
    result, slaves = run(chassis, wheel, **options)
    assert_obeyed(chassis, slaves["chassis"])
    assert_obeyed(wheel, slaves["wheel"])
    assert result.time[-1] == STOP


bounds = st.integers(1, 60).map(lambda n: n / 100)


@given(
    st.lists(st.sampled_from([0.01, 0.02, 0.05, 0.03]), max_size=2),
    bounds,
    st.integers(3, 9),
    st.tuples(st.integers(1, 100), st.booleans()),
    st.lists(bounds, min_size=1, max_size=8),
)
@example([0.03], 0.03, 8, (9, True), [0.21, 0.24])  # no size up to 0.24 leads from 0.42 to 0.9
@example([0.03], 0.03, 8, (9, False), [0.21, 0.24])
def test_the_bounds_hold_to_the_last_step(
    multiples: list[float],
    smallest: float,
    factor: int,
    way: tuple[int, bool],
    wanted: list[float],
) -> None:
    """Law: whatever H is wanted, what is taken keeps to all rules on the whole way to the target.

    The stop time is met to the last bit. So is an event, unless sizes that are rounded sums of
    times and not above the largest H end by that rounding before it, and never behind it.

    Where there is any way at all: a target that is nearer than two of the smallest steps, or that
    can only be reached with too large or too small ones, has none.
    """
    rules = [SlaveLimits(f"s{i}", step_multiple=m) for i, m in enumerate(multiples)]
    largest = round(factor * smallest, 2)
    rules.append(SlaveLimits("t", smallest_step_size=smallest, largest_step_size=largest))
    length, stops = way
    target = length / 10
    try:
        stop_time = target if stops else math.inf
        limits = StepSizeLimits.of(rules, 1e-9, 1e3, long_step=False, stop_time=stop_time)
        limits.check_span(0.0, target)
    except StepSizeLimitsError:
        return
    quantum = float(limits.quantum or 0.0)
    if largest < 3.0 * (smallest + quantum) or target < 2.0 * (smallest + quantum):
        return
    time, number = 0.0, 0
    while not limits.has_reached(time, target):
        size = min(limits.largest, max(limits.smallest, wanted[number % len(wanted)]))
        times = limits.times(0.0, time, size, target)
        assert smallest - 1e-12 <= times.first <= largest
        assert smallest - 1e-12 <= times.second <= largest
        for multiple in multiples:
            assert Fraction(repr(times.step_size)) % Fraction(repr(multiple)) == 0
        assert times.end > time
        time, number = times.end, number + 1
    assert time == target if stops else 0.0 <= target - time <= 4.0 * math.ulp(target)


@given(st.floats(-1e9, 1e9), st.floats(1e-3, 1.0), st.integers(0, 40), st.floats(1.0, 1.9))
def test_rounding_makes_no_gap(begin: float, smallest: float, number: int, ratio: float) -> None:
    """Law: a way of some double steps of the smallest H is one, wherever it begins.

    Steps between close bounds fill few distances, and rounding must not miss these.
    """
    limits = StepSizeLimits(smallest, ratio * smallest)
    target, time = begin, begin
    for _ in range(number):
        target += 2.0 * smallest
    assert limits.leads(begin, begin, target)
    slack = 1e-6 * smallest + 1e-15 * abs(begin)
    while not limits.has_reached(time, target):
        times = limits.times(begin, time, smallest, target)
        assert smallest - slack <= times.first <= limits.largest + slack
        time = times.end
    assert time == target or target > 2.0 * times.middle


def test_what_no_double_steps_fill_is_told() -> None:
    """Double steps of 3 to 4 ms fill neither 4.5 ms behind an event nor 5.9 ms before one."""
    limits = {"smallest_step_size": 1.5e-3, "largest_step_size": 2e-3}
    for setting in ({"stop_time": 0.086}, {"events": (0.0074,)}):
        with pytest.raises(ConfigurationError, match=r"there are no double steps of two times"):
            run({}, {}, **{"events": (0.08,), **limits, **setting})


def test_a_step_size_that_cannot_be_smaller_is_not_tried_for_ever() -> None:
    """7.4 ms are two double steps of 1.7 ms and more, where H may be 1.5 ms elsewhere."""
    limits = {"smallest_step_size": 1.5e-3, "largest_step_size": 2e-3, "stop_time": 7.4e-3}
    with pytest.raises(StepSizeError, match=r"rejected at the smallest .* step size"):
        run({}, {}, **limits, relative_tolerance=1e-9, absolute_tolerance=1e-12, order=0)


@pytest.mark.parametrize("estimator", ["mod", "rich", "none"])
def test_time_goes_on_where_numbers_are_far_apart(estimator: str) -> None:
    """At 1e9 s neighbouring numbers are 0.12 µs apart, so H is not a nanosecond.

    A fixed step that is no larger than that is told before anything starts.
    """
    span = {"start_time": 1e9, "stop_time": 1e9 + 0.5, "estimator": estimator}
    result, _ = run({}, {}, **span)
    assert result.time[-1] == span["stop_time"]
    assert (np.diff(result.time) > 0.0).all()
    limits = {"initial_step_size": 1e-7, "largest_step_size": 1e-7}
    with pytest.raises(ConfigurationError, match=r"the numbers near t=1000000000\.5 s"):
        check_step_sizes(System(simulation={**span, **limits}, slaves={"chassis": {}}))


@pytest.mark.parametrize("rollback", [True, False])
def test_slaves_keep_up_with_the_time(rollback: bool) -> None:
    """Law: of an autonomous system it makes no difference when it starts.

    At 1.7e9 s, today in seconds since 1970, neighbouring numbers are 0.24 µs apart. T + H is
    rounded to one of them, the same way in step after step of the same H, and slaves that took H
    itself would get ahead of the time: the states would be wrong by 1e-2.
    """
    slaves = {"chassis": CHASSIS.slave(), "wheel": WHEEL.slave()}
    if not rollback:
        for slave in slaves.values():
            slave.description = replace(slave.description, state_kind=StateKind.NONE)
    system = car(
        start_time=1.7e9,
        stop_time=1.7e9 + 0.25,
        initial_step_size=1.01e-4,
        largest_step_size=1.01e-4,
        relative_tolerance=0.1,
        absolute_tolerance=0.1,
    )
    found = run_slaves(system, slaves)
    assert found.error is None
    states = np.stack([found.result[name] for name in STATES], axis=1)
    exact = exact_solution(found.result.time - 1.7e9)
    assert np.abs(states - exact).max() < 1e-5


@given(st.floats(-2e9, 2e9), st.floats(1e-6, 1e3))
def test_a_step_is_the_way_to_its_end_and_not_above_h(begin: float, step_size: float) -> None:
    """Law: who adds up sizes has the time, to twelve digits of H, and a slave that may take no more
    than H is never asked to; H is halved at most, where numbers are as far apart as it is long.
    """
    end, size = step_end(begin, step_size)
    assert begin < end
    assert abs((end - begin) - size) <= 1e-12 * step_size
    assert size <= step_size or end == math.nextafter(begin, math.inf)
    assert size > 0.5 * step_size


class OnTime(LinearSlave):
    """Knows its time to the last bit, also after it was set back."""

    def __init__(self, *arguments: Any) -> None:
        self.time = 0.0
        self.times: list[tuple[object, float]] = []
        super().__init__(*arguments)

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        assert communication_point == self.time
        self.time = communication_point + step_size
        return super().do_step(communication_point, step_size, prior)

    def get_state(self) -> object:
        """See `Slave`."""
        state = super().get_state()
        self.times.append((state, self.time))
        return state

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        super().set_state(state)
        self.time = next(time for kept, time in self.times if kept is state)


@pytest.mark.parametrize("estimator", ["mod", "rich"])
@pytest.mark.parametrize("sequence", ["jacobi", "gauss-seidel"])
def test_every_do_step_begins_where_its_slave_stands(estimator: str, sequence: str) -> None:
    """Law: after accepted, rejected and compared steps T is the time of the slave's state."""
    slaves = {"chassis": OnTime(CHASSIS, np.zeros(2)), "wheel": OnTime(WHEEL, np.zeros(2))}
    system = car(estimator=estimator, sequence=sequence, stop_time=0.1, initial_step_size=0.02)
    found = run_slaves(system, slaves)
    assert found.error is None, found.error
    assert found.result.summary["rejected_double_steps"] > 0
    assert {slave.time for slave in slaves.values()} == {0.1}


@pytest.mark.parametrize("controller", ["elementary", "pi"])
def test_a_fine_grid_makes_no_difference_to_the_control(controller: str) -> None:
    """Law: where H is a multiple of a microsecond it follows the error as it does without a grid.

    The nearest multiple is below what the control wants, which is no reason to keep to what was
    wanted: as many double steps are rejected as without.
    """
    counts = []
    for rules in ({}, {"step_multiple": 1e-6}):
        system = car(controller=controller, order=0, stop_time=1.0, largest_step_size=0.1)
        for name in system.slaves:
            system = system.with_slave(name, **rules)
        found = run_slaves(system, {"chassis": CHASSIS.slave(), "wheel": WHEEL.slave()})
        assert found.error is None
        accepted = found.result.steps["accepted"]
        counts.append((int(accepted.sum()), int((~accepted).sum())))
    (free, rejected), (on_grid, rejected_on_grid) = counts
    assert on_grid == pytest.approx(free, rel=0.03)
    assert abs(rejected_on_grid - rejected) <= 2


def test_a_slave_of_one_step_size_among_others() -> None:
    """A slave that cannot change its step size is controlled when its size is given.

    There is nothing to change, so an error that is too large ends the run; EST_Rich, which takes
    steps of 2H, is refused.
    """
    can = Capabilities(can_get_and_set_state=True, can_interpolate_inputs=True)
    with pytest.raises(ConfigurationError, match=r"give \[slaves\.chassis\] step_size"):
        run({}, {}, can)
    rules = {"step_size": 2e-3}
    result, slaves = run(rules, rules, can)
    for slave in slaves.values():
        assert_obeyed(rules, slave)
    assert len(result.time) == 121
    with pytest.raises(ConfigurationError, match=r"takes steps of 0\.002 s only"):
        run(rules, rules, can, estimator="rich")


def test_multiples_of_slaves_meet() -> None:
    """H is a multiple of 2 ms and of 3 ms: of 6 ms."""
    result, _ = run({"step_multiple": 2e-3}, {"step_multiple": 3e-3}, order=2)
    assert np.diff(result.time) / 6e-3 == pytest.approx(np.round(np.diff(result.time) / 6e-3))
    with pytest.raises(ConfigurationError, match=r"no even number of steps of 0\.006 s"):
        run({"step_multiple": 2e-3}, {"step_multiple": 3e-3}, stop_time=0.25)


def test_points_on_a_grid_do_not_drift() -> None:
    """Law: hundreds of steps later a point is still n times 0.1 ms, to the last bit."""
    result, _ = run({"step_multiple": 1e-4}, {}, relative_tolerance=1e-3, absolute_tolerance=1e-3)
    numbers = np.round(result.time / 1e-4)
    assert result.time.tolist() == [float(Fraction(int(n), 10000)) for n in numbers]
