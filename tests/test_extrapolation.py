"""Laws of input polynomials and of the history that they go through."""

from __future__ import annotations

import dataclasses
from itertools import accumulate
from math import factorial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from master_node.numerics.extrapolation import CouplingHistory, interpolate
from protocol.signals import MAX_ORDER, InputSignal

EPS = np.finfo(float).eps

orders = st.integers(0, MAX_ORDER)
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


# ---- Polynomials --------------------------------------------------------------------------------


@given(st.data(), orders)
def test_polynomials_are_reproduced_on_any_grid(data: st.DataObject, k: int) -> None:
    """Law: an input that is a polynomial of degree k is extrapolated without error.

    On every grid of k + 1 points and anywhere near it, up to rounding: the divided differences
    on a grid whose neighbours differ by at most a factor of 25 amplify it by no more than 1e5.
    """
    grid = data.draw(grids(k + 1))
    span = abs(grid[-1]) or 1.0
    coefficients = data.draw(st.lists(values, min_size=k + 1, max_size=k + 1))
    polynomial = Polynomial([c / span**j for j, c in enumerate(coefficients)])
    signal = interpolate(grid, [np.array([polynomial(s), -polynomial(s)]) for s in grid])
    tau = data.draw(offsets) * span
    size = sum(abs(c) * max(1.0, abs(tau) / span) ** k for c in coefficients)
    expected = polynomial(tau)
    assert signal.at(tau) == pytest.approx([expected, -expected], rel=0.0, abs=1e5 * EPS * size)


@given(st.data(), orders)
def test_rows_are_the_derivatives(data: st.DataObject, k: int) -> None:
    """Row j is d^j u / dt^j at the newest point: what fmi2SetRealInputDerivatives takes."""
    grid = data.draw(grids(k + 1))
    span = abs(grid[-1]) or 1.0
    coefficients = data.draw(st.lists(values, min_size=k + 1, max_size=k + 1))
    polynomial = Polynomial([c / span**j for j, c in enumerate(coefficients)])
    signal = interpolate(grid, [np.array([polynomial(s)]) for s in grid])
    size = sum(map(abs, coefficients))
    for j, row in enumerate(signal.derivatives):
        bound = 1e5 * EPS * size * factorial(j) / span**j
        expected = factorial(j) * polynomial.coef[j]
        assert row == pytest.approx([expected], rel=0.0, abs=bound)


@given(st.data(), orders)
def test_the_newest_value_is_kept_bit_for_bit(data: st.DataObject, k: int) -> None:
    """Row 0 is the newest value itself, whatever the older ones: no rounding at T_n."""
    grid = data.draw(grids(k + 1))
    points = [np.array(data.draw(st.tuples(values, values))) for _ in grid]
    signal = interpolate(grid, points)
    assert signal.derivatives.shape == (k + 1, 2)
    assert signal.derivatives[0].tobytes() == points[0].tobytes()
    assert np.array_equal(signal.at(0.0), points[0])


@given(st.data(), orders, values)
def test_constants_have_derivatives_of_exactly_zero(
    data: st.DataObject, k: int, value: float
) -> None:
    """A system at rest stays there: no rounding error moves a slave."""
    grid = data.draw(grids(k + 1))
    signal = interpolate(grid, [np.array([value, 0.1]) for _ in grid])
    assert not signal.derivatives[1:].any()
    offset = data.draw(st.floats(-1e3, 1e3))
    assert signal.at(offset).tolist() == [value, 0.1]
    assert not signal.shifted(offset).derivatives[1:].any()


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


# ---- The history --------------------------------------------------------------------------------


@given(st.data(), orders, times)
def test_a_history_extrapolates_around_its_newest_point(
    data: st.DataObject, k: int, start: float
) -> None:
    """``signal(k)`` goes through T_n ... T_(n-k), ``long_signal(k)`` through every second point."""
    steps = [0.1 * g for g in data.draw(st.lists(gaps, min_size=2 * k, max_size=2 * k))]
    inputs = [np.array(data.draw(st.tuples(values, values)), dtype=float) for _ in range(2 * k + 1)]
    history = CouplingHistory.start(start, inputs[0], depth=2 * k + 1)
    for step, u in zip(steps, inputs[1:], strict=True):
        history = history.pushed(history.times[0] + step, u)
    now = history.times[0]
    for signal, points in (
        (history.signal(k), slice(k + 1)),
        (history.long_signal(k), slice(0, 2 * k + 1, 2)),
    ):
        nodes = [t - now for t in history.times[points]]
        expected = interpolate(nodes, history.inputs[points])
        assert signal.derivatives.tobytes() == expected.derivatives.tobytes()
        size = max(float(np.abs(u).max()) for u in inputs)
        for node, u in zip(nodes, history.inputs[points], strict=True):
            assert signal.at(node) == pytest.approx(u, rel=0.0, abs=1e6 * EPS * size)


@given(st.integers(1, 7), st.integers(0, 20))
def test_a_history_is_bounded(depth: int, pushes: int) -> None:
    """However long the run, no more than ``depth`` points are kept, and they are the newest."""
    history = CouplingHistory.start(0.0, np.array([0.0]), depth)
    for i in range(1, pushes + 1):
        history = history.pushed(float(i), np.array([float(i)]))
    kept = min(depth, pushes + 1)
    newest_first = [float(pushes - i) for i in range(kept)]
    assert list(history.times) == newest_first
    assert [float(u[0]) for u in history.inputs] == newest_first


def test_a_history_is_immutable() -> None:
    """Rejecting a step is keeping the old history: pushing leaves it as it was."""
    history = CouplingHistory.start(0.0, np.array([1.0]), depth=3)
    pushed = history.pushed(0.5, np.array([2.0]))
    assert history.times == (0.0,)
    assert pushed.times == (0.5, 0.0)
    assert pushed.inputs[1] is history.inputs[0]
    with pytest.raises(dataclasses.FrozenInstanceError):
        history.times = ()  # type: ignore[misc]


@given(st.integers(1, 7), times, st.floats(1e-6, 10.0), values, orders)
def test_a_system_at_rest_has_a_full_history(
    depth: int, start: float, step_size: float, value: float, k: int
) -> None:
    """u(T_0) stands at T_0 - i H_0: order k from the first step on, and nothing moves."""
    u = np.array([value])
    history = CouplingHistory.at_rest(start, u, depth, step_size)
    assert len(history.times) == len(history.inputs) == depth
    assert history.times[0] == start
    for i, time in enumerate(history.times):
        assert time == start - i * step_size
    if depth >= 2 * k + 1:
        for signal in (history.signal(k), history.long_signal(k)):
            assert signal.order == k
            assert signal.derivatives[0].tolist() == [value]
            assert not signal.derivatives[1:].any()
