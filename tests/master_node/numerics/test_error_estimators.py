"""Laws of the error estimators' constants, the error norm and the step size controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from itertools import accumulate

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
    exact_ratio,
    node_integral,
    node_polynomial,
)
from master_node.numerics.extrapolation import (
    POLYNOMIALS,
    Extrapolation,
    InputKind,
    InputPolynomial,
    Nodes,
)
from master_node.numerics.norms import error_scale, first_not_finite, weighted_rms_norm
from master_node.numerics.step_size_controller import (
    EXPONENTS,
    ControllerMemory,
    StepSizeController,
    last_step_size,
)
from protocol.signals import MAX_ORDER

ORDERS = range(MAX_ORDER + 1)

# ---- The constants ------------------------------------------------------------------------------


def error_integral(nodes: Nodes | list[int], begin: float, end: float) -> Fraction:
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
    assert EST_RICH.paper_ratios[k] == 2 ** (k + 1)


@pytest.mark.parametrize(
    ("k", "ratio"),
    [(0, Fraction(2)), (1, Fraction(14, 5)), (2, Fraction(32, 9)), (3, Fraction(1076, 251))],
)
def test_ratio_of_mod_is_that_of_the_paper(k: int, ratio: Fraction) -> None:
    """2, 14/5, 32/9 (the paper, section 2) and 1076/251, from the integrals themselves."""
    comparison = error_integral([-i for i in range(k + 1)], 0, 2)
    assert comparison / two_small_steps(k) == ratio
    assert EST_MOD.paper_ratios[k] == float(ratio)


def nodes_of(
    estimator: ErrorEstimator, polynomial: InputPolynomial, past: list[float], step_size: float
) -> tuple[Nodes, Nodes, Nodes]:
    """Nodes of both small steps and of the comparison solution, after some points."""
    extrapolation = Extrapolation([InputKind(has_derivative=True)], np.zeros(1, dtype=np.intp))

    def nodes(points: list[float]) -> Nodes:
        found = extrapolation.nodes(points, (polynomial,), 0.0)
        return found[0]

    first, second = nodes(past), nodes([step_size, *past])
    comparison = nodes(past[::2]) if estimator is EST_RICH else first
    return first, second, comparison


@pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=lambda e: e.name)
@pytest.mark.parametrize("k", ORDERS)
@pytest.mark.parametrize("step_size", [1.0, 3e-4])
def test_exact_ratio_on_an_equidistant_history(
    estimator: ErrorEstimator, k: int, step_size: float
) -> None:
    """The paper's constants without feed-through; with it k + 2 for EST_mod, 2^(k+1) for EST_Rich.

    For values only, whatever the size of the steps.
    """
    past = [-i * step_size for i in range(estimator.points(k + 1))]
    nodes = nodes_of(estimator, InputPolynomial(k), past, step_size)
    ends = (step_size, 2.0 * step_size)
    ratio = exact_ratio(*nodes, *ends, feed_through=False)
    assert ratio == pytest.approx(estimator.paper_ratios[k], rel=1e-13)
    direct = exact_ratio(*nodes, *ends, feed_through=True)
    assert direct == pytest.approx(k + 2 if estimator is EST_MOD else 2 ** (k + 1), rel=1e-13)


@given(
    st.sampled_from(list(ESTIMATORS.values())),
    st.sampled_from(POLYNOMIALS),
    st.lists(st.floats(0.1, 5.0), min_size=7, max_size=7),
    st.floats(0.2, 3.0),
)
def test_exact_ratio_is_that_of_the_integrals(
    estimator: ErrorEstimator, polynomial: InputPolynomial, steps: list[float], step_size: float
) -> None:
    """Against the same integrals in exact fractions, on any history, with and without derivatives.

    The comparison solution always errs more than the two small steps, so EST has a meaning.
    """
    past = [0.0, *(-s for s in accumulate(steps))]
    first, second, comparison = nodes_of(estimator, polynomial, past, step_size)
    end = 2.0 * step_size
    small = error_integral(first, 0.0, step_size) + error_integral(second, step_size, end)
    expected = float(error_integral(comparison, 0.0, end) / small)
    ratio = exact_ratio(first, second, comparison, step_size, end, feed_through=False)
    assert ratio == pytest.approx(expected, rel=1e-9)
    assert ratio > 1.05
    direct = exact_ratio(first, second, comparison, step_size, end, feed_through=True)
    products = [math.prod(end - s for s in nodes) for nodes in (comparison, second)]
    assert direct == pytest.approx(products[0] / products[1], rel=1e-9)
    assert direct > 1.05


@given(
    st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=5),
    st.floats(-3.0, 3.0),
    st.floats(-3.0, 3.0),
)
def test_node_integral_is_exact(nodes: list[float], begin: float, end: float) -> None:
    """Up to rounding, for as many nodes as a polynomial has and one more."""
    found = node_integral(tuple(nodes), begin, end)
    expected = float(error_integral(tuple(nodes), begin, end))
    size = abs(end - begin) * 6.0 ** len(nodes)
    assert found == pytest.approx(expected, rel=0.0, abs=1e-14 * size)
    assert node_polynomial(tuple(nodes), begin) == math.prod(begin - s for s in nodes)


def test_an_estimate_has_one_constant_or_one_for_each_output() -> None:
    """(y - y~) / (1 - p), element by element."""
    difference = np.array([1.0, 2.0]) - np.array([0.5, 3.0])
    assert EST_MOD.estimate(difference, 2.0).tolist() == [-0.5, 1.0]
    assert EST_MOD.estimate(difference, np.array([2.0, 5.0])).tolist() == [-0.5, 0.25]


@pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=lambda e: e.name)
@pytest.mark.parametrize("points", range(1, 6))
def test_points_and_available_are_inverse(estimator: ErrorEstimator, points: int) -> None:
    """A polynomial is used as soon as its points are there, and not one point earlier."""
    depth = estimator.points(points)
    assert estimator.available(depth) == points
    assert estimator.available(depth - 1) == points - 1
    assert depth == (2 * points - 1 if estimator.comparison is Comparison.LONG_STEP else points)


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
    error, y, atol, rtol = np.array(parts).T
    norm, worst = weighted_rms_norm(error, error_scale(y, atol, rtol))
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
        scale = error_scale(y, atol, rtol)
        assert weighted_rms_norm(error, scale) == (math.inf, index)


@pytest.mark.parametrize("bad", [math.inf, -math.inf])
def test_norm_does_not_hide_an_error_behind_an_infinite_output(bad: float) -> None:
    """EST_j / infinity is 0: an output that is infinite must not make its own error vanish."""
    error, y = np.array([1e-6, 1e-6]), np.array([0.5, bad])
    scale = error_scale(y, np.full(2, 1e-4), np.full(2, 1e-4))
    assert weighted_rms_norm(error, scale) == (math.inf, 1)


def test_norm_of_errors_that_overflow_is_infinite() -> None:
    """Finite numbers whose squares are not: a rejection, named by the largest one."""
    error = np.array([1.0, 1e200, 1e180])
    with quiet():
        norm = weighted_rms_norm(error, np.ones(3))
    assert norm == (math.inf, 1)


@given(st.lists(finite, max_size=8), st.data())
def test_first_not_finite(y: list[float], data: st.DataObject) -> None:
    """None for numbers, however large; else the first index where there is none.

    In any row: derivatives count as much as values.
    """
    values = np.array(y)
    assert first_not_finite(values[np.newaxis]) is None
    with quiet():
        assert first_not_finite(np.array([[1e200, -1e300]])) is None, "only its square is infinite"
    if y:
        index = data.draw(st.integers(0, len(y) - 1))
        values[index] = data.draw(st.sampled_from([math.nan, math.inf, -math.inf]))
        values[index + 1 :] = math.nan
        assert first_not_finite(values[np.newaxis]) == index
        assert first_not_finite(np.array([np.zeros(len(y)), values])) == index


# ---- The controller -----------------------------------------------------------------------------

CONTROLLER = StepSizeController(
    alpha=0.85, theta_min=0.3, theta_max=2.0, smallest_step_size=1e-9, largest_step_size=1e3
)


@given(st.floats(1e-6, 1.0), st.floats(1e-10, 1e10), st.integers(1, 5))
def test_controller_is_the_papers_formula(step_size: float, error: float, p: int) -> None:
    """H min(theta_max, max(theta_min, alpha ERR^(-1/P))), accepted exactly when ERR <= 1."""
    accepted, following, _ = CONTROLLER.decide(step_size, error, p)
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
    accepted, following, _ = CONTROLLER.decide(1e-3, 1.0, 2)
    assert (accepted, following) == (True, pytest.approx(0.85e-3))


def test_an_error_of_zero_is_the_largest_growth() -> None:
    """A system at rest: no division by zero."""
    assert CONTROLLER.decide(1e-3, 0.0, 2)[:2] == (True, 2e-3)
    assert PI.decide(1e-3, 0.0, 2, ControllerMemory(0.5))[:2] == (True, 2e-3)
    assert PI.decide(1e-3, 0.5, 2, ControllerMemory(0.0)).step_size <= 2e-3


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


any_number = st.one_of(
    st.floats(0.0), st.sampled_from([0.0, 5e-324, 1e-310, 1.0, 1e308, math.inf, math.nan])
)


@given(any_number, any_number, st.integers(1, 5), st.booleans(), st.sampled_from(sorted(EXPONENTS)))
def test_no_error_is_too_small_or_too_large_for_a_controller(
    error: float, before: float, p: int, rejected: bool, name: str
) -> None:
    """Law: H changes by theta_min to theta_max whatever ERR is now and was before.

    The smallest numbers, whose inverse is none, infinity and NaN are among them. A smaller error
    never has a smaller H.
    """
    controller = StepSizeController(0.85, 0.3, 2.0, 1e-9, 1e3, *EXPONENTS[name])
    memory = ControllerMemory(before if before <= 1.0 else math.nan, rejected)
    accepted, following, _ = controller.decide(1e-3, error, p, memory)
    assert accepted == (error <= 1.0)
    assert 0.3e-3 <= following <= 2e-3
    if error <= 1.0 and error > 0.0:
        assert controller.decide(1e-3, error / 2.0, p, memory).step_size >= following


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


# ---- The PI controller --------------------------------------------------------------------------


def pi_controller(**bounds: float) -> StepSizeController:
    """The controller that a run has by default."""
    wide = {"smallest_step_size": 1e-9, "largest_step_size": 1e3, **bounds}
    present, past = EXPONENTS["pi"]
    return StepSizeController(
        0.85, 0.3, 2.0, **wide, present=present, past=past, grows_after_rejection=False
    )


PI = pi_controller()
errors = st.floats(1e-8, 1.0)


@given(st.floats(1e-6, 1.0), errors, st.integers(1, 5))
def test_without_a_past_the_pi_controller_is_the_elementary_one(
    step_size: float, error: float, p: int
) -> None:
    """There is nothing to compare the first error with."""
    first = PI.decide(step_size, error, p)
    assert first.step_size == CONTROLLER.decide(step_size, error, p).step_size
    assert first.memory == ControllerMemory(error)


@given(st.floats(1.001, 1e10), errors, st.booleans(), st.integers(1, 5))
def test_a_rejection_is_answered_as_the_elementary_controller_does(
    error: float, before: float, rejected: bool, p: int
) -> None:
    """Whatever was before; and the error of the step accepted before is remembered."""
    decision = PI.decide(1e-3, error, p, ControllerMemory(before, rejected))
    assert decision.step_size == CONTROLLER.decide(1e-3, error, p).step_size
    assert not decision.accepted
    assert decision.memory == ControllerMemory(before, rejected=True)


@given(errors, errors, st.integers(1, 5))
def test_after_a_rejection_there_is_no_growth(error: float, before: float, p: int) -> None:
    """A step that had to be repeated says that larger ones are too large."""
    decision = PI.decide(1e-3, error, p, ControllerMemory(before, rejected=True))
    assert decision.accepted
    assert decision.step_size <= 1e-3
    assert not decision.memory.rejected
    elementary = CONTROLLER.decide(1e-3, 1e-6, p, ControllerMemory(before, rejected=True))
    assert elementary.step_size > 1e-3


@given(st.floats(1e-3, 1e3), st.integers(1, 5))
def test_both_controllers_have_the_same_steady_state(constant: float, p: int) -> None:
    """Law: where ERR = (c H)^P both settle at the H with ERR = alpha^P."""
    settled = []
    for controller in (CONTROLLER, PI):
        step_size, memory = 0.5 / constant, ControllerMemory()
        for _ in range(200):
            _, step_size, memory = controller.decide(
                step_size, (constant * step_size) ** p, p, memory
            )
        settled.append(step_size)
    assert settled == pytest.approx([0.85 / constant] * 2, rel=1e-6)


@given(errors, errors, st.integers(1, 5), st.booleans())
def test_the_pi_controller_stays_within_its_bounds(
    error: float, before: float, p: int, rejected: bool
) -> None:
    """Both of the change and of H itself."""
    bounds = pi_controller(smallest_step_size=5e-4, largest_step_size=1.5e-3)
    memory = ControllerMemory(before, rejected)
    assert 0.3e-3 <= PI.decide(1e-3, error, p, memory).step_size <= 2e-3
    assert 5e-4 <= bounds.decide(1e-3, error, p, memory).step_size <= 1.5e-3


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
    """The last step ends exactly on the stop time, also when H changes from step to step."""
    stop = start + duration
    assume(stop > start)
    steps = double_steps(start, stop, lambda n: parts[n % len(parts)] * duration)
    assert steps[-1][1] == stop
    assert all(end < stop for _, end in steps[:-1])


@given(starts, durations, st.floats(1e-3, 0.4))
def test_the_last_double_step_is_not_arbitrarily_small(
    start: float, duration: float, part: float
) -> None:
    """A rest of less than two double steps is shared: none is below half of H."""
    stop = start + duration
    assume(stop > start)
    h = part * duration
    assert min(taken for taken, _ in double_steps(start, stop, lambda _: h)) >= 0.49 * h
