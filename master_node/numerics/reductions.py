"""One number out of a variable over time.

Between its points a variable is a straight line. Points are where the communication step size put
them, so what is a mean is an integral over time and not a sum over points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from protocol.signals import FloatArray

Reduction = Callable[[FloatArray, FloatArray], float]
"""Takes times [s] that do not decrease and values, both of shape (n,) with n >= 1."""


def integral(time: FloatArray, values: FloatArray) -> float:
    """The integral over time, unit [value] s."""
    return float(np.trapezoid(values, time))


def mean(time: FloatArray, values: FloatArray) -> float:
    """The integral over the duration; the last value where there is no duration."""
    duration = float(time[-1] - time[0])
    return integral(time, values) / duration if duration > 0.0 else float(values[-1])


def rms(time: FloatArray, values: FloatArray) -> float:
    """The root of the mean of the square, exact for straight lines between the points."""
    duration = float(time[-1] - time[0])
    if duration <= 0.0:
        return abs(float(values[-1]))
    left, right = values[:-1], values[1:]
    squares = np.diff(time) * (left * left + left * right + right * right) / 3.0
    return float(np.sqrt(max(float(squares.sum()), 0.0) / duration)) if _finite(squares) else np.nan


def _finite(values: FloatArray) -> bool:
    return bool(np.isfinite(values).all())


REDUCTIONS: Mapping[str, Reduction] = {
    "first": lambda _, values: float(values[0]),
    "last": lambda _, values: float(values[-1]),
    "min": lambda _, values: float(values.min()),
    "max": lambda _, values: float(values.max()),
    "max_abs": lambda _, values: float(np.abs(values).max()),
    "integral": integral,
    "mean": mean,
    "rms": rms,
}
"""By the names that a study gives them. A value that is not finite gives one that is not."""

REDUCTIONS_OF_VALUES = frozenset({"first", "last", "min", "max", "max_abs"})
"""Those that need the values at the points only, and not what is between them."""
