"""Choice of the next input polynomial: the one that allows the largest H for the same work.

To leading order the error of a double step with a polynomial of degree q is proportional to
u^(q+1) / (q+1)! times I_q, the integral of its nodes (see ``error_estimators``), and to how much
the slaves react to their inputs. The first factor is a divided difference of inputs that are known
anyway, the second follows from the grid, the third is the same for all polynomials, and ERR of the
step just taken measures it. So the errors of the other polynomials cost no do_step.

Every step costs the same three do_steps, so the largest H is the most for the work. The choice
changes by one degree at a time and only for a clear gain, not soon after the last change, and to a
lower degree only when that was better twice in a row: where a solution oscillates, single
derivatives pass through zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, sqrt
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from master_node.numerics.extrapolation import CouplingHistory, InputPolynomial
from master_node.numerics.powers import power
from protocol.signals import MAX_ORDER, FloatArray

GAIN = 1.15
"""H must be larger by this factor for a change. ``benchmarks.reproduction beyond`` chose it: so
``auto`` needs at most 1.10 times the do_steps of the best fixed polynomial."""

REST = 3
"""Double steps from one change to the next."""

TIMES_BETTER = 2
"""Number of times in a row that another polynomial must be better, unless it is of the next higher
degree and meets one derivative at most."""

SMOOTH = 0.25
"""Derivatives at two points are used where H u^(4) / 4! is less than this part of u^(3) / 3!: with
larger steps a solution is dominated by errors of the coupling itself, which the derivative at the
older point, made with extrapolated inputs, feeds back. Chosen as `GAIN`."""

LARGEST_FACTOR = 4.0
SMALLEST_FACTOR = 0.1

DEPTH = MAX_ORDER + 2
"""Communication points that the divided differences need."""

NO_BOUNDS: Mapping[InputPolynomial, float] = MappingProxyType({})
"""Nothing but the errors of the polynomials bounds H."""


class OrderMemory(NamedTuple):
    """Memory from one accepted step to the next.

    Attributes:
        polynomial: in use.
        steps: double steps accepted with it.
        better: the polynomial that was better last time, or None.
        times_better: how often in a row.
        magnitudes: of the last divided differences, shape (levels, groups); None at the start.
    """

    polynomial: InputPolynomial
    steps: int = 0
    better: InputPolynomial | None = None
    times_better: int = 0
    magnitudes: FloatArray | None = None


class Candidate(NamedTuple):
    """A polynomial that could be used next.

    Attributes:
        polynomial: as it is called.
        exponent: P of its error.
        orders: degree that the inputs of each group of outputs get, shape (groups,).
        sizes: |I_q| for each group over a double step of the same H, shape (groups,).
    """

    polynomial: InputPolynomial
    exponent: int
    orders: NDArray[np.intp]
    sizes: FloatArray

    def errors(self, magnitudes: FloatArray) -> FloatArray:
        """|u^(q+1) / (q+1)! I_q| for each group, shape (groups,)."""
        groups = np.arange(len(self.sizes))
        sizes: FloatArray = magnitudes[self.orders + 1, groups] * self.sizes
        return sizes

    def is_known(self, magnitudes: FloatArray) -> bool:
        """True if there are divided differences of the order that it takes."""
        return bool(self.orders.max() + 1 < len(magnitudes))


class Choice(NamedTuple):
    """Decision of the order control.

    Attributes:
        memory: to hand in with the next accepted step; holds the polynomial to use.
        factor: H of the next step over H of this one, when the polynomial changes; else None: the
            step size controller decides.
    """

    memory: OrderMemory
    factor: float | None


def ladder(*, has_derivatives: bool, derivative_points: int) -> tuple[InputPolynomial, ...]:
    """The polynomials among which to choose, in the order of their degrees.

    Args:
        has_derivatives: whether any input comes with its derivative.
        derivative_points: that may be used at most.
    """
    allowed = derivative_points if has_derivatives else 0
    once = min(allowed, 1)
    steps = [InputPolynomial(0)]
    steps += [InputPolynomial(order, once) for order in range(1, MAX_ORDER + 1)]
    if allowed > 1:
        steps.append(InputPolynomial(MAX_ORDER, 2))
    return tuple(steps)


def beginning(polynomials: Sequence[InputPolynomial]) -> InputPolynomial:
    """The one of a `ladder` for where only one communication point says anything."""
    return polynomials[1] if polynomials[1].derivative_points else polynomials[0]


def input_magnitudes(
    history: CouplingHistory,
    has_derivative: NDArray[np.bool_],
    scale: FloatArray,
    group_of_input: NDArray[np.intp],
    groups: int,
) -> FloatArray:
    """Weighted norms of u^(j) / j! for j = 0, 1, ..., from divided differences.

    Errors of the coupling make divided differences too large, more so where derivatives take
    part, so of the differences of the values and those with derivatives the smaller ones count.

    Args:
        history: newest points; as many levels as there are conditions, `DEPTH` at most.
        has_derivative: which inputs have one in the history, shape (n,); not those that lack it
            at one of the two newest points.
        scale: tolerances of the inputs, shape (n,), unit [u].
        group_of_input: index of the group that an input acts on, shape (n,).
        groups: how many groups there are.

    Returns:
        Shape (levels, groups), unit 1/s^j.
    """
    points = min(len(history.times), DEPTH)
    table = _differences(history, [(i, False) for i in range(points)])
    if has_derivative.any():
        known = [np.isfinite(rows[1]) for rows in history.inputs[: min(points, 2)]]
        has_derivative = has_derivative & np.logical_and.reduce(known)
    if has_derivative.any():
        doubled = [(i, again) for i in range(points) for again in (False, True)[: 1 + (i < 2)]]
        hermite = _differences(history, doubled[:DEPTH])
        common = min(len(table), len(hermite))
        smaller = (np.abs(hermite[:common]) < np.abs(table[:common])) & has_derivative
        table[:common] = np.where(smaller, hermite[:common], table[:common])
        if has_derivative.all():
            table = np.concatenate((table, hermite[common:]))
    squares = np.square(table / scale)
    norms: FloatArray = np.sqrt([np.bincount(group_of_input, row, groups) for row in squares])
    return norms


def _differences(history: CouplingHistory, nodes: Sequence[tuple[int, bool]]) -> FloatArray:
    """Newton's coefficients through the newest points, shape (levels, n).

    The same as `divided_differences`, with all differences of a level at once.

    Args:
        history: the points.
        nodes: number of the point, and whether it stands there for its derivative.
    """
    points = [point for point, _ in nodes]
    offsets = np.array([history.times[point] for point in points])
    level = np.array([history.inputs[point][0] for point in points])
    table = np.empty_like(level)
    table[0] = level[0]
    slopes = [i - 1 for i, (_, is_slope) in enumerate(nodes) if is_slope]
    for span in range(1, len(nodes)):
        gaps = offsets[:-span] - offsets[span:]
        if span == 1 and slopes:
            gaps[slopes] = 1.0
        level = (level[:-1] - level[1:]) / gaps[:, np.newaxis]
        if span == 1 and slopes:
            level[slopes] = [history.inputs[points[i]][1] for i in slopes]
        table[span] = level[0]
    return table


def choose(
    memory: OrderMemory,
    candidates: Sequence[Candidate],
    magnitudes: FloatArray,
    *,
    taken: Candidate,
    error: FloatArray,
    step_size: float,
    alpha: float,
    bounds: Mapping[InputPolynomial, float] = NO_BOUNDS,
) -> Choice:
    """The polynomial for the next double step, after one was accepted.

    Args:
        memory: from the last choice.
        candidates: that the history allows; the one in use among them.
        magnitudes: see `input_magnitudes`, shape (levels, groups).
        taken: the polynomial of the step just taken, with its sizes over that very step.
        error: what each group of outputs contributed to ERR in it, shape (groups,).
        step_size: H of that step [s].
        alpha: safety factor of the step size controller.
        bounds: of H over the present H with some polynomials, for other reasons.
    """
    stay = memory._replace(steps=memory.steps + 1, magnitudes=magnitudes)
    if not taken.is_known(magnitudes):
        return Choice(stay, None)
    caused = taken.errors(magnitudes)
    reaction = np.divide(error, caused, out=np.zeros_like(error), where=caused > 0.0)
    previous = memory.magnitudes
    smoothed = magnitudes.copy()
    if previous is not None:
        levels = min(len(previous), len(smoothed))
        np.maximum(smoothed[:levels], previous[:levels], out=smoothed[:levels])
    now = memory.polynomial
    factors = {
        candidate.polynomial: min(
            _factor(candidate, smoothed, reaction, alpha), bounds.get(candidate.polynomial, inf)
        )
        for candidate in candidates
        if abs(candidate.polynomial.order - now.order) <= 1
        and candidate.is_known(smoothed)
        and (candidate.polynomial.derivative_points < 2 or _is_smooth(smoothed, step_size))
    }
    return prefer(stay, factors)


def prefer(memory: OrderMemory, factors: Mapping[InputPolynomial, float]) -> Choice:
    """The polynomial that allows the largest H, by the rules that keep the choice calm.

    Args:
        memory: with the step just taken counted.
        factors: H that the polynomials allow, over the present H.
    """
    keep = Choice(memory._replace(better=None, times_better=0), None)
    if not factors:
        return keep
    now = memory.polynomial
    best = max(factors, key=factors.__getitem__)
    if best == now or factors[best] <= GAIN * factors.get(now, 0.0):
        return keep
    times = memory.times_better + 1 if memory.better == best else 1
    is_rise = best.order > now.order and best.derivative_points < 2
    needed = 1 if is_rise else TIMES_BETTER
    if times < needed or memory.steps < REST:
        return Choice(memory._replace(better=best, times_better=times), None)
    return Choice(OrderMemory(best, magnitudes=memory.magnitudes), factors[best])


def _factor(
    candidate: Candidate, magnitudes: FloatArray, reaction: FloatArray, alpha: float
) -> float:
    """H that a candidate allows, over the present H."""
    parts = reaction * candidate.errors(magnitudes)
    norm = sqrt(parts.dot(parts))
    if norm == 0.0:
        return LARGEST_FACTOR
    factor: float = alpha * power(norm, -1.0 / candidate.exponent)
    return min(LARGEST_FACTOR, max(SMALLEST_FACTOR, factor))


def _is_smooth(magnitudes: FloatArray, step_size: float) -> bool:
    if len(magnitudes) <= MAX_ORDER + 1:
        return False
    third, fourth = magnitudes[MAX_ORDER], magnitudes[MAX_ORDER + 1]
    return sqrt(fourth.dot(fourth)) * step_size < SMOOTH * sqrt(third.dot(third))
