"""Trial steps: the verdicts on saved states, internal clocks, steps that depend on their size."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.calls import Examine, ExitInitializationMode, GetOutputs, Initialize, Reset
from protocol.description import Examination, StateKind, StateVerdict
from protocol.errors import FatalSlaveError
from protocol.slave import Slave
from protocol.variables import Causality
from slave_node.execution.executor import Executor
from slave_node.loading import load_slave
from tests.support.jump_models import ExactSlave
from tests.support.quarter_car_case import ALL
from tests.support.trial_slaves import (
    BoundedSlave,
    BrokenSlave,
    ClockedSlave,
    EulerSlave,
    LosingSlave,
    NotRepeatingSlave,
    RestartingSlave,
    StaleSlave,
    TimedSlave,
    described,
    examine,
)

H = 4e-3


def assert_left_as_it_was(slave: TimedSlave) -> None:
    """It stands at its start, and no state is saved any more."""
    assert slave.time is None
    assert np.array_equal(slave.x, [0.1, 0.0])
    assert not slave.saved


# ---- Saved states -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "verdict", "reason"),
    [
        (TimedSlave, StateVerdict.EXACT, ""),
        (RestartingSlave, StateVerdict.RESTARTS_SOLVER, "repeat, but differ"),
        (LosingSlave, StateVerdict.DOES_NOT_RESTORE, "times the tolerance"),
        (NotRepeatingSlave, StateVerdict.DOES_NOT_REPEAT, "the second time"),
        (BrokenSlave, StateVerdict.BROKEN, "fmi2SetFMUstate returned fmi2Error"),
        (StaleSlave, StateVerdict.EXACT, "right after a restore are not those that were saved"),
    ],
)
def test_the_verdicts(make: Callable[[], TimedSlave], verdict: StateVerdict, reason: str) -> None:
    """Each with a slave that has just that fault; whatever it is, no saved state is left behind."""
    slave = make()
    found = examine(slave, 0.0, H)
    assert found.state_verdict is verdict
    assert reason in found.state_reason
    assert bool(found.state_reason) is bool(reason)
    assert not slave.saved
    if verdict in (StateVerdict.RESTARTS_SOLVER, StateVerdict.DOES_NOT_REPEAT):
        assert 0.0 < found.difference < 1e-3
    if verdict is StateVerdict.EXACT:
        assert_left_as_it_was(slave)


def test_a_slave_that_saves_no_state_is_left_alone() -> None:
    """It could not go back."""
    slave = TimedSlave()
    described(slave, state_kind=StateKind.NONE, state_reason="it cannot")
    assert examine(slave, 0.0, H) == Examination(StateVerdict.NOT_TESTED, "it cannot")
    assert not slave.steps


def test_a_slave_at_rest_shows_nothing_and_that_is_said() -> None:
    """Nothing moves, so nothing could differ."""
    found = examine(TimedSlave(x=(0.0, 0.0)), 0.0, H)
    assert found == Examination(StateVerdict.EXACT, "no output moved in the trial steps")


def test_trial_steps_that_are_too_long_are_made_smaller() -> None:
    """A slave that rejects steps is not one whose states are broken."""
    assert examine(BoundedSlave(0.1 * H), 0.0, H).state_verdict is StateVerdict.EXACT
    found = examine(BoundedSlave(1e-9 * H), 0.0, H)
    assert found.state_verdict is StateVerdict.NOT_TESTED
    assert "too long" in found.state_reason


def test_no_trial_step_is_shorter_than_the_smallest_one() -> None:
    """The smallest step size of the slave holds in trials too, however they shorten steps."""
    shortest = []
    for smallest in (0.0, 0.5 * H):
        slave = TimedSlave()
        found = examine(slave, 0.0, H, smallest_step=smallest)
        assert found.state_verdict is StateVerdict.EXACT
        shortest.append(min(size for _, size in slave.steps))
    assert shortest[0] < 0.5 * H <= shortest[1]
    found = examine(BoundedSlave(0.1 * H), 0.0, H, smallest_step=0.5 * H)
    assert "too long" in found.state_reason  # and not that shorter ones are too short


def test_a_fatal_error_is_no_verdict() -> None:
    """After it nothing may be called any more, so the executor must know."""
    with pytest.raises(FatalSlaveError):
        examine(BrokenSlave(FatalSlaveError), 0.0, H)


def test_a_slave_with_fixed_steps_is_examined_with_these() -> None:
    """And with no other."""
    slave = TimedSlave()
    described(slave, fixed_step_size=3e-3)
    assert examine(slave, 0.0, H).state_verdict is StateVerdict.EXACT
    assert {size for _, size in slave.steps} == {3e-3}


# ---- Internal clocks ----------------------------------------------------------------------------

MOVED = {"inputs": (0.0, 0.0), "input_changes": (0.01, 0.1)}
"""Inputs of `CHASSIS`: a slave that answers to them at ticks only has a clock, however slow."""


@given(st.floats(-2.2, 1.4), st.integers(2, 4))
def test_every_clock_is_found_to_the_last_digit(exponent: float, digits: int) -> None:
    """Periods of few digits, from far below the trial step to far above it."""
    period = float(f"{H * 10.0**exponent:.{digits - 1}e}")
    slave = ClockedSlave(period)
    found = examine(slave, 0.0, H, **MOVED)
    assert found.internal_clock == period
    assert found.state_verdict is StateVerdict.EXACT
    assert_left_as_it_was(slave)


@pytest.mark.parametrize("frequency", [60, 300, 7])
def test_frequencies_are_found_too(frequency: int) -> None:
    """A period without few digits is the reciprocal of a whole number."""
    found = examine(ClockedSlave(1.0 / frequency), 0.0, 0.02, **MOVED)
    assert found.internal_clock == 1.0 / frequency


@pytest.mark.parametrize("make", [TimedSlave, EulerSlave, RestartingSlave])
def test_no_clock_where_there_is_none(make: Callable[[], TimedSlave]) -> None:
    """Every step, however small, moves the outputs."""
    assert examine(make(), 0.0, H).internal_clock is None


def test_single_events_are_no_clock() -> None:
    """An output that moves at times that are not equally distant."""

    class Eventful(ClockedSlave):
        def _ticks(self, time: float) -> int:
            return sum(time >= event for event in (3 * H, 10 * H, 12 * H, 25 * H))

    assert examine(Eventful(H), 0.0, H).internal_clock is None


def sampled(
    signal: Callable[[float], float], period: float, factors: int = 0, power: int = 1, **more: Any
) -> float | None:
    """The clock of a signal that is sampled at ticks, times powers of inputs that are not.

    Trial steps are 32 s long at most.
    """

    class Sampled(ExactSlave):
        def read(self, t: float, x: np.ndarray, u: np.ndarray) -> list[list[float]]:
            ticks = math.floor(t / period + 1e-9)
            return [[signal(ticks * period) * float(np.prod(u[0] ** power))], [0.0]]

    slave = Sampled([f"u_{i}" for i in range(factors)], ("y",))
    described(slave, capabilities=replace(ALL, max_output_derivative_order=0))
    ones = {"inputs": (1.0,) * factors, "input_changes": (0.01,) * factors}
    return examine(slave, 0.0, 1.0, 1e-4, 1e-4, **ones, **more).internal_clock


@pytest.mark.parametrize("factors", [0, 1])
@pytest.mark.parametrize("period", [0.05, 1.0, 10.0])
def test_a_signal_that_switches_is_no_clock(period: float, factors: int) -> None:
    """Many times or few, with a gain that follows an input at any time or without inputs."""
    for power in (0, 1):  # an input to which nothing answers is as good as none

        def pulses(t: float) -> float:
            return float(round(t / period) % 2)

        assert sampled(pulses, period, factors, power) is None


@pytest.mark.parametrize("factors", [0, 1])
def test_fine_samples_of_a_smooth_signal_have_a_clock_and_few_ticks_have_none(factors: int) -> None:
    """Samples of a sine from where it rises, and of a cosine from where it begins to fall."""
    for signal in (math.sin, math.cos):
        assert sampled(signal, 0.01, factors, largest_step=0.04) == 0.01
        assert sampled(signal, 0.01, factors, largest_step=0.039) is None


# ---- Step dependence ----------------------------------------------------------------------------


def test_one_step_per_do_step_is_noticed_and_bounded() -> None:
    """A tenth of the tolerance is the most by which 2h differs from h + h at the size that is said,
    and at a somewhat larger one it is more.
    """
    slave = EulerSlave()
    found = examine(slave, 0.0, H, 1e-4, 1e-4)
    assert found.step_dependence > 1.0
    assert found.largest_substep is not None
    assert_left_as_it_was(slave)

    def difference(size: float) -> float:
        ends = []
        for steps in ((2.0 * size,), (size, size)):
            one, time = EulerSlave(), 0.0
            for step in steps:
                one.do_step(time, step, True)
                time += step
            ends.append(one.get_outputs(0)[0])
        scale = 1e-4 + 1e-4 * np.abs(ends).max(axis=0)
        return float(np.sqrt(np.mean(((ends[0] - ends[1]) / scale) ** 2)))

    assert difference(found.largest_substep) == pytest.approx(0.1, rel=0.05)


def test_the_tolerance_weighs_the_difference() -> None:
    """A hundred times the tolerance allows Euler steps ten times as long."""
    sizes = [examine(EulerSlave(), 0.0, H, tol, tol).largest_substep for tol in (1e-6, 1e-4)]
    assert sizes[0] is not None
    assert sizes[1] is not None
    assert sizes[1] / sizes[0] == pytest.approx(10.0, rel=0.1)
    loose = examine(EulerSlave(), 0.0, H, 0.1, 0.1)
    assert loose.step_dependence < 1.0
    assert loose.largest_substep is None


def test_an_exact_solver_depends_on_nothing() -> None:
    """Up to rounding."""
    found = examine(TimedSlave(), 0.0, H)
    assert found.step_dependence < 1e-6
    assert found.largest_substep is None


# ---- Real FMUs ----------------------------------------------------------------------------------

Load = Callable[[str], Slave]


@pytest.fixture
def load(capability_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Load]:
    """Loads an FMU of the collection, initialized with inputs of 0.01."""
    slaves: list[Slave] = []

    def make(name: str) -> Slave:
        slave = load_slave(f"{name}.fmu", capability_dir, name, tmp_path_factory.mktemp(name))
        slaves.append(slave)
        names: dict[Causality, list[str]] = {
            causality: [v.name for v in slave.description.of(causality) if v.is_continuous_real]
            for causality in (Causality.INPUT, Causality.OUTPUT)
        }
        slave.initialize(
            Initialize(
                start_time=0.0,
                stop_time=None,
                relative_tolerance=1e-6,
                start_values={},
                inputs=names[Causality.INPUT],
                outputs=names[Causality.OUTPUT],
            )
        )
        slave.exit_initialization_mode()
        slave.set_inputs(np.full((1, len(names[Causality.INPUT])), 0.01))
        return slave

    yield make
    for slave in slaves:
        slave.close()


@pytest.mark.parametrize(
    ("name", "verdict"),
    [
        ("chassis_no_derivatives", StateVerdict.EXACT),
        ("plain_lag", StateVerdict.EXACT),
        ("discards", StateVerdict.EXACT),
        ("restarting_solver", StateVerdict.RESTARTS_SOLVER),
        ("not_repeating", StateVerdict.DOES_NOT_REPEAT),
        ("broken_state", StateVerdict.DOES_NOT_REPEAT),
        ("error_on_restore", StateVerdict.BROKEN),
    ],
)
def test_fmus_get_the_verdict_that_they_were_made_for(
    name: str, verdict: StateVerdict, load: Load
) -> None:
    """And none of them is said to have a clock or to take single Euler steps."""
    found = examine(load(name), 0.0, H)
    assert found.state_verdict is verdict
    assert found.internal_clock is None
    assert found.largest_substep is None
    if name == "broken_state":
        assert "wrong already before that step" in found.state_reason
    if name == "restarting_solver":
        assert 0.0 < found.difference < 1e-9


def test_fmus_with_a_clock_and_with_euler_steps(load: Load) -> None:
    """The clock of 10 ms is found, and how short Euler steps must be."""
    assert examine(load("internal_clock"), 0.0, H).internal_clock == 0.01
    found = examine(load("euler_per_step"), 0.0, H)
    assert found.internal_clock is None
    assert found.step_dependence > 1.0
    # y = e^(-t/T) with T = 0.5: 2h differs from h + h by (h/T)^2, weighed by 2e-4 at y = 1.
    assert found.largest_substep == pytest.approx(0.5 * np.sqrt(0.1 * 2e-4), rel=0.05)


def test_an_examined_fmu_goes_on_as_one_that_was_not(load: Load) -> None:
    """An examined FMU gives the bits of one that was not, in all that follows."""
    ends: list[Any] = []
    for is_examined in (True, False):
        slave = load("wheel_no_derivatives")
        if is_examined:
            assert examine(slave, 0.0, H).state_verdict is StateVerdict.EXACT
        for i in range(5):
            slave.do_step(i * H, H, True)
        ends.append(slave.get_outputs(0))
    assert np.array_equal(*ends)


def test_the_executor_examines_with_the_tolerances_of_the_call() -> None:
    """And the slave can be reset and run afterwards."""
    slave = EulerSlave()
    executor = Executor(slave)
    system = slave.system
    start = (Initialize(inputs=system.inputs, outputs=system.outputs), ExitInitializationMode())
    reply = executor.execute([*start, Examine(0.0, H, 1e-6, 1e-6), Reset(), *start, GetOutputs()])
    assert reply.error is None
    assert reply.results[2] == examine(EulerSlave(), 0.0, H, 1e-6, 1e-6)
