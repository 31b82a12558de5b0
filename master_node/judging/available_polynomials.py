"""Polynomials that inputs can have, from the communication points that there are."""

from __future__ import annotations

from master_node.judging.defects import CouplingDefects
from master_node.numerics.error_estimators import Comparison, ErrorEstimator
from master_node.numerics.extrapolation import (
    CouplingHistory,
    Extrapolation,
    InputPolynomial,
    Polynomials,
)


class AvailablePolynomials:
    """Turns a polynomial that is wanted into the ones that a history allows.

    Args:
        extrapolation: of the system.
        estimator: whose comparison solution needs points of its own; None: there is none.
        coupling: whose defects must be known of the polynomials; None: those of no input.
    """

    def __init__(
        self,
        extrapolation: Extrapolation,
        estimator: ErrorEstimator | None = None,
        coupling: CouplingDefects | None = None,
    ) -> None:
        self._extrapolation = extrapolation
        self._estimator = estimator
        self._coupling = coupling

    def points(self, history: CouplingHistory) -> int:
        """Through how many points of ``history`` the next polynomials can go."""
        points = len(history.times)
        if self._estimator is not None:
            points = self._estimator.available(points)
        return points if self._coupling is None else min(points, self._coupling.points(history))

    def of(self, polynomial: InputPolynomial, history: CouplingHistory) -> Polynomials:
        """Polynomials nearest to ``polynomial``, for each kind of input, from the newest point."""
        points, known = self.points(history), self._extrapolation.known
        polynomials = self._extrapolation.polynomials(polynomial, points)
        polynomials = known(polynomials, history, points)
        if self._estimator is not None and self._estimator.comparison is Comparison.LONG_STEP:
            polynomials = known(polynomials, history.every_second(), points)
        if self._coupling is not None and len(history.times) > 1:
            polynomials = known(polynomials, history.before(1), points)
        return polynomials

    def allow(self, polynomial: InputPolynomial, history: CouplingHistory) -> bool:
        """True if all inputs can have its degree, but for those whose slaves never can."""
        return all(
            got.order == min(polynomial.order, kind.max_order)
            for got, kind in zip(
                self.of(polynomial, history), self._extrapolation.kinds, strict=True
            )
        )
