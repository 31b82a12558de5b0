"""Substeps: constant inputs that act like polynomials, steps that are kept short, saved states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from master_node import simulate
from protocol.calls import Configure, Initialize, StepResult, StepStatus
from protocol.description import InputDerivatives
from protocol.errors import SlaveError, StepRejectedError
from protocol.slave import Slave
from protocol.step_sums import step_to
from slave_node.loading import describe_model, load_slave
from slave_node.substeps.inputs import MAX_SUBSTEPS, scaled, substep_values, substeps_needed
from slave_node.substeps.slave import SubstepSlave, with_substeps
from tests.support.quarter_car_case import (
    ALL,
    CHASSIS,
    CHASSIS_FORCE,
    WHEEL_FORCE,
    car,
    global_errors,
)
from tests.support.trial_slaves import BoundedSlave, TimedSlave, described

HELD = replace(ALL, can_interpolate_inputs=False)
FORCE_HELD = replace(HELD, max_output_derivative_order=1)


def timed(**options: Any) -> TimedSlave:
    """A chassis that takes values of its inputs only."""
    return TimedSlave(capabilities=HELD, **options)


def emulated(inner: Slave, **configuration: Any) -> Slave:
    """The slave as its node would wrap it, initialized."""
    slave = with_substeps(inner, Configure(**configuration))
    system = inner.system  # type: ignore[attr-defined]
    slave.initialize(
        Initialize(
            start_time=0.0,
            stop_time=None,
            relative_tolerance=1e-6,
            start_values={},
            inputs=system.inputs,
            outputs=system.outputs,
        )
    )
    slave.exit_initialization_mode()
    return slave


def polynomial_rows(order: int, scale: float = 1.0) -> np.ndarray:
    """Some input derivatives of two inputs, shape (order + 1, 2)."""
    rows = np.array([[0.3, -0.2], [1.0, 2.0], [-7.0, 3.0], [40.0, 11.0]])
    return scale * rows[: order + 1]


# ---- Values -------------------------------------------------------------------------------------

numbers = st.integers(1, 12)
orders = st.integers(0, 3)


@given(numbers, orders, st.booleans(), st.floats(0.01, 5.0))
def test_the_first_moments_are_those_of_the_polynomial(
    number: int, order: int, meets_end: bool, step_size: float
) -> None:
    """Law: int t^i c dt = int t^i u dt for i < min(N, k + 1), whatever the lengths; and with a
    last substep that meets the end its value is u(T + H).
    """
    rows = polynomial_rows(order)
    lengths = np.arange(1.0, number + 1.0)
    if meets_end:
        lengths = np.append(lengths, 0.1)
    lengths /= lengths.sum()
    values = substep_values(scaled(rows, step_size), tuple(lengths), meets_end=meets_end)
    u = [Polynomial(row) for row in (rows.T / [math.factorial(j) for j in range(order + 1)])]
    if meets_end:
        assert values[-1] == pytest.approx([p(step_size) for p in u], rel=1e-12)
    edges = step_size * np.concatenate([[0.0], np.cumsum(lengths)])
    for i in range(min(number, order + 1)):
        powers = np.diff(edges ** (i + 1)) / (i + 1)
        weight = Polynomial([0.0] * i + [1.0])
        wanted = [(weight * p).integ()(step_size) for p in u]
        size = np.abs(values).max() * step_size ** (i + 1)
        assert powers @ values == pytest.approx(wanted, abs=1e-11 * size)


def test_many_substeps_have_the_mean_values() -> None:
    """The more substeps, the nearer each value is to the mean of the polynomial in it."""
    rows, far = polynomial_rows(3), []
    for number in (8, 32, 128):
        values = substep_values(scaled(rows, 1.0), (1.0 / number,) * number, meets_end=False)
        edges = np.linspace(0.0, 1.0, number + 1)
        p = [Polynomial(row) for row in (rows.T / [1.0, 1.0, 2.0, 6.0])]
        means = np.stack([np.diff(q.integ()(edges)) * number for q in p], axis=1)
        far.append(np.abs(values - means).max())
    assert far[0] > 10.0 * far[1] > 100.0 * far[2]


@given(orders, st.floats(1e-9, 1e3), st.floats(1e-12, 0.5), st.floats(1e-3, 1e3))
def test_the_number_of_substeps_follows_the_accuracy(
    order: int, scale: float, tolerance: float, nominal: float
) -> None:
    """One for constant inputs, k + 1 at least, more for larger changes and smaller tolerances."""
    rows, sizes = polynomial_rows(order, scale), np.full(2, nominal)
    number = substeps_needed(scaled(rows, 0.1), sizes, tolerance)
    assert order + 1 <= number <= max(MAX_SUBSTEPS, order + 1)
    assert number >= substeps_needed(scaled(rows, 0.05), sizes, tolerance)
    assert number >= substeps_needed(scaled(rows, 0.1), sizes, 2.0 * tolerance)
    assert number >= substeps_needed(scaled(rows, 0.1), 2.0 * sizes, tolerance)
    if order == 0:
        assert number == 1


def test_inputs_that_are_not_finite_have_a_number_too() -> None:
    """NaN and infinity are for the error control to find, not for a rounding to fail on."""
    for bad in (math.nan, math.inf):
        rows = np.array([[0.0], [bad]])
        assert substeps_needed(rows, np.ones(1), 1e-6) == 2


# ---- Wrapping -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("native", "configuration", "expected"),
    [
        (False, {}, InputDerivatives.EMULATED),
        (False, {"input_substeps": 1}, InputDerivatives.NONE),
        (False, {"input_substeps": 5}, InputDerivatives.EMULATED),
        (True, {}, InputDerivatives.NATIVE),
        (True, {"largest_substep": 0.1}, InputDerivatives.NATIVE),
        (True, {"input_substeps": 1}, InputDerivatives.NONE),
        (True, {"input_substeps": 5}, InputDerivatives.EMULATED),
    ],
)
def test_how_a_slave_follows_its_inputs(
    native: bool, configuration: dict[str, Any], expected: InputDerivatives
) -> None:
    """By itself if it can, else emulated, or as the configuration says; and it says so."""
    inner = TimedSlave(capabilities=ALL if native else HELD)
    slave = with_substeps(inner, Configure(**configuration))
    assert slave.description.input_derivatives is expected
    changed = expected is not inner.description.input_derivatives or "largest_substep" in (
        configuration
    )
    assert isinstance(slave, SubstepSlave) is changed


@pytest.mark.parametrize("order", [1, 2, 3])
def test_one_communication_step_is_right_to_the_order_k_plus_3(order: int) -> None:
    """Law: with k + 1 substeps of H the states differ from those with native polynomials by
    O(H^(k+3)) at most, one order more than the extrapolation errs by. With odd k it is one more:
    the values are symmetric then.
    """
    errors = []
    for step_size in (0.04, 0.02):
        native = TimedSlave(capabilities=ALL)
        slave = emulated(timed(), input_substeps=order + 1)
        for each in (native, slave):
            each.set_inputs(polynomial_rows(order))
            each.do_step(0.0, step_size, True)
        errors.append(np.linalg.norm(native.get_outputs(0) - slave.get_outputs(0)))
    assert np.log2(errors[0] / errors[1]) > order + 2.75


def test_substeps_are_where_the_slave_stands_and_end_on_the_end() -> None:
    """`TimedSlave` refuses any communication point but its own, to the last bit; the end of each
    step is the very double that a single step would have led to.
    """
    inner = timed()
    slave = emulated(inner, input_substeps=7)
    time = 0.0
    for step_size in (0.1, 0.07, 1e-3, 0.3, 1e-7):
        slave.set_inputs(polynomial_rows(3, 1e-3))
        result = slave.do_step(time, step_size, True)
        assert result == StepResult(StepStatus.OK, time + step_size)
        time = result.time
    assert len(inner.steps) == 5 * 7


def test_only_the_first_substep_gives_up_older_states() -> None:
    """The state at the beginning of the communication step may still be restored."""
    flags = []

    class Noting(TimedSlave):
        def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
            flags.append(no_set_state_prior)
            return super().advance(time, step_size, no_set_state_prior)

    slave = emulated(Noting(capabilities=HELD), input_substeps=3)
    slave.set_inputs(polynomial_rows(1))
    slave.do_step(0.0, 0.1, True)
    assert flags == [True, False, False]


@given(st.integers(-2000, 2000), st.lists(st.integers(1, 12), min_size=1, max_size=8))
def test_a_slave_with_its_own_step_size_gets_no_other(origin: int, numbers: list[int]) -> None:
    """A model with fixed steps is driven by these: by exactly so many, of that size but for the
    rounding of the times, each from where it stands and none beyond the communication step.
    """
    inner = timed()
    described(inner, fixed_step_size=0.01)
    slave = emulated(inner)
    begin = time = origin / 100
    for number in numbers:
        slave.set_inputs(polynomial_rows(2, 1e-3))
        size = step_to(time, float(Fraction(origin + number, 100)), number * 0.01)
        slave.do_step(time, size, True)
        time, origin = time + size, origin + number
        assert time - math.ulp(abs(time) + 0.1) <= inner.steps[-1][0] + inner.steps[-1][1] <= time
    assert len(inner.steps) == sum(numbers)
    for point, size in inner.steps:
        assert point == begin
        assert size == pytest.approx(0.01, abs=4.0 * math.ulp(abs(point) + 0.1))
        begin = point + size


@pytest.mark.parametrize("capabilities", [ALL, HELD])
def test_no_step_of_the_model_is_longer_than_the_largest_substep(capabilities: Any) -> None:
    """With native and with emulated inputs; on a grid of it substeps are just as long."""
    inner = TimedSlave(capabilities=capabilities)
    slave = emulated(inner, largest_substep=0.01)
    slave.set_inputs(polynomial_rows(1, 1e-3))
    slave.do_step(0.0, 0.055, True)
    assert max(size for _, size in inner.steps) <= 0.01
    count = len(inner.steps)
    slave.set_inputs(polynomial_rows(3, 1e-3))
    slave.do_step(0.055, 0.02, True)
    assert [size for _, size in inner.steps[count:]] == pytest.approx([0.01, 0.01])


def test_native_polynomials_go_on_over_substeps() -> None:
    """A linear slave comes to the same states with and without substeps."""
    whole, split = TimedSlave(capabilities=ALL), TimedSlave(capabilities=ALL)
    slave = emulated(split, largest_substep=0.013)
    for each in (whole, slave):
        each.set_inputs(polynomial_rows(3))
        each.do_step(0.0, 0.1, True)
    assert len(split.steps) == 8
    assert slave.get_outputs(0) == pytest.approx(whole.get_outputs(0), rel=1e-12)


def test_a_slave_that_takes_one_step_size_only_gets_mean_values() -> None:
    """Without variable steps nothing is split."""
    inner = TimedSlave(capabilities=replace(HELD, can_handle_variable_step_size=False))
    slave = emulated(inner)
    slave.set_inputs(np.array([[1.0, 2.0], [10.0, -4.0]]))
    slave.do_step(0.0, 0.1, True)
    assert inner.steps == [(0.0, 0.1)]
    assert inner.u[0] == pytest.approx([1.5, 1.8])


@pytest.mark.parametrize("follows", [False, True])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_outputs_with_feed_through_belong_to_the_end_of_the_step(order: int, follows: bool) -> None:
    """Values and derivatives: by a short last substep, or, where it is known to work, by inputs set
    after the step. They then are as near to those with native polynomials as the states are.
    """
    can = replace(FORCE_HELD, outputs_follow_inputs=follows)
    native = TimedSlave(WHEEL_FORCE, capabilities=replace(can, can_interpolate_inputs=True))
    inner = TimedSlave(WHEEL_FORCE, capabilities=can)
    slave = emulated(inner)
    for each in (native, slave):
        each.set_inputs(polynomial_rows(order, 1e-3))
        each.do_step(0.0, 1e-3, True)
    y, wanted = slave.get_outputs(1), native.get_outputs(1)
    assert y[0] == pytest.approx(wanted[0], rel=1e-9)
    assert y[1, :2] == pytest.approx(wanted[1, :2], rel=1e-6)
    short = inner.steps[-1][1] < 0.1 * inner.steps[0][1]
    assert short is not follows


def test_no_short_substep_without_feed_through() -> None:
    """It would be a step for nothing."""
    inner = TimedSlave(CHASSIS_FORCE, capabilities=HELD)
    slave = emulated(inner, input_substeps=4)
    slave.set_inputs(np.array([[1.0], [2.0]]))
    slave.do_step(0.0, 0.1, True)
    assert len(inner.steps) == 4


# ---- What goes wrong ----------------------------------------------------------------------------


def ended(status: StepStatus, after: float) -> type[TimedSlave]:
    """A slave whose step over the time ``after`` [s] ends there."""

    class Ending(TimedSlave):
        def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
            if time + step_size <= after:
                return super().advance(time, step_size, no_set_state_prior)
            reached = super().advance(time, after - time, no_set_state_prior)
            return StepResult(status, reached.time)

    return Ending


@pytest.mark.parametrize("status", [StepStatus.DISCARD, StepStatus.EARLY_RETURN])
def test_a_step_that_ends_in_a_substep_says_where(status: StepStatus) -> None:
    """The master sees how far the step got."""
    slave = emulated(ended(status, 0.05)(capabilities=HELD), input_substeps=8)
    slave.set_inputs(polynomial_rows(1))
    assert slave.do_step(0.0, 0.1, True) == StepResult(status, pytest.approx(0.05))


def test_an_error_in_a_substep_is_that_of_the_step() -> None:
    """And the slave is usable again after a restore."""
    slave = emulated(BoundedSlave(0.01), input_substeps=4)
    saved = slave.get_state()
    slave.set_inputs(polynomial_rows(1))
    with pytest.raises(StepRejectedError, match="too long"):
        slave.do_step(0.0, 0.1, True)
    slave.set_state(saved)
    slave.set_inputs(polynomial_rows(1))
    assert slave.do_step(0.0, 0.02, True).status is StepStatus.OK


def test_too_many_rows_are_refused() -> None:
    """Before the model sees them."""
    slave = emulated(timed())
    with pytest.raises(SlaveError, match="5 rows"):
        slave.set_inputs(np.zeros((5, 2)))


# ---- Saved states -------------------------------------------------------------------------------


def by_state(slave: Slave) -> Callable[[], None]:
    """Go back to here."""
    state = slave.get_state()
    return lambda: slave.set_state(state)


def test_a_restored_state_goes_on_bit_for_bit() -> None:
    """The polynomial is part of the state: the step after the restore sets no inputs."""
    slave = emulated(timed())
    slave.set_inputs(polynomial_rows(3, 1e-3))
    slave.do_step(0.0, 0.03, True)
    go_back = by_state(slave)
    slave.do_step(0.03, 0.05, False)
    first = slave.get_outputs(0)
    slave.set_inputs(polynomial_rows(1))
    slave.do_step(0.08, 0.01, False)
    go_back()
    slave.do_step(0.03, 0.05, False)
    assert np.array_equal(slave.get_outputs(0), first)


def test_states_go_through_bytes(fmu_dir: Path, tmp_path: Path) -> None:
    """States of a real FMU with substeps go through bytes; other bytes are refused."""
    slave = load_slave(
        "chassis.fmu", fmu_dir, "chassis", tmp_path, configuration=Configure(input_substeps=4)
    )
    slave.initialize(
        Initialize(
            start_time=0.0,
            stop_time=None,
            relative_tolerance=1e-6,
            start_values={},
            inputs=CHASSIS.inputs,
            outputs=CHASSIS.outputs,
        )
    )
    slave.exit_initialization_mode()
    slave.set_inputs(polynomial_rows(2, 1e-3))
    slave.do_step(0.0, 0.01, False)
    saved = slave.get_state()
    data = slave.serialize_state(saved)
    slave.do_step(0.01, 0.01, False)
    wanted = slave.get_outputs(0)
    again = slave.deserialize_state(data)
    slave.set_state(again)
    slave.do_step(0.01, 0.01, False)
    assert np.array_equal(slave.get_outputs(0), wanted)
    for bad in (b"", data[:12], b"x" * 100, data[:10] + b"\xff\xff\xff\xff" + data[14:]):
        with pytest.raises(SlaveError):
            slave.deserialize_state(bad)
    slave.free_state(saved)
    slave.set_state_and_free(again)
    with pytest.raises(SlaveError, match="not a saved state"):
        slave.set_state(object())
    slave.close()


# ---- Real FMUs ----------------------------------------------------------------------------------


def test_a_description_without_loading_says_it_too(capability_dir: Path, fmu_dir: Path) -> None:
    """Descriptions that ``slave-node inspect`` shows are those a run will find."""
    held = describe_model("chassis_no_derivatives.fmu", capability_dir)
    native = describe_model("chassis.fmu", fmu_dir)
    assert held.input_derivatives is InputDerivatives.EMULATED
    assert native.input_derivatives is InputDerivatives.NATIVE


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
@pytest.mark.parametrize("estimator", ["mod", "rich"])
def test_emulated_inputs_are_as_good_as_native_ones(
    estimator: str, tolerance: float, fmu_dir: Path, capability_dir: Path
) -> None:
    """K = 1 with default substeps against native input derivatives, quarter car: the same accepted
    steps within 10 %, the error within a factor of 2.
    """
    settings: dict[str, Any] = {
        "estimator": estimator,
        "relative_tolerance": tolerance,
        "absolute_tolerance": tolerance,
        "derivative_points": 0,
        "coupling": "explicit",
    }
    native = simulate(car("chassis.fmu", "wheel.fmu", base=fmu_dir, **settings), in_process=True)
    held = car(
        "chassis_no_derivatives.fmu", "wheel_no_derivatives.fmu", base=capability_dir, **settings
    )
    emulated = simulate(held, in_process=True)
    steps = [result.summary["communication_steps"] for result in (native, emulated)]
    errors = [global_errors(result).mean() for result in (native, emulated)]
    assert steps[1] == pytest.approx(steps[0], rel=0.1)
    assert 0.5 < errors[1] / errors[0] < 2.0
    if tolerance < 1e-4:
        return
    constant = held.with_slave("chassis", input_substeps=1).with_slave("wheel", input_substeps=1)
    held_steps = simulate(constant, in_process=True).summary["communication_steps"]
    assert held_steps > 2.0 * steps[1]  # else the emulation would be for nothing
