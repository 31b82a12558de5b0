"""Laws of input polynomials and of the history that they go through."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate
from math import factorial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from master_node.numerics.extrapolation import (
    POLYNOMIALS,
    CouplingHistory,
    Extrapolation,
    InputKind,
    InputPolynomial,
    divided_differences,
    interpolate,
)
from protocol.signals import MAX_ORDER, InputSignal

EPS = np.finfo(float).eps

polynomials = st.sampled_from(POLYNOMIALS)
values = st.floats(-1e6, 1e6)
times = st.floats(-1e3, 1e3)
gaps = st.floats(0.2, 5.0)  # between neighbours, in units of some step size
scales = st.floats(1e-6, 1e3)
offsets = st.floats(-1.0, 2.0)  # in units of the grid


@st.composite
def grids(draw: st.DrawFn, points: int) -> list[float]:
    """Offsets [s] of ``points`` communication points, newest first, the newest one 0."""
    scale = draw(scales)
    steps = draw(st.lists(gaps, min_size=points - 1, max_size=points - 1))
    return [0.0, *(-scale * s for s in accumulate(steps))]


@st.composite
def inputs(draw: st.DrawFn, degree: int, span: float) -> Polynomial:
    """An input of some degree that changes by as much as it is large within ``span`` [s]."""
    coefficients = draw(st.lists(values, min_size=degree + 1, max_size=degree + 1))
    return Polynomial([c / span**j for j, c in enumerate(coefficients)])


def sizes(polynomial: Polynomial, reach: float) -> float:
    """Sum of the largest sizes of a polynomial's terms up to ``reach`` [s]."""
    return float(sum(abs(c) * reach**j for j, c in enumerate(polynomial.coef)))


def signal_of(
    offsets: Sequence[float], values: Sequence[np.ndarray], slopes: Sequence[np.ndarray] = ()
) -> InputSignal:
    """Signal that goes over the wire for some points."""
    return InputSignal(interpolate(offsets, values, slopes))


def through(
    wanted: InputPolynomial, grid: Sequence[float], u: Callable[[float], list[float]]
) -> InputSignal:
    """The polynomial ``wanted`` of inputs ``u`` that are polynomials themselves."""
    slopes = [np.array(u(s)[1::2]) for s in grid[: wanted.derivative_points]]
    return signal_of(grid, [np.array(u(s)[::2]) for s in grid], slopes)


def both(polynomial: Polynomial) -> Callable[[float], list[float]]:
    """Two inputs, one the negative of the other: value and derivative of each in turn."""
    derivative = polynomial.deriv()

    def at(s: float) -> list[float]:
        return [polynomial(s), derivative(s), -polynomial(s), -derivative(s)]

    return at


# ---- The polynomials that there are -------------------------------------------------------------


def test_the_polynomials_by_their_names() -> None:
    """The degree, with a prime for each point at which the derivative is met too."""
    assert [str(p) for p in POLYNOMIALS] == ["0", "1", "1'", "2", "2'", "3", "3'", "3''"]


@given(polynomials)
def test_a_polynomial_has_as_many_conditions_as_its_degree_needs(wanted: InputPolynomial) -> None:
    """There are k + 1: a value at each point, and the derivatives."""
    assert wanted.points + wanted.derivative_points == wanted.order + 1
    assert wanted.points >= max(1, wanted.derivative_points)


@given(polynomials, st.integers(0, 3), st.integers(0, 2), st.integers(1, 7))
def test_a_limited_polynomial_is_the_highest_that_the_limits_allow(
    wanted: InputPolynomial, order: int, derivative_points: int, points: int
) -> None:
    """It is one that there is, within all limits; none of a higher degree would be."""

    def fits(p: InputPolynomial) -> bool:
        return (
            p.order <= min(order, wanted.order)
            and p.derivative_points <= min(derivative_points, wanted.derivative_points)
            and p.points <= points
        )

    limited = wanted.limited(order, derivative_points, points)
    assert limited in POLYNOMIALS
    assert fits(limited)
    assert limited.order == max(p.order for p in POLYNOMIALS if fits(p))


@given(polynomials)
def test_without_limits_a_polynomial_stays_what_it_is(wanted: InputPolynomial) -> None:
    """Enough points, degrees and derivatives change nothing."""
    assert wanted.limited(MAX_ORDER, 2, 7) == wanted


# ---- One polynomial -----------------------------------------------------------------------------


@given(st.data(), polynomials)
def test_polynomials_are_reproduced_on_any_grid(
    data: st.DataObject, wanted: InputPolynomial
) -> None:
    """Law: an input that is a polynomial of degree k is extrapolated without error.

    With and without derivatives, on every grid and anywhere near it, up to rounding: the divided
    differences on a grid whose neighbours differ by at most a factor of 25 amplify it by no more
    than 1e5.
    """
    grid = data.draw(grids(wanted.points))
    span = abs(grid[-1]) or 1.0
    polynomial = data.draw(inputs(wanted.order, span))
    signal = through(wanted, grid, both(polynomial))
    assert signal.order == wanted.order
    tau = data.draw(offsets) * span
    expected = polynomial(tau)
    bound = 1e5 * EPS * sizes(polynomial, max(span, abs(tau)))
    assert signal.at(tau) == pytest.approx([expected, -expected], rel=0.0, abs=bound)


@given(st.data(), polynomials)
def test_rows_are_the_derivatives(data: st.DataObject, wanted: InputPolynomial) -> None:
    """Row j is d^j u / dt^j at the newest point: what fmi2SetRealInputDerivatives takes."""
    grid = data.draw(grids(wanted.points))
    span = abs(grid[-1]) or 1.0
    polynomial = data.draw(inputs(wanted.order, span))
    signal = through(wanted, grid, both(polynomial))
    for j, row in enumerate(signal.derivatives):
        bound = 1e5 * EPS * sizes(polynomial, span) * factorial(j) / span**j
        expected = factorial(j) * polynomial.coef[j]
        assert row == pytest.approx([expected, -expected], rel=0.0, abs=bound)


@given(st.data(), polynomials)
def test_all_conditions_are_met(data: st.DataObject, wanted: InputPolynomial) -> None:
    """Polynomials meet all values, and derivatives where given, of any points."""
    grid = data.draw(grids(wanted.points))
    span = abs(grid[-1]) or 1.0
    u = [np.array([data.draw(values)]) for _ in grid]
    slopes = [np.array([data.draw(values) / span]) for _ in grid[: wanted.derivative_points]]
    signal = signal_of(grid, u, slopes)
    size = max(float(abs(v[0])) for v in [*u, *(span * s for s in slopes)])
    amplified = 1e8 * EPS * size
    for node, value in zip(grid, u, strict=True):
        assert signal.at(node) == pytest.approx(value, rel=0.0, abs=amplified)
    for node, slope in zip(grid, slopes, strict=False):
        there = signal.shifted(node).derivatives[1]
        assert there == pytest.approx(slope, rel=0.0, abs=1e3 * amplified / span)


@given(st.data(), polynomials)
def test_the_newest_value_is_kept_bit_for_bit(data: st.DataObject, wanted: InputPolynomial) -> None:
    """Row 0 is the newest value itself, whatever the older ones: no rounding at T_n."""
    grid = data.draw(grids(wanted.points))
    points = [np.array(data.draw(st.tuples(values, values))) for _ in grid]
    signal = signal_of(grid, points, points[: wanted.derivative_points])
    assert signal.derivatives.shape == (wanted.order + 1, 2)
    assert signal.derivatives[0].tobytes() == points[0].tobytes()
    assert np.array_equal(signal.at(0.0), points[0])


@given(st.data(), polynomials, values)
def test_constants_have_derivatives_of_exactly_zero(
    data: st.DataObject, wanted: InputPolynomial, value: float
) -> None:
    """A system at rest stays there: no rounding error moves a slave."""
    grid = data.draw(grids(wanted.points))
    slopes = [np.zeros(2)] * wanted.derivative_points
    signal = signal_of(grid, [np.array([value, 0.1]) for _ in grid], slopes)
    assert not signal.derivatives[1:].any()
    offset = data.draw(st.floats(-1e3, 1e3))
    assert signal.at(offset).tolist() == [value, 0.1]
    assert not signal.shifted(offset).derivatives[1:].any()


@given(st.data(), st.integers(0, 4))
def test_divided_differences_of_a_monomial(data: st.DataObject, degree: int) -> None:
    """Divided differences of t^j are 1 over j + 1 points, 0 over more, also at repeated nodes."""
    grid = data.draw(grids(degree + 1))
    span = abs(grid[-1]) or 1.0
    unit = [s / span for s in grid]
    repeated = data.draw(st.integers(0, min(2, len(unit))))
    nodes = [s for i, s in enumerate(unit) for _ in range(1 + (i < repeated))]
    monomial = Polynomial([0.0] * degree + [1.0])
    slopes = [np.array([monomial.deriv()(s)]) for s in unit[:repeated]]
    found = divided_differences(nodes, [np.array([monomial(s)]) for s in nodes], slopes)
    assert len(found) == len(nodes)
    assert found[degree] == pytest.approx([1.0], abs=1e7 * EPS)
    for higher in found[degree + 1 :]:
        assert higher == pytest.approx([0.0], abs=1e9 * EPS)


@given(st.lists(values, min_size=1, max_size=MAX_ORDER + 1), offsets, offsets)
def test_a_shifted_signal_is_the_same_polynomial(
    rows: list[float], shift: float, offset: float
) -> None:
    """``shifted(a).at(b)`` is ``at(a + b)``, and shifting back and forth changes nothing."""
    signal = InputSignal(np.array(rows)[:, np.newaxis])
    size = sum(abs(d) * 4.0**j for j, d in enumerate(rows))
    shifted = signal.shifted(shift)
    assert shifted.order == signal.order
    bound = {"rel": 0.0, "abs": 20 * EPS * size}
    assert shifted.at(offset) == pytest.approx(signal.at(shift + offset), **bound)
    back = shifted.shifted(-shift).derivatives
    assert back == pytest.approx(signal.derivatives, rel=0.0, abs=100 * EPS * size)
    assert shifted.derivatives[0].tobytes() == signal.at(shift).tobytes()


def test_shifting_leaves_the_signal_as_it_was() -> None:
    """A signal is a value: what is made from it is another one."""
    rows = np.arange(8.0).reshape(4, 2)
    signal = InputSignal(rows.copy())
    signal.shifted(0.5).derivatives[:] = np.nan
    assert np.array_equal(signal.derivatives, rows)


def made(times: Sequence[float], table: np.ndarray) -> CouplingHistory:
    """The history of inputs, newest first, shape (points, rows, n)."""
    history = CouplingHistory.start(times[-1], table[-1], len(times))
    for time, rows in zip(times[-2::-1], table[-2::-1], strict=True):
        history = history.pushed(time, rows)
    return history


def table(history: CouplingHistory) -> np.ndarray:
    """Content of a history, shape (points, rows, n)."""
    return np.array(history.inputs)


# ---- All inputs of a system ---------------------------------------------------------------------

kinds = st.builds(InputKind, st.integers(0, MAX_ORDER), st.booleans(), st.booleans())


@st.composite
def systems(draw: st.DrawFn) -> tuple[list[InputKind], list[int]]:
    """Some kinds of input, and the kind of each input."""
    some = draw(st.lists(kinds, min_size=1, max_size=4, unique=True))
    of_input = draw(st.lists(st.integers(0, len(some) - 1), min_size=1, max_size=6))
    return some, of_input


@st.composite
def histories(
    draw: st.DrawFn, u: Sequence[Polynomial], points: int, ahead: int, span: float
) -> CouplingHistory:
    """The values and derivatives of inputs at some points, the newest ``ahead`` of them after 0."""
    steps = draw(st.lists(gaps, min_size=points + ahead - 1, max_size=points + ahead - 1))
    unit = span / max(1.0, sum(steps))
    grid = [0.0, *(-unit * s for s in accumulate(steps))]
    grid = [time - grid[ahead] for time in grid]
    rows = [[[p(t) for p in u], [p.deriv()(t) for p in u]] for t in grid]
    return made(grid, np.array(rows))


@given(st.data(), systems(), polynomials, st.integers(1, 5))
def test_every_input_has_the_polynomial_of_its_kind(
    data: st.DataObject,
    system: tuple[list[InputKind], list[int]],
    wanted: InputPolynomial,
    points: int,
) -> None:
    """Law: exactness in mixed systems, each input by the degree that its own kind leaves it.

    With derivatives for those that have them, with the point at the end of the step for those that
    are ahead; the others do not even look at it.
    """
    some, of_input = system
    ahead = int(any(kind.ahead for kind in some))
    extrapolation = Extrapolation(some, np.array(of_input))
    found = extrapolation.polynomials(wanted, points)
    assert [p.order for p in found] == [
        wanted.limited(
            kind.max_order, wanted.derivative_points if kind.has_derivative else 0, points
        ).order
        for kind in some
    ]
    span = data.draw(st.floats(1e-3, 1e3))
    u = [data.draw(inputs(found[i].order, span)) for i in of_input]
    history = data.draw(histories(u, points, ahead, span))
    blind = table(history)
    for column, i in enumerate(of_input):
        if ahead and not some[i].ahead:
            blind[0, :, column] = np.nan
        if not some[i].has_derivative:
            blind[:, 1, column] = np.nan
    history = made(history.times, blind)
    signal = extrapolation.signal(history, found, ahead)
    assert signal.derivatives.shape == (max(p.order for p in found) + 1, len(of_input))
    tau = data.draw(st.floats(-1.0, 1.0)) * span
    for column, (i, polynomial) in enumerate(zip(of_input, u, strict=True)):
        assert not signal.derivatives[found[i].order + 1 :, column].any()
        bound = 1e7 * EPS * sizes(polynomial, span)
        assert signal.at(tau)[column] == pytest.approx(polynomial(tau), rel=0.0, abs=bound)


@given(st.data(), systems(), polynomials, st.integers(1, 5))
def test_no_input_depends_on_another(
    data: st.DataObject,
    system: tuple[list[InputKind], list[int]],
    wanted: InputPolynomial,
    points: int,
) -> None:
    """Law: alone and among others, an input has the same polynomial, bit for bit."""
    some, of_input = system
    ahead = int(any(kind.ahead for kind in some))
    u = [data.draw(inputs(4, 1.0)) for _ in of_input]
    history = data.draw(histories(u, points, ahead, 1.0))
    extrapolation = Extrapolation(some, np.array(of_input))
    together = extrapolation.signal(history, extrapolation.polynomials(wanted, points), ahead)
    column = data.draw(st.integers(0, len(of_input) - 1))
    alone = Extrapolation([some[of_input[column]]], np.zeros(1, dtype=np.intp))
    only = made(history.times, table(history)[:, :, [column]])
    single = alone.signal(only, alone.polynomials(wanted, points), ahead).derivatives[:, 0]
    rows = together.derivatives[:, column]
    assert rows[: len(single)].tobytes() == single.tobytes()
    assert not rows[len(single) :].any()


@given(systems(), polynomials, st.integers(1, 5), st.lists(gaps, min_size=5, max_size=5))
def test_nodes_are_where_the_conditions_are(
    system: tuple[list[InputKind], list[int]],
    wanted: InputPolynomial,
    points: int,
    steps: list[float],
) -> None:
    """One for each condition, newest first; twice where a derivative is met; from the origin."""
    some, of_input = system
    ahead = int(any(kind.ahead for kind in some))
    extrapolation = Extrapolation(some, np.array(of_input))
    found = extrapolation.polynomials(wanted, points)
    times = [10.0 - s for s in accumulate(steps)]
    nodes = extrapolation.nodes(times, found, times[ahead], ahead)
    for kind, polynomial, own in zip(some, found, nodes, strict=True):
        assert len(own) == polynomial.order + 1
        assert list(own) == sorted(own, reverse=True)
        assert len(set(own)) == polynomial.points
        assert own[0] == (times[0] - times[1] if kind.ahead else 0.0)
        assert all(
            own.count(s) == 2 for s in sorted(set(own))[::-1][: polynomial.derivative_points]
        )


# ---- The history --------------------------------------------------------------------------------


def extrapolated(history: CouplingHistory, k: int) -> InputSignal:
    """Through the newest k + 1 points of a history of values."""
    extrapolation = Extrapolation([InputKind()], np.zeros(table(history).shape[2], dtype=np.intp))
    found = extrapolation.polynomials(InputPolynomial(k), len(history.times))
    return extrapolation.signal(history, found)


@given(st.data(), st.integers(0, MAX_ORDER), times)
def test_a_history_extrapolates_around_its_newest_point(
    data: st.DataObject, k: int, start: float
) -> None:
    """Through T_n ... T_(n-k), and for a step of 2H through every second point."""
    steps = [0.1 * g for g in data.draw(st.lists(gaps, min_size=2 * k, max_size=2 * k))]
    u = [np.array([data.draw(st.tuples(values, values))]) for _ in range(2 * k + 1)]
    history = CouplingHistory.start(start, u[0], depth=2 * k + 1)
    for step, value in zip(steps, u[1:], strict=True):
        history = history.pushed(history.times[0] + step, value)
    now = history.times[0]
    for past, points in (
        (history, slice(k + 1)),
        (history.every_second(), slice(0, 2 * k + 1, 2)),
    ):
        signal = extrapolated(past, k)
        nodes = [t - now for t in history.times[points]]
        expected = signal_of(nodes, list(table(history)[points, 0]))
        assert signal.derivatives.tobytes() == expected.derivatives.tobytes()
        size = max(float(np.abs(value).max()) for value in u)
        for node, value in zip(nodes, table(history)[points, 0], strict=True):
            assert signal.at(node) == pytest.approx(value, rel=0.0, abs=1e6 * EPS * size)


@given(st.integers(1, 7), st.integers(0, 20))
def test_a_history_is_bounded(depth: int, pushes: int) -> None:
    """However long the run, no more than ``depth`` points are kept, and they are the newest."""
    history = CouplingHistory.start(0.0, np.array([[0.0]]), depth)
    for i in range(1, pushes + 1):
        history = history.pushed(float(i), np.array([[float(i)]]))
    kept = min(depth, pushes + 1)
    newest_first = [float(pushes - i) for i in range(kept)]
    assert list(history.times) == newest_first
    assert table(history)[:, 0, 0].tolist() == newest_first


def test_a_history_is_immutable() -> None:
    """Rejecting a step is keeping the old history: pushing leaves it as it was."""
    history = CouplingHistory.start(0.0, np.array([[1.0], [4.0]]), depth=3)
    pushed = history.pushed(0.5, np.array([[2.0], [5.0]]))
    assert history.times == (0.0,)
    assert table(history).tolist() == [[[1.0], [4.0]]]
    assert pushed.times == (0.5, 0.0)
    assert table(pushed).tolist() == [[[2.0], [5.0]], [[1.0], [4.0]]]
    with pytest.raises(AttributeError):
        history.times = ()  # type: ignore[misc]


def test_a_history_that_was_cut_knows_its_newest_point_only() -> None:
    """Behind a discontinuity nothing from before it takes part; the depth stays what it was."""
    history = CouplingHistory.start(0.0, np.array([[1.0]]), depth=3)
    cut = history.pushed(0.5, np.array([[2.0]])).cut()
    assert cut.times == (0.5,)
    assert table(cut).tolist() == [[[2.0]]]
    assert cut.pushed(1.0, np.array([[3.0]])).times == (1.0, 0.5)


rests = st.tuples(times, st.floats(1e-6, 10.0), values)


@given(st.integers(1, 7), rests, st.integers(0, MAX_ORDER), st.booleans())
def test_a_system_at_rest_has_a_full_history(
    depth: int, rest: tuple[float, float, float], k: int, derivatives: bool
) -> None:
    """u(T_0) stands at T_0 - i H_0: order k from the first step on, and nothing moves.

    The derivative at T_0 itself is that of the slave; before it there was none.
    """
    start, step_size, value = rest
    u = np.array([[value], [3.0]]) if derivatives else np.array([[value]])
    history = CouplingHistory.at_rest(start, u, depth, step_size)
    assert len(history.times) == len(history.inputs) == depth
    assert history.times[0] == start
    assert table(history)[0].tolist() == u.tolist()
    for i, time in enumerate(history.times):
        assert time == start - i * step_size
        assert table(history)[i, 0, 0] == value
        assert i == 0 or not table(history)[i, 1:].any()
    if depth >= 2 * k + 1:
        for signal in (extrapolated(history, k), extrapolated(history.every_second(), k)):
            assert signal.order == k
            assert signal.derivatives[0].tolist() == [value]
            assert not signal.derivatives[1:].any()
