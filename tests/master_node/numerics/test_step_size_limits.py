"""Laws of the slaves' rules for the size of their steps."""

from __future__ import annotations

from fractions import Fraction
from math import ulp
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from master_node import System, load_system, simulate
from master_node.numerics.step_size_limits import (
    SlaveLimits,
    StepSizeLimits,
    StepSizeLimitsError,
)
from protocol.errors import ConfigurationError
from tests.support.quarter_car_case import EXAMPLES

decimals = st.integers(1, 400).map(lambda n: n / 1000)


@given(
    st.lists(decimals, min_size=1, max_size=3),
    st.floats(1e-4, 1.0),
    st.integers(1, 60),
    st.sampled_from([0.0, 0.1, 2.5, -1.2]),
)
def test_steps_are_multiples_and_end_on_the_target(
    multiples: list[float], wanted: float, units: int, origin: float
) -> None:
    """Law: with any multiples, H is a multiple of all, and the last double step ends on the target.

    The points are the nearest numbers to origin + n quantum: nothing adds up. Only a point more
    than twice as far from 0 may be one that no size leads to: then the step ends just before it.
    """
    rules = [SlaveLimits(f"s{i}", step_multiple=m) for i, m in enumerate(multiples)]
    limits = StepSizeLimits.of(rules, 1e-9, 1e6, long_step=False)
    assert limits.quantum is not None
    for multiple in multiples:
        assert limits.quantum % Fraction(str(multiple)) == 0
    zero = Fraction(str(origin))
    target = float(zero + 2 * units * limits.quantum)
    time = before = origin
    for _ in range(4 * units + 4):
        if limits.has_reached(time, target):
            break
        times = limits.times(origin, time, wanted, target)
        assert times.begin == time
        number = Fraction(repr(times.step_size)) / limits.quantum
        assert abs(number - round(number)) < 1e-12
        assert times.step_size <= max(wanted, float(limits.quantum)) * (1 + 1e-15)
        before = time
        for point, size in ((times.middle, times.first), (times.end, times.second)):
            assert size == pytest.approx(times.step_size, abs=4 * ulp(abs(origin) + abs(target)))
            steps = round((Fraction(point) - zero) / limits.quantum)
            near = float(zero + steps * limits.quantum)
            is_exact = 0.0 < point <= 2.0 * before or before == 0.0
            assert point == near if is_exact else near - ulp(size) <= point <= near
            before = point
        time = times.end
    assert limits.has_reached(time, target)
    assert time == target or target > 2.0 * before


@given(st.floats(1e-3, 1.0), st.floats(0.1, 10.0), st.floats(-5.0, 5.0))
def test_without_rules_the_last_double_step_ends_on_the_target(
    wanted: float, span: float, begin: float
) -> None:
    """Law: free steps end exactly on the target, and none is longer than what is wanted."""
    limits = StepSizeLimits.of([], 1e-12, 1e6, long_step=False)
    target, time = begin + span, begin
    assume(target > begin)
    while not limits.has_reached(time, target):
        times = limits.times(begin, time, wanted, target)
        assert times.first <= wanted * (1 + 1e-12)
        assert times.begin < times.middle < times.end <= target
        time = times.end
    assert time == target or target > 2.0 * times.middle


def test_bounds_of_slaves_and_of_the_simulation_meet() -> None:
    """The tightest bounds win; those of a slave count for its longest step, 2H with EST_Rich."""
    rules = [
        SlaveLimits("a", smallest_step_size=1e-3, largest_step_size=0.5),
        SlaveLimits("b", smallest_step_size=2e-3, largest_step_size=0.3),
    ]
    short = StepSizeLimits.of(rules, 1e-9, 1.0, long_step=False)
    assert (short.smallest, short.largest) == (2e-3, 0.3)
    long = StepSizeLimits.of(rules, 1e-9, 1.0, long_step=True)
    assert (long.smallest, long.largest) == (2e-3, 0.15)


@pytest.mark.parametrize(
    ("rules", "long_step", "words"),
    [
        (
            [SlaveLimits("a", step_size=0.1), SlaveLimits("b", step_size=0.2)],
            False,
            ["a takes", "0.1 s", "b", "0.2 s"],
        ),
        (
            [SlaveLimits("a", step_size=0.1), SlaveLimits("b", step_multiple=0.03)],
            False,
            ["a takes", "no multiple of 0.03 s"],
        ),
        ([SlaveLimits("a", step_size=0.1)], True, ["a takes", "EST_Rich"]),
        (
            [SlaveLimits("a", smallest_step_size=0.2), SlaveLimits("b", largest_step_size=0.1)],
            False,
            ["0.2 s (of a)", "0.1 s (of b)"],
        ),
        (
            [SlaveLimits("a", step_multiple=0.3), SlaveLimits("b", largest_step_size=0.1)],
            False,
            ["0.3 s (of the common multiple)", "(of b)"],
        ),
    ],
)
def test_rules_that_contradict_each_other_are_named(
    rules: list[SlaveLimits], long_step: bool, words: list[str]
) -> None:
    """Impossible combinations are errors that name the slaves and their sizes."""
    with pytest.raises(StepSizeLimitsError) as caught:
        StepSizeLimits.of(rules, 1e-9, 1.0, long_step=long_step)
    for word in words:
        assert word in str(caught.value)


def test_a_span_that_is_no_even_number_of_steps_is_refused() -> None:
    """0 to 1 s in steps of 0.2 s are five steps: no double steps end there."""
    limits = StepSizeLimits.of([SlaveLimits("a", step_size=0.2)], 1e-9, 1.0, long_step=False)
    with pytest.raises(StepSizeLimitsError, match=r"no even number of steps of 0\.2 s"):
        limits.check_span(0.0, 1.0)
    limits.check_span(0.0, 1.2)
    limits.check_span(0.0, 1.0, together=1)


# ---- Whole runs ---------------------------------------------------------------------------------


def car(fmu_dir: Path, **wheel: float) -> System:
    """The quarter car with rules for the wheel."""
    system = load_system(EXAMPLES / "displacement.toml")
    slaves = {
        name: slave.model_dump(exclude_unset=True) | {"model": str(fmu_dir / f"{name}.fmu")}
        for name, slave in system.slaves.items()
    }
    slaves["wheel"] |= wheel
    return System(
        simulation={"stop_time": 1.0, "relative_tolerance": 0.1, "absolute_tolerance": 0.1},
        slaves=slaves,
        connections=system.connections,
    )


@settings(max_examples=8, deadline=None)
@given(st.sampled_from([1e-3, 2e-3, 2.5e-3, 5e-3]), st.sampled_from(["mod", "rich"]))
def test_every_step_of_a_run_follows_a_multiple(
    fmu_dir: Path, multiple: float, estimator: str
) -> None:
    """All communication points of a run are multiples, rejected attempts included."""
    result = simulate(car(fmu_dir, step_multiple=multiple), in_process=True, estimator=estimator)
    points = np.concatenate([result.time, result.steps["time"] + result.steps["step_size"]])
    numbers = points / multiple
    assert np.abs(numbers - np.round(numbers)).max() < 1e-9
    assert result.time[-1] == 1.0


def test_a_slave_with_one_step_size_gets_no_other(fmu_dir: Path) -> None:
    """``step_size`` fixes H for all; the error is still estimated."""
    result = simulate(car(fmu_dir, step_size=2e-3), in_process=True, initial_step_size=1e-3)
    assert set(result.steps["step_size"].tolist()) == {2e-3}
    assert len(result.time) == 501
    assert np.isfinite(result.steps["error_norm"]).all()


def test_bounds_of_a_slave_hold_in_a_run(fmu_dir: Path) -> None:
    """No step is longer than the slave takes."""
    result = simulate(car(fmu_dir, largest_step_size=4e-3), in_process=True)
    assert result.steps["step_size"].max() == 4e-3
    result = simulate(car(fmu_dir, largest_step_size=4e-3), in_process=True, estimator="rich")
    assert result.steps["step_size"].max() == 2e-3


def test_an_impossible_rule_is_an_error_before_the_start(fmu_dir: Path) -> None:
    """The message names the system and both rules; nothing was started."""
    with pytest.raises(ConfigurationError, match="no communication step size suits all") as caught:
        simulate(car(fmu_dir, step_size=2e-3), in_process=True, estimator="rich")
    assert "wheel takes steps of 0.002 s only" in str(caught.value)
    with pytest.raises(ConfigurationError, match=r"0\.002 s"):
        simulate(car(fmu_dir, step_size=2e-3), estimator="none", initial_step_size=1e-3)
