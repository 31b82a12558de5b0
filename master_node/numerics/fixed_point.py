"""Fixed points x = g(x) of algebraic loops across slaves, by Anderson acceleration.

Each evaluation of g is a round trip to the slaves, so what earlier ones gave is used: the next x
is the combination of the last few g(x_i) whose residuals g(x_i) - x_i cancel best (Anderson 1965;
Walker and Ni, SIAM J. Numer. Anal. 49, 2011). For a linear loop in n variables that ends after
n + 1 evaluations, also where the plain iteration x <- g(x) diverges.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from protocol.signals import FloatArray

MEMORY = 5
"""Largest number of differences of earlier residuals that are used."""


class NoFixedPointError(Exception):
    """The iteration did not converge.

    Attributes:
        residual: g(x) - x of the last evaluation, shape (n,).
    """

    def __init__(self, residual: FloatArray) -> None:
        super().__init__("the iteration did not converge")
        self.residual = residual


def fixed_point(
    g: Callable[[FloatArray], FloatArray],
    x: FloatArray,
    *,
    tolerance: FloatArray | float = 1e-12,
    evaluations: int = 100,
) -> FloatArray:
    """Find x = g(x).

    Args:
        g: to find the fixed point of; shape (n,) to shape (n,).
        x: where to begin, shape (n,).
        tolerance: bound of each |g(x) - x|, relative to max(1, |g(x)|); one or shape (n,).
        evaluations: of g at most.

    Returns:
        The last g(x), shape (n,).

    Raises:
        NoFixedPointError: it was not found, or values got out of the finite.
    """
    arguments: list[FloatArray] = []
    residuals: list[FloatArray] = []
    residual = np.full_like(x, np.nan)
    for _ in range(evaluations):
        value = g(x)
        residual = value - x
        if not np.isfinite(value).all():
            break
        if (np.abs(residual) <= tolerance * np.maximum(1.0, np.abs(value))).all():
            return value
        arguments = [*arguments[-MEMORY:], x]
        residuals = [*residuals[-MEMORY:], residual]
        x = _accelerated(arguments, residuals)
    raise NoFixedPointError(residual)


def _accelerated(arguments: list[FloatArray], residuals: list[FloatArray]) -> FloatArray:
    x, residual = arguments[-1], residuals[-1]
    if len(arguments) == 1:
        return x + residual
    dx = np.diff(arguments, axis=0).T
    dr = np.diff(residuals, axis=0).T
    scale = np.linalg.norm(dr, axis=0)
    scale[scale == 0.0] = 1.0
    weights = np.linalg.lstsq(dr / scale, residual, rcond=1e-12)[0] / scale
    following: FloatArray = x + residual - (dx + dr) @ weights
    return following
