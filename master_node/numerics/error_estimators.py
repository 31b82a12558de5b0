"""EST_Rich and EST_mod: the error of a double step from a comparison solution at T_n + 2H.

Both have the form EST = (y - y_comparison) / (1 - p), where p says how many times larger the
comparison solution's error is. Let s_i be the nodes of an input polynomial, a node counting once
more where the derivative is met too, and w(s) = prod(s - s_i). The input is wrong by a multiple of
w, so to leading order an output without direct feed-through is wrong by a multiple of the integral
of w over the steps, one with feed-through by a multiple of w at the end:

    p = I(comparison) / I(two small steps)
    no feed-through   I(two small steps) = int_0^H w_A + int_H^2H w_B
                      I(EST_mod) = int_0^2H w_A         I(EST_Rich) = int_0^2H w_L
    feed-through      w_A(2H) / w_B(2H)                 w_L(2H) / w_B(2H)

A is the polynomial built at T_n, B the one built at T_n + H, L that of the long step. `exact_ratio`
computes this for any nodes. On an equidistant history, values only, without feed-through, it gives
the paper's constants, 2^(k+1) and 2, 14/5, 32/9 (section 2): `paper_ratio`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from math import sqrt

from master_node.numerics.extrapolation import Nodes
from protocol.signals import MAX_ORDER, FloatArray


class Comparison(StrEnum):
    """Comparison solution that an estimator needs."""

    LONG_STEP = "long step"
    """One step of 2H with inputs through every second communication point."""
    SAME_POLYNOMIAL = "same polynomial"
    """A second step of H that goes on with the polynomial of the first."""


@dataclass(frozen=True)
class ErrorEstimator:
    """An estimate and the comparison solution that belongs to it.

    Attributes:
        name: as the user writes it.
        comparison: the comparison solution.
        paper_ratios: p for k = 0, 1, 2, 3: error of the comparison solution over that of the two
            small steps, on an equidistant history, values only and without direct feed-through.
    """

    name: str
    comparison: Comparison
    paper_ratios: tuple[float, ...]

    @property
    def needs_long_step(self) -> bool:
        """True if a step of 2H is taken, so that slaves must be able to take one."""
        return self.comparison is Comparison.LONG_STEP

    def points(self, points: int) -> int:
        """Depth of history for input polynomials through ``points`` points."""
        return 2 * points - 1 if self.needs_long_step else points

    def available(self, points: int) -> int:
        """Number of communication points, of ``points``, through which all its polynomials go."""
        return (points + 1) // 2 if self.needs_long_step else points

    @staticmethod
    def estimate(difference: FloatArray, ratio: FloatArray | float) -> FloatArray:
        """EST, shape (m,), unit [y]: (y - y_comparison) / (1 - p).

        Args:
            difference: of the two small steps from the comparison solution, shape (m,), unit [y].
            ratio: p, one for all or one for each output, shape (m,).
        """
        return difference / (1.0 - ratio)


_GAUSS = sqrt(0.6)


def node_polynomial(nodes: Nodes, offset: float) -> float:
    """w(offset) = prod(offset - s_i)."""
    value = 1.0
    for node in nodes:
        value *= offset - node
    return value


def node_integral(nodes: Nodes, begin: float, end: float) -> float:
    """The integral of w from ``begin`` to ``end``, for at most five nodes.

    Three Gauss points: exact up to rounding for polynomials of degree five. For two nodes, the
    usual ones, what comes of them is 2 h (w(m) + h^2 / 3) with the middle m and the half h.
    """
    half, middle = 0.5 * (end - begin), 0.5 * (begin + end)
    if len(nodes) == 2:
        newest, older = nodes
        return 2.0 * half * ((middle - newest) * (middle - older) + half * half / 3.0)
    outer = _GAUSS * half
    return (half / 9.0) * (
        5.0 * node_polynomial(nodes, middle - outer)
        + 8.0 * node_polynomial(nodes, middle)
        + 5.0 * node_polynomial(nodes, middle + outer)
    )


def exact_ratio(
    first: Nodes, second: Nodes, comparison: Nodes, middle: float, end: float, *, feed_through: bool
) -> float:
    """The ratio p for one output, from the nodes of the polynomials that its inputs had.

    Args:
        first: nodes of the first small step, as offsets from T_n [s].
        second: nodes of the second one.
        comparison: nodes of the comparison solution; for EST_mod ``first`` once more.
        middle: offset of T_n + H [s].
        end: offset of T_n + 2H [s].
        feed_through: whether the output depends directly on these inputs.
    """
    if feed_through:
        return node_polynomial(comparison, end) / node_polynomial(second, end)
    small = small_steps_integral(first, second, middle, end)
    return node_integral(comparison, 0.0, end) / small


def small_steps_integral(first: Nodes, second: Nodes, middle: float, end: float) -> float:
    """I(two small steps), unit s^(k+2); arguments as for `exact_ratio`."""
    return node_integral(first, 0.0, middle) + node_integral(second, middle, end)


def _node_integral(order: int, end: int) -> Fraction:
    """int_0^end s (s+1) ... (s+k) ds, exactly."""
    coefficients = [Fraction(1)]
    for node in range(order + 1):
        times_s = [Fraction(0), *coefficients]
        coefficients = [
            a + node * b for a, b in zip(times_s, [*coefficients, Fraction(0)], strict=True)
        ]
    return sum(
        (c * Fraction(end) ** (j + 1) / (j + 1) for j, c in enumerate(coefficients)), Fraction(0)
    )


def _mod_ratio(order: int) -> Fraction:
    return _node_integral(order, 2) / (2 * _node_integral(order, 1))


_ORDERS = range(MAX_ORDER + 1)

EST_RICH = ErrorEstimator("rich", Comparison.LONG_STEP, tuple(2.0 ** (k + 1) for k in _ORDERS))
EST_MOD = ErrorEstimator(
    "mod", Comparison.SAME_POLYNOMIAL, tuple(float(_mod_ratio(k)) for k in _ORDERS)
)

ESTIMATORS = {estimator.name: estimator for estimator in (EST_RICH, EST_MOD)}
