"""EST_Rich and EST_mod: the error of a double step from a comparison solution at T_n + 2H.

Both have the form EST = (y - y_comparison) / (1 - p), where p says how many times larger the
comparison solution's error is. To leading order the error of an output is proportional to the
integral of w(s) = prod(s - s_i) over the steps, s_i being the nodes of the input polynomial. On an
equidistant history s_i = 0, -1, ..., -k (in units of H) that gives for the two small steps

    2 int_0^1 s (s+1) ... (s+k) ds

and for the comparison solutions

    EST_Rich   int_0^2 of the product with nodes 0, -2, ..., -2k:     2^(k+2) int_0^1 ...
    EST_mod    int_0^2 s (s+1) ... (s+k) ds

so p = 2^(k+1) and p = 2, 14/5, 32/9, 1076/251 (the paper, section 2, gives the first three).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from protocol.signals import MAX_ORDER, FloatArray


class Comparison(StrEnum):
    """Which comparison solution an estimator needs."""

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
        ratios: p for k = 0, 1, 2, 3: error of the comparison solution over that of the two small
            steps, on an equidistant history and without direct feed-through.
    """

    name: str
    comparison: Comparison
    ratios: tuple[float, ...]

    def ratio(self, orders: NDArray[np.intp]) -> FloatArray:
        """The ratio p for each output, shape (m,).

        Args:
            orders: degree of the input polynomials of the slave that an output belongs to,
                shape (m,).
        """
        return np.array(self.ratios)[orders]

    def points(self, order: int) -> int:
        """How many communication points an input polynomial of degree ``order`` needs."""
        return 2 * order + 1 if self.comparison is Comparison.LONG_STEP else order + 1

    def order(self, order: int, points: int) -> int:
        """The highest degree up to ``order`` for which ``points`` communication points suffice."""
        available = (points - 1) // 2 if self.comparison is Comparison.LONG_STEP else points - 1
        return min(order, available)

    @staticmethod
    def estimate(y: FloatArray, y_comparison: FloatArray, ratio: FloatArray) -> FloatArray:
        """EST, shape (m,), unit [y]: (y - y_comparison) / (1 - p)."""
        return (y - y_comparison) / (1.0 - ratio)


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
