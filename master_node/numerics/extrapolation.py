"""Input polynomials through past communication points (the paper, section 2), with derivatives.

An input polynomial of degree k meets k + 1 conditions: values u(T_n), u(T_(n-1)), ..., and, at the
newest points, where the output behind the input has one, the derivative too (Hermite). Newton's
divided differences, element by element for all inputs at once, so that constant inputs have
derivatives that are exactly zero and no input's polynomial depends on the other inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.signals import MAX_ORDER, FloatArray, InputSignal


class InputPolynomial(NamedTuple):
    """Which conditions an input polynomial meets.

    Attributes:
        order: degree k.
        derivative_points: at how many of the newest points the derivative is met as well as the
            value; 0: values only, the paper's polynomials.
    """

    order: int
    derivative_points: int = 0

    @property
    def points(self) -> int:
        """How many communication points it goes through."""
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
    """What polynomials an input can have.

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
        inputs: at each of them, shape (rows, n); row 0 is u, row 1, if there is one, u' (0 for
            inputs whose derivative is not known).
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
        return CouplingHistory(self.times[:1], self.inputs[:1], self.depth)

    def before(self, number: int) -> CouplingHistory:
        """Without the ``number`` newest points, of which there must be fewer than of all."""
        return CouplingHistory(self.times[number:], self.inputs[number:], self.depth)

    def every_second(self) -> CouplingHistory:
        """T_n, T_(n-2), T_(n-4), ...: the grid of one step of 2H."""
        return CouplingHistory(self.times[::2], self.inputs[::2], self.depth)


Nodes = tuple[float, ...]
"""Offsets of the conditions of one polynomial from T_n [s], newest first; a node stands there
twice where the derivative is met too."""


Polynomials = tuple[InputPolynomial, ...]
"""One polynomial for each kind of input."""


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

    def polynomials(self, polynomial: InputPolynomial, points: int) -> Polynomials:
        """What ``polynomial`` becomes for each kind, through ``points`` points at most."""
        return tuple(
            polynomial.limited(
                kind.max_order, polynomial.derivative_points * kind.has_derivative, points
            )
            for kind in self.kinds
        )

    def nodes(
        self, times: Sequence[float], polynomials: Polynomials, origin: float, known_ahead: int = 0
    ) -> list[Nodes]:
        """The nodes of each kind's polynomial through ``times``, as offsets from ``origin`` [s].

        Other arguments as for `signal`.
        """
        return [
            tuple(
                times[begin + i] - origin
                for i in range(polynomial.points)
                for _ in range(1 + (i < polynomial.derivative_points))
            )
            for begin, polynomial in zip(self._begins(known_ahead), polynomials, strict=True)
        ]

    def signal(
        self, history: CouplingHistory, polynomials: Polynomials, known_ahead: int = 0
    ) -> InputSignal:
        """The polynomials of all inputs around T_n, ``history.times[known_ahead]``.

        Args:
            history: to go through. Its first ``known_ahead`` points are of use for the inputs
                ``ahead`` only; the others may have anything there.
            polynomials: of each kind.
            known_ahead: 0 or 1.
        """
        times, inputs = history.times, history.inputs
        now = times[known_ahead]
        is_only_kind = len(self.kinds) == 1
        parts = []
        for columns, begin, (degree, slopes) in zip(
            self._columns, self._begins(known_ahead), polynomials, strict=True
        ):
            points = range(begin, begin + degree + 1 - slopes)
            values = [inputs[i][0] for i in points]
            slope_values = [inputs[i][1] for i in points[:slopes]]
            if not is_only_kind:
                values = [row[columns] for row in values]
                slope_values = [row[columns] for row in slope_values]
            rows = interpolate([times[i] - now for i in points], values, slope_values)
            parts.append(np.array(rows))
        if is_only_kind:
            return InputSignal(parts[0])
        derivatives = np.zeros((max(map(len, parts)), inputs[0].shape[1]))
        for columns, part in zip(self._columns, parts, strict=True):
            derivatives[: len(part), columns] = part
        return InputSignal(derivatives)

    def _begins(self, known_ahead: int) -> list[int]:
        """Where the points of each kind begin."""
        return [0 if kind.ahead else known_ahead for kind in self.kinds]


def interpolate(
    offsets: Sequence[float], values: Sequence[FloatArray], slopes: Sequence[FloatArray] = ()
) -> list[FloatArray]:
    """The polynomial through some points, with the derivatives at the first of them.

    Newton's confluent divided differences, then Horner's scheme to powers of the offset.

    Args:
        offsets: distinct offsets s_i of the points [s]; if one is 0, it is the first or second.
        values: there, shape (n,) each.
        slopes: derivatives at the first points, shape (n,) each, unit [u]/s.

    Returns:
        Derivatives of order 0 to k at offset 0, shape (n,) each; k + 1 is the number of values
        and slopes. At an offset 0 the value is met bit for bit.
    """
    if len(values) + len(slopes) <= 2 and not offsets[0]:  # degree 0 or 1, the usual short way
        rest = slopes or [(values[0] - older) / -offsets[1] for older in values[1:]]
        return [values[0], *rest]
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
    for j in range(2, k + 1):
        powers[j] = _FACTORIALS[j] * powers[j]
    return powers


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
