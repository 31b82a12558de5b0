"""Laws of the solver for algebraic loops across slaves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from master_node.numerics.fixed_point import NoFixedPointError, fixed_point
from protocol.signals import FloatArray

seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None)
@given(seeds, st.integers(1, 5), st.floats(0.1, 20.0))
def test_linear_loops_end_after_few_evaluations(seed: int, n: int, gain: float) -> None:
    """Law: a linear loop in n variables is solved in about n + 2 evaluations, whatever its gain.

    With a gain above 1 the plain iteration x <- g(x) diverges.
    """
    generator = np.random.default_rng(seed)
    a = gain * generator.uniform(-1.0, 1.0, (n, n))
    solvable = np.eye(n) - a
    if np.linalg.cond(solvable) > 1e4:
        return
    b = generator.uniform(-1.0, 1.0, n)
    evaluations = 0

    def g(x: FloatArray) -> FloatArray:
        nonlocal evaluations
        evaluations += 1
        return np.asarray(a @ x + b)

    x = fixed_point(g, np.zeros(n), tolerance=1e-9)
    assert x == pytest.approx(np.linalg.solve(solvable, b), rel=1e-5, abs=1e-5)
    assert evaluations <= 3 * n + 4


def test_a_nonlinear_loop_is_solved() -> None:
    """Such as x = cos x and x = 3 / x, whose plain iteration jumps back and forth for ever."""
    assert fixed_point(np.cos, np.array([0.5])) == pytest.approx([0.7390851332151607])
    assert fixed_point(lambda x: 3.0 / x, np.array([1.0])) == pytest.approx([3.0**0.5])


def test_a_fixed_point_to_begin_with_costs_one_evaluation() -> None:
    """Nothing is done where nothing is to do."""
    calls = []

    def g(x: FloatArray) -> FloatArray:
        calls.append(x)
        return x.copy()

    assert fixed_point(g, np.array([1.0, -2.0])).tolist() == [1.0, -2.0]
    assert len(calls) == 1


def test_values_that_are_not_finite_end_the_search() -> None:
    """NaN never passes: the error comes at once."""
    with pytest.raises(NoFixedPointError):
        fixed_point(lambda x: x * np.nan, np.array([1.0]))


def test_without_a_solution_the_residual_is_told() -> None:
    """There is no x = x + 1; the residual is 1."""
    with pytest.raises(NoFixedPointError) as caught:
        fixed_point(lambda x: x + 1.0, np.array([0.0]), evaluations=7)
    assert caught.value.residual == pytest.approx([1.0])
