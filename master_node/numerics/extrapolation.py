"""Input polynomials through past communication points (the paper, section 2), with derivatives.

An input polynomial of degree k meets k + 1 conditions: values u(T_n), u(T_(n-1)), ..., and, at the
newest points, where the output behind the input has one, the derivative too (Hermite). Newton's
divided differences, element by element for all inputs at once, so that constant inputs have
derivatives that are exactly zero and no input's polynomial depends on the other inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.signals import MAX_ORDER, FloatArray, InputSignal


class InputPolynomial(NamedTuple):
    """Conditions that an input polynomial meets.

    Attributes:
        order: degree k.
        derivative_points: at how many of the newest points the derivative is met as well as the
            value; 0: values only, the paper's polynomials.
    """

    order: int
    derivative_points: int = 0

    @property
    def points(self) -> int:
        """Number of communication points it goes through."""
        return self.order + 1 - self.derivative_points

    def limited(self, order: int, derivative_points: int, points: int) -> InputPolynomial:
        """The nearest polynomial within these limits, of the degree that they leave possible."""
        derivatives = min(self.derivative_points, derivative_points, points)
        degree = min(self.order, order, points - 1 + derivatives)
        return InputPolynomial(degree, min(derivatives, (degree + 1) // 2))

    def __str__(self) -> str:
        return f"{self.order}" + "'" * self.derivative_points


POLYNOMIALS = tuple(
    InputPolynomial(order, derivative_points)
    for order in range(MAX_ORDER + 1)
    for derivative_points in range((order + 1) // 2 + 1)
)
"""All that can go over the wire: 0, 1, 1', 2, 2', 3, 3', 3''."""


class InputKind(NamedTuple):
    """Kind of polynomials that an input can have.

    Attributes:
        max_order: highest degree that its slave takes; 0 without canInterpolateInputs.
        has_derivative: whether the output behind it comes with its derivative.
        ahead: whether its value at the end of a step is known before its slave takes the step,
            because the slave behind it goes first (Gauss-Seidel).
        late: whether its value is not known before its slave has taken a whole double step,
            because the slave behind it cannot go back and goes last.
    """

    max_order: int = MAX_ORDER
    has_derivative: bool = False
    ahead: bool = False
    late: bool = False


class CouplingHistory(NamedTuple):
    """The inputs at the last communication points. Immutable: rejecting a step is keeping it.

    Attributes:
        times: T_n, T_(n-1), ..., newest first [s].
        inputs: at each of them, shape (rows, n); row 0 is u, row 1, if there is one, u': 0 for
            inputs that never have one, not finite where an input that has one lacks it.
        depth: how many points are kept at most.
    """

    times: tuple[float, ...]
    inputs: tuple[FloatArray, ...]
    depth: int

    @staticmethod
    def start(time: float, inputs: FloatArray, depth: int) -> CouplingHistory:
        """Only the first communication point, ``inputs`` of shape (rows, n)."""
        return CouplingHistory((time,), (inputs,), depth)

    @staticmethod
    def at_rest(time: float, inputs: FloatArray, depth: int, step_size: float) -> CouplingHistory:
        """A system that rested before T_0: u(T_0) at T_0 - i H_0 for i = 0 ... depth - 1."""
        times = tuple(time - i * step_size for i in range(depth))
        resting = np.zeros_like(inputs)
        resting[0] = inputs[0]
        return CouplingHistory(times, (inputs, *[resting] * (depth - 1)), depth)

    def pushed(self, time: float, inputs: FloatArray) -> CouplingHistory:
        """With a newer communication point, without the oldest one where the depth is reached.

        Args:
            time: of the point [s].
            inputs: there, shape (rows, n).
        """
        keep = self.depth - 1
        return CouplingHistory(
            (time, *self.times[:keep]), (inputs, *self.inputs[:keep]), self.depth
        )

    def cut(self) -> CouplingHistory:
        """The newest point alone: what was before a discontinuity says nothing any more."""
        return self.newest(1)

    def newest(self, number: int) -> CouplingHistory:
        """The ``number`` newest points alone."""
        return CouplingHistory(self.times[:number], self.inputs[:number], self.depth)

    def before(self, number: int) -> CouplingHistory:
        """Without the ``number`` newest points, of which there must be fewer than of all."""
        return CouplingHistory(self.times[number:], self.inputs[number:], self.depth)

    def without_slopes(self) -> CouplingHistory:
        """With no derivative at the newest point."""
        newest = self.inputs[0].copy()
        newest[1:] = np.nan
        return CouplingHistory(self.times, (newest, *self.inputs[1:]), self.depth)

    def slopes(self, columns: NDArray[np.intp], most: int) -> int:
        """At how many of the newest points, ``most`` at most, these inputs have derivatives."""
        for number, rows in enumerate(self.inputs[:most]):
            if not np.isfinite(rows[1].take(columns)).all():
                return number
        return min(most, len(self.inputs))

    def every_second(self) -> CouplingHistory:
        """T_n, T_(n-2), T_(n-4), ...: the grid of one step of 2H."""
        return CouplingHistory(self.times[::2], self.inputs[::2], self.depth)


Nodes = tuple[float, ...]
"""Offsets of the conditions of one polynomial from T_n [s], newest first; a node stands there
twice where the derivative is met too."""


Polynomials = tuple[InputPolynomial, ...]
"""One polynomial for each kind of input."""


_LINES: Polynomials = (InputPolynomial(1),)


@lru_cache
def highest(polynomials: Polynomials) -> InputPolynomial:
    """The highest degree among them, with the most derivative points."""
    return InputPolynomial(
        max(polynomial.order for polynomial in polynomials),
        max(polynomial.derivative_points for polynomial in polynomials),
    )


class Extrapolation:
    """The input polynomials of a system, each input's by its kind.

    Args:
        kinds: the kinds of input that the system has; at least one.
        kind_of_input: for each of the n inputs the index of its kind, shape (n,).
    """

    def __init__(self, kinds: Sequence[InputKind], kind_of_input: NDArray[np.intp]) -> None:
        self.kinds = tuple(kinds)
        self.kind_of_input = kind_of_input
        self._columns = [np.flatnonzero(kind_of_input == i) for i in range(len(self.kinds))]
        # where the points of each kind begin, by the number of points that are known ahead
        self._begins = [[0 if kind.ahead else ahead for kind in self.kinds] for ahead in (0, 1)]
        self._polynomials = lru_cache(self._limited)

    def polynomials(self, polynomial: InputPolynomial, points: int) -> Polynomials:
        """Polynomials that ``polynomial`` becomes, per kind, through at most ``points`` points."""
        return self._polynomials(polynomial, points)

    def _limited(self, polynomial: InputPolynomial, points: int) -> Polynomials:
        return tuple(
            polynomial.limited(
                kind.max_order, polynomial.derivative_points * kind.has_derivative, points
            )
            for kind in self.kinds
        )

    def known(
        self, polynomials: Polynomials, history: CouplingHistory, points: int | None = None
    ) -> Polynomials:
        """The polynomials as far as ``history`` has the derivatives that they meet.

        A derivative that is not finite is none at its point: inputs of that kind meet its value
        alone, and more points where there are any.

        Args:
            polynomials: of each kind, see `polynomials`.
            history: with all points that they can go through.
            points: through how many of them they may go; None: all.
        """
        if not any(polynomial.derivative_points for polynomial in polynomials):
            return polynomials
        points = len(history.times) if points is None else points
        return tuple(
            [
                polynomial.limited(polynomial.order, history.slopes(columns, slopes), points)
                if (slopes := polynomial.derivative_points)
                else polynomial
                for columns, polynomial in zip(self._columns, polynomials, strict=True)
            ]
        )

    def nodes(
        self, times: Sequence[float], polynomials: Polynomials, origin: float, known_ahead: int = 0
    ) -> list[Nodes]:
        """The nodes of each kind's polynomial through ``times``, as offsets from ``origin`` [s].

        Other arguments as for `signal`.
        """
        return self.nodes_at(tuple([time - origin for time in times]), polynomials, known_ahead)

    def nodes_at(
        self, offsets: Nodes, polynomials: Polynomials, known_ahead: int = 0
    ) -> list[Nodes]:
        """Polynomial through points at these offsets [s]."""
        begins = self._begins[known_ahead]
        if len(polynomials) == 1:
            return [_nodes(offsets, begins[0], polynomials[0])]
        return [
            _nodes(offsets, begin, polynomial)
            for begin, polynomial in zip(begins, polynomials, strict=True)
        ]

    def signal(
        self, history: CouplingHistory, polynomials: Polynomials, known_ahead: int = 0
    ) -> InputSignal:
        """The polynomials of all inputs around T_n, ``history.times[known_ahead]``.

        Args:
            history: to go through. Its first ``known_ahead`` points are of use for the inputs
                ``ahead`` only; the others may have anything there.
            polynomials: of each kind; where it lacks a derivative that they meet, see `known`.
            known_ahead: 0 or 1.
        """
        polynomials = self.known(polynomials, history.before(known_ahead))
        begins = self._begins[known_ahead]
        if len(polynomials) == 1:
            return InputSignal(_rows(history, begins[0], polynomials[0], known_ahead))
        parts = [
            _rows(history, begin, polynomial, known_ahead, columns)
            for columns, begin, polynomial in zip(self._columns, begins, polynomials, strict=True)
        ]
        derivatives = np.zeros((max(map(len, parts)), history.inputs[0].shape[1]))
        for columns, part in zip(self._columns, parts, strict=True):
            derivatives[: len(part), columns] = part
        return InputSignal(derivatives)

    def in_step(
        self,
        history: CouplingHistory,
        polynomials: Polynomials,
        step_size: float,
        known_ahead: int = 0,
    ) -> StepInputs:
        """Signals at both ends of a step of ``step_size`` [s]; other arguments as for `signal`."""
        if polynomials == _LINES and self._begins[known_ahead][0] == known_ahead:  # the usual ones
            times, inputs = history.times, history.inputs
            now, before = known_ahead, known_ahead + 1
            return _line(inputs[now][0], inputs[before][0], times[now] - times[before], step_size)
        signal = self.signal(history, polynomials, known_ahead)
        return StepInputs(signal.derivatives, signal.shifted(step_size).derivatives)


class StepInputs(NamedTuple):
    """Input polynomials at both ends of a step, shape (k + 1, n) each."""

    begin: FloatArray
    end: FloatArray


def _line(newest: FloatArray, older: FloatArray, span: float, step_size: float) -> StepInputs:
    """Straight lines through two points ``span`` [s] apart, in a step from the newest one."""
    slope = newest - older
    slope /= span
    end = slope * step_size
    end += newest
    return StepInputs(np.array((newest, slope)), np.array((end, slope)))


def _nodes(offsets: Nodes, begin: int, polynomial: InputPolynomial) -> Nodes:
    """The nodes of one polynomial whose points begin at ``offsets[begin]``."""
    order, slopes = polynomial
    nodes = offsets[begin : begin + order + 1 - slopes]
    if slopes:
        return (*[node for node in nodes[:slopes] for _ in (0, 1)], *nodes[slopes:])
    return nodes


def _rows(
    history: CouplingHistory,
    begin: int,
    polynomial: InputPolynomial,
    now: int,
    columns: NDArray[np.intp] | None = None,
) -> FloatArray:
    """Derivatives of one polynomial at ``history.times[now]``, shape (k + 1, n).

    Args:
        history: to go through, from point number ``begin`` on.
        begin: see above.
        polynomial: of these inputs.
        now: number of the point.
        columns: of the inputs; None: all.
    """
    order, slopes = polynomial
    times, inputs = history.times, history.inputs
    end = begin + order + 1 - slopes
    values = [rows[0] for rows in inputs[begin:end]]
    slope_values = [rows[1] for rows in inputs[begin : begin + slopes]]
    if columns is not None:
        values = [row[columns] for row in values]
        slope_values = [row[columns] for row in slope_values]
    origin = times[now]
    return interpolate([time - origin for time in times[begin:end]], values, slope_values)


def interpolate(
    offsets: Sequence[float], values: Sequence[FloatArray], slopes: Sequence[FloatArray] = ()
) -> FloatArray:
    """The polynomial through some points, with the derivatives at the first of them.

    Newton's confluent divided differences, then Horner's scheme to powers of the offset.

    Args:
        offsets: distinct offsets s_i of the points [s]; if one is 0, it is the first or second.
        values: there, shape (n,) each.
        slopes: derivatives at the first points, shape (n,) each, unit [u]/s.

    Returns:
        Derivatives of order 0 to k at offset 0, shape (k + 1, n); k + 1 is the number of values
        and slopes. At an offset 0 the value is met bit for bit.
    """
    nodes: list[float] = []
    level: list[FloatArray] = []
    for i, (offset, value) in enumerate(zip(offsets, values, strict=True)):
        repeated = 1 + (i < len(slopes))
        nodes += [offset] * repeated
        level += [value] * repeated
    newton = divided_differences(nodes, level, slopes)
    k = len(nodes) - 1
    powers = [newton[k]]  # coefficients of powers of the offset
    for i in range(k - 1, -1, -1):
        node = nodes[i]
        powers.insert(0, newton[i])
        if node:
            for j in range(k - i):
                powers[j] = powers[j] - node * powers[j + 1]
    if 0.0 in offsets:
        powers[0] = values[offsets.index(0.0)]
    rows = np.empty((k + 1, len(values[0])))
    for j, power in enumerate(powers):
        np.multiply(_FACTORIALS[j], power, out=rows[j])
    return rows


_FACTORIALS = (1.0, 1.0, 2.0, 6.0)


def divided_differences(
    nodes: Sequence[float], values: Sequence[FloatArray], slopes: Sequence[FloatArray] = ()
) -> list[FloatArray]:
    """Newton's coefficients u[s_0], u[s_0, s_1], ..., shape (n,) each.

    Args:
        nodes: s_0, s_1, ... [s]; equal neighbours, two at most, are one point with a derivative.
        values: at the nodes, shape (n,) each.
        slopes: the derivatives of the repeated nodes, in order, shape (n,) each.

    Returns:
        As many as nodes; the j-th is u^(j) / j! somewhere among the first j + 1 nodes.
    """
    level = list(values)
    newton = [level[0]]
    slope = iter(slopes)
    for span in range(1, len(nodes)):
        following = []
        for i in range(len(nodes) - span):
            gap = nodes[i] - nodes[i + span]
            following.append((level[i] - level[i + 1]) / gap if gap else next(slope))
        level = following
        newton.append(level[0])
    return newton
