"""Integrator of both models: the classical Runge-Kutta method of order 4."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil

LONGEST_STEP = 1e-3
"""Size of an internal step [s]."""


def integrate(
    derivatives: Callable[[list[float]], list[float]], x: list[float], step_size: float
) -> list[float]:
    """The states after ``step_size`` [s], with the inputs held: a communication step.

    Args:
        derivatives: of the states.
        x: the states before.
        step_size: H [s], divided into equal internal steps.
    """
    number = max(1, ceil(step_size / LONGEST_STEP))
    h = step_size / number
    for _ in range(number):
        k_1 = derivatives(x)
        k_2 = derivatives([a + 0.5 * h * b for a, b in zip(x, k_1, strict=True)])
        k_3 = derivatives([a + 0.5 * h * b for a, b in zip(x, k_2, strict=True)])
        k_4 = derivatives([a + h * b for a, b in zip(x, k_3, strict=True)])
        x = [
            a + h / 6.0 * (b + 2.0 * c + 2.0 * d + e)
            for a, b, c, d, e in zip(x, k_1, k_2, k_3, k_4, strict=True)
        ]
    return x
