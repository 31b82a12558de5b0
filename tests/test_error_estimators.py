"""Laws of the error estimators, the error norm and the step size controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from master_node.numerics.error_estimators import (
    EST_MOD,
    EST_RICH,
    ESTIMATORS,
    Comparison,
    ErrorEstimator,
)
from master_node.numerics.extrapolation import CouplingHistory
from master_node.numerics.norms import first_not_finite, weighted_rms_norm
from master_node.numerics.step_size_controller import StepSizeController, last_step_size
from protocol.signals import MAX_ORDER, InputSignal
from tests.quarter_car_case import CHASSIS, WHEEL, LinearSlave, exact_solution

ORDERS = range(MAX_ORDER + 1)

# ---- The constants ------------------------------------------------------------------------------


def error_integral(nodes: list[int], begin: int, end: int) -> Fraction:
    """The integral of prod(s - node) from ``begin`` to ``end``, in exact fractions."""
    w = Polynomial.fromroots([Fraction(node) for node in nodes]).coef.tolist()
    return sum(
        (
            Fraction(c) * (Fraction(end) ** (j + 1) - Fraction(begin) ** (j + 1)) / (j + 1)
            for j, c in enumerate(w)
        ),
        Fraction(0),
    )


def two_small_steps(k: int) -> Fraction:
    """Over 0 to 1 through 0, -1, ..., then over 1 to 2 through 1, 0, ... (units of H)."""
    first = error_integral([-i for i in range(k + 1)], 0, 1)
    second = error_integral([1 - i for i in range(k + 1)], 1, 2)
    return first + second


@pytest.mark.parametrize("k", ORDERS)
def test_ratio_of_rich_is_two_to_the_order(k: int) -> None:
    """One step of 2H through every second point errs 2^(k+1) times as much as two of H."""
    comparison = error_integral([-2 * i for i in range(k + 1)], 0, 2)
    assert comparison / two_small_steps(k) == 2 ** (k + 1)
    assert EST_RICH.ratios[k] == 2 ** (k + 1)


@pytest.mark.parametrize(
    ("k", "ratio"),
    [(0, Fraction(2)), (1, Fraction(14, 5)), (2, Fraction(32, 9)), (3, Fraction(1076, 251))],
)
def test_ratio_of_mod_is_that_of_the_paper(k: int, ratio: Fraction) -> None:
    """2, 14/5, 32/9 (the paper, section 2) and 1076/251, from the integrals themselves."""
    comparison = error_integral([-i for i in range(k + 1)], 0, 2)
    assert comparison / two_small_steps(k) == ratio
    assert EST_MOD.ratios[k] == float(ratio)


def test_each_output_has_the_ratio_of_its_slaves_order() -> None:
    """``ratio`` looks p up for each output; slaves may have different orders."""
    orders = np.array([0, 2, 1, 2])
    assert EST_MOD.ratio(orders).tolist() == [2.0, 32 / 9, 14 / 5, 32 / 9]
    assert EST_RICH.ratio(orders).tolist() == [2.0, 8.0, 4.0, 8.0]


@pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=lambda e: e.name)
@pytest.mark.parametrize("k", ORDERS)
def test_points_and_order_are_inverse(estimator: ErrorEstimator, k: int) -> None:
    """Order k is used as soon as its points are there, and not one point earlier."""
    points = estimator.points(k)
    assert estimator.order(k, points) == k
    assert estimator.order(k, 1000) == k
    if k > 0:
        assert estimator.order(k, points - 1) == k - 1
    assert points == (2 * k + 1 if estimator.comparison is Comparison.LONG_STEP else k + 1)


# ---- The estimate against the true error --------------------------------------------------------


def coupled_inputs(time: float) -> tuple[np.ndarray, np.ndarray]:
    """What the chassis and the wheel get from each other in the exact solution."""
    state = exact_solution(time)[0]
    return state[2:], state[:2]


def one_double_step(
    estimator: ErrorEstimator, k: int, time: float, step_size: float
) -> tuple[np.ndarray, np.ndarray]:
    """EST and the true error of a double step from the exact solution with an exact history.

    Subsystems are propagated exactly (matrix exponential), so that extrapolation is all the
    error there is. Shape (4,) each: chassis.x, chassis.v, wheel.x, wheel.v.
    """
    start = exact_solution(time)[0]
    states = [start[:2], start[2:]]
    systems = [CHASSIS, WHEEL]
    points = [time - i * step_size for i in range(2 * k + 1)]
    history = CouplingHistory(
        tuple(points), tuple(np.concatenate(coupled_inputs(t)) for t in points), len(points)
    )

    def step(x: list[np.ndarray], signal: InputSignal, h: float) -> list[np.ndarray]:
        parts = (signal.derivatives[:, :2], signal.derivatives[:, 2:])
        return [s.propagate(x_i, u, h) for s, x_i, u in zip(systems, x, parts, strict=True)]

    signal = history.signal(k)
    middle = step(states, signal, step_size)
    inputs = np.concatenate([middle[1], middle[0]])
    y = step(middle, history.pushed(time + step_size, inputs).signal(k), step_size)
    if estimator.comparison is Comparison.LONG_STEP:
        comparison = step(states, history.long_signal(k), 2 * step_size)
    else:
        comparison = step(middle, signal.shifted(step_size), step_size)
    estimate = estimator.estimate(
        np.concatenate(y), np.concatenate(comparison), estimator.ratio(np.full(4, k))
    )
    return estimate, np.concatenate(y) - exact_solution(time + 2 * step_size)[0]


@pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=lambda e: e.name)
@pytest.mark.parametrize("k", ORDERS)
@pytest.mark.parametrize("time", [0.05, 0.3])
def test_the_estimate_tends_to_the_true_error(
    estimator: ErrorEstimator, k: int, time: float
) -> None:
    """Law: EST / true local error -> 1 as H -> 0, the deviation being of first order in H.

    In the norm of all outputs. A single one may be slower where its leading term happens to be
    small, and a displacement is one integration further from the inputs than a velocity, so its
    error is one order smaller, with a constant of its own.
    """
    deviations = []
    for step_size in (1e-3, 0.5e-3, 0.25e-3):
        estimate, error = one_double_step(estimator, k, time, step_size)
        deviations.append(np.linalg.norm(estimate - error) / np.linalg.norm(error))
    assert np.linalg.norm(estimate) / np.linalg.norm(error) == pytest.approx(1.0, abs=0.025)
    assert np.log2(deviations[-2] / deviations[-1]) == pytest.approx(1.0, abs=0.15)
    assert 2.0 * deviations[-1] - deviations[-2] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=lambda e: e.name)
@pytest.mark.parametrize("k", ORDERS)
def test_the_local_error_has_order_k_plus_2(estimator: ErrorEstimator, k: int) -> None:
    """Without feed-through the error of a double step, and so EST, is O(H^(k+2)): P = k + 2."""
    sizes = (0.5e-3, 0.25e-3)
    norms = np.array(
        [[np.linalg.norm(v) for v in one_double_step(estimator, k, 0.3, h)] for h in sizes]
    )
    observed = np.log2(norms[0] / norms[1])
    assert observed.tolist() == pytest.approx([k + 2, k + 2], abs=0.1)


def test_the_propagation_is_exact() -> None:
    """What the two tests above stand on: with the exact inputs' Taylor series there is no error."""
    t, h = 0.3, 1e-3
    x = exact_solution(t)[0]
    jacobian = (exact_solution(t + 1e-7)[0] - exact_solution(t - 1e-7)[0]) / 2e-7
    u = np.array([x[2:], jacobian[2:]])
    reached = CHASSIS.propagate(x[:2], u, h)
    assert reached == pytest.approx(exact_solution(t + h)[0][:2], rel=0.0, abs=1e-6)
    whole = CHASSIS.propagate(CHASSIS.propagate(x[:2], u, h / 2), shifted(u, h / 2), h / 2)
    assert whole == pytest.approx(reached, rel=1e-13)
    assert isinstance(CHASSIS.slave(x[:2]), LinearSlave)


def shifted(u: np.ndarray, offset: float) -> np.ndarray:
    """The same polynomial around another point."""
    return InputSignal(u).shifted(offset).derivatives


# ---- ERR ----------------------------------------------------------------------------------------

finite = st.floats(-1e100, 1e100)
tolerances = st.floats(1e-12, 1e6)


def quiet() -> np.errstate:
    """NumPy need not warn of what the norm finds."""
    return np.errstate(over="ignore", invalid="ignore")


@st.composite
def vectors(draw: st.DrawFn) -> list[tuple[float, float, float, float]]:
    """EST_j, y_j, ATOL_j, RTOL_j of some outputs."""
    part = st.tuples(finite, finite, tolerances, st.floats(0.0, 1.0))
    return draw(st.lists(part, min_size=1, max_size=8))


@given(vectors())
def test_norm_is_equation_8(parts: list[tuple[float, float, float, float]]) -> None:
    """ERR = sqrt(mean_j (EST_j / (ATOL_j + RTOL_j |y_j|))^2), and the index of its largest part."""
    weighted = [abs(e) / (atol + rtol * abs(y)) for e, y, atol, rtol in parts]
    expected = math.sqrt(sum(w * w for w in weighted) / len(weighted))
    norm, worst = weighted_rms_norm(*np.array(parts).T)
    assert norm == pytest.approx(expected, rel=1e-12, abs=1e-150)
    assert weighted[worst] == max(weighted)


@given(vectors(), st.data(), st.sampled_from([math.nan, math.inf, -math.inf]), st.booleans())
def test_norm_never_lets_nan_or_infinity_pass(
    parts: list[tuple[float, float, float, float]],
    data: st.DataObject,
    bad: float,
    in_error: bool,
) -> None:
    """NaN or infinity anywhere, in EST or in y, gives infinity and names the place."""
    error, y, atol, rtol = np.array(parts).T.copy()
    index = data.draw(st.integers(0, len(parts) - 1))
    if in_error:
        error[index] = bad
    else:
        y[index] = bad
        error[index] = bad  # y - y_comparison is no number where y is none
    with quiet():
        assert weighted_rms_norm(error, y, atol, rtol) == (math.inf, index)


@pytest.mark.parametrize("bad", [math.inf, -math.inf])
def test_norm_does_not_hide_an_error_behind_an_infinite_output(bad: float) -> None:
    """EST_j / infinity is 0: an output that is infinite must not make its own error vanish."""
    error, y = np.array([1e-6, 1e-6]), np.array([0.5, bad])
    assert weighted_rms_norm(error, y, np.full(2, 1e-4), np.full(2, 1e-4)) == (math.inf, 1)


def test_norm_of_errors_that_overflow_is_infinite() -> None:
    """Finite numbers whose squares are not: a rejection, named by the largest one."""
    error = np.array([1.0, 1e200, 1e180])
    with quiet():
        norm = weighted_rms_norm(error, np.zeros(3), np.ones(3), np.zeros(3))
    assert norm == (math.inf, 1)


@given(st.lists(finite, max_size=8), st.data())
def test_first_not_finite(y: list[float], data: st.DataObject) -> None:
    """None for numbers, however large; else the first index where there is none."""
    values = np.array(y)
    assert first_not_finite(values) is None
    if y:
        index = data.draw(st.integers(0, len(y) - 1))
        values[index] = data.draw(st.sampled_from([math.nan, math.inf, -math.inf]))
        values[index + 1 :] = math.nan
        assert first_not_finite(values) == index


# ---- The controller -----------------------------------------------------------------------------

CONTROLLER = StepSizeController(
    alpha=0.85, theta_min=0.3, theta_max=2.0, smallest_step_size=1e-9, largest_step_size=1e3
)


@given(st.floats(1e-6, 1.0), st.floats(1e-10, 1e10), st.integers(1, 5))
def test_controller_is_the_papers_formula(step_size: float, error: float, p: int) -> None:
    """H min(theta_max, max(theta_min, alpha ERR^(-1/P))), accepted exactly when ERR <= 1."""
    accepted, following = CONTROLLER.decide(step_size, error, p)
    assert accepted == (error <= 1.0)
    expected = step_size * min(2.0, max(0.3, 0.85 * error ** (-1.0 / p)))
    assert following == pytest.approx(expected, rel=1e-14)
    if not accepted:
        assert following < step_size


@pytest.mark.parametrize("error", [math.nan, math.inf])
def test_controller_never_accepts_what_is_no_number(error: float) -> None:
    """NaN and infinity are rejections with the largest reduction, never an acceptance."""
    decision = CONTROLLER.decide(1e-3, error, 3)
    assert decision.step_size == pytest.approx(0.3e-3)
    assert not decision.accepted


def test_an_error_of_exactly_one_is_accepted() -> None:
    """ERR <= 1, not ERR < 1; the step gets smaller all the same, by alpha."""
    assert CONTROLLER.decide(1e-3, 1.0, 2) == (True, pytest.approx(0.85e-3))


def test_an_error_of_zero_is_the_largest_growth() -> None:
    """A system at rest: no division by zero."""
    assert CONTROLLER.decide(1e-3, 0.0, 2) == (True, 2e-3)


@given(
    st.floats(1e-6, 1.0),
    st.one_of(st.floats(0.0, 1e300), st.just(math.nan), st.just(math.inf)),
    st.integers(1, 5),
)
def test_step_sizes_stay_within_their_bounds(step_size: float, error: float, p: int) -> None:
    """Whatever the error, the next H lies between the smallest and the largest one."""
    bounds = StepSizeController(0.85, 0.3, 2.0, smallest_step_size=1e-4, largest_step_size=1e-2)
    assert 1e-4 <= bounds.decide(step_size, error, p).step_size <= 1e-2
    assert 1e-4 <= bounds.after_discard(step_size, error) <= 1e-2


@given(st.floats(1e-6, 1.0), st.floats(0.0, 1.0))
def test_after_a_discard_the_step_goes_not_beyond_what_was_reached(
    step_size: float, reached: float
) -> None:
    """H shrinks to alpha times the part that the slave completed, by theta_min at most."""
    following = CONTROLLER.after_discard(step_size, reached)
    assert following == pytest.approx(step_size * max(0.3, 0.85 * reached))
    assert following < step_size


def test_a_slave_that_does_not_tell_how_far_it_got_gets_the_largest_reduction() -> None:
    """FMI 2 lets a slave discard without a last successful time."""
    assert CONTROLLER.after_discard(1e-3, math.nan) == pytest.approx(0.3e-3)


# ---- The end of the run -------------------------------------------------------------------------


def double_steps(
    start: float, stop: float, step_size: Callable[[int], float], limit: int = 100_000
) -> list[tuple[float, float]]:
    """(H, end) of the double steps to ``stop``, taken as `last_step_size` asks its caller to."""
    time = start
    steps: list[tuple[float, float]] = []
    while time < stop:
        assert len(steps) < limit
        h = last_step_size(time, stop, step_size(len(steps)))
        is_last = 2.0 * h >= stop - time
        time = stop if is_last else time + h + h
        steps.append((h, time))
    return steps


starts = st.floats(-1e3, 1e3)
durations = st.floats(1e-3, 1e3)


@given(starts, durations, st.floats(1e-3, 3.0))
@example(0.0, 4.0, 0.25e-3)
@example(0.1, 0.7, 0.1 / 0.7)
def test_steps_end_exactly_on_the_stop_time(start: float, duration: float, part: float) -> None:
    """Repeated with one H it ends on the stop time, bit for bit, and never beyond it."""
    stop = start + duration
    assume(stop > start)
    h = part * duration
    steps = double_steps(start, stop, lambda _: h)
    ends = [end for _, end in steps]
    assert ends[-1] == stop
    assert all(end < stop for end in ends[:-1])
    assert len(steps) <= math.ceil(duration / (2 * h)) + 1
    assert all(0.0 < taken <= h for taken, _ in steps)


@given(starts, durations, st.lists(st.floats(1e-3, 1.0), min_size=1, max_size=20))
def test_steps_of_any_size_end_exactly_on_the_stop_time(
    start: float, duration: float, parts: list[float]
) -> None:
    """The same when H changes from step to step, as it does under control."""
    stop = start + duration
    assume(stop > start)
    steps = double_steps(start, stop, lambda n: parts[n % len(parts)] * duration)
    assert steps[-1][1] == stop
    assert all(end < stop for _, end in steps[:-1])


@given(starts, durations, st.floats(1e-3, 0.4))
def test_the_last_double_step_is_not_arbitrarily_small(
    start: float, duration: float, part: float
) -> None:
    """What is left for less than two double steps is shared: none is below half of H."""
    stop = start + duration
    assume(stop > start)
    h = part * duration
    assert min(taken for taken, _ in double_steps(start, stop, lambda _: h)) >= 0.49 * h
