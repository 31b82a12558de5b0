"""The first communication step size (Hairer, Nørsett and Wanner, Solving ODEs I, II.4).

The algorithm for ODE solvers asks for the right-hand side twice. A coupled system has none that
could be asked, but its outputs at three communication points give the same: their first and second
divided differences. So one double step with a very small H is tried, used for this, and taken back.
"""

from __future__ import annotations

from math import inf

import numpy as np

from master_node.numerics.powers import power
from protocol.signals import FloatArray

_SMALL = 1e-5
_WITHOUT_KNOWLEDGE = 1e-6


def trial_step_size(
    y: FloatArray, slope: FloatArray | None, scale: FloatArray, duration: float
) -> float:
    """H for the double step that is tried [s]: y changes by a hundredth of itself.

    Args:
        y: outputs at T_0, shape (m,).
        slope: their derivatives as far as they are known, else 0 or not finite, shape (m,); None:
            not at all.
        scale: ATOL + RTOL |y|, shape (m,).
        duration: simulated time [s].
    """
    d0 = _norm(y, scale)
    d1 = 0.0 if slope is None else _norm(np.where(np.isfinite(slope), slope, 0.0), scale)
    if d0 < _SMALL or d1 < _SMALL:
        return _WITHOUT_KNOWLEDGE * duration
    return min(0.01 * d0 / d1, 1e-3 * duration)


def untried_step_size(
    y: FloatArray, slope: FloatArray | None, scale: FloatArray, duration: float
) -> float:
    """H for a first step that cannot be taken back [s]: y changes by half of its tolerance.

    In two such steps it changes by the tolerance, so that even inputs held constant are within.

    Args:
        y: outputs at T_0, shape (m,).
        slope: their derivatives, shape (m,), not finite where one is not known; None: none is.
        scale: ATOL + RTOL |y|, shape (m,).
        duration: simulated time [s].
    """
    if slope is not None and not np.isfinite(slope).all():
        slope = None
    trial = trial_step_size(y, slope, scale, duration)
    d1 = 0.0 if slope is None else _norm(slope, scale)
    return min(trial, 0.5 / d1) if d1 > 0.0 else trial


def initial_step_size(
    y: FloatArray,
    y_middle: FloatArray,
    y_end: FloatArray,
    scale: FloatArray,
    *,
    trial: float,
    error_norm: float,
    exponent: int,
) -> float:
    """H for the first double step [s].

    Args:
        y: outputs at T_0, shape (m,).
        y_middle: at T_0 + H of the trial, shape (m,).
        y_end: at T_0 + 2H of the trial, shape (m,).
        scale: ATOL + RTOL |y|, shape (m,).
        trial: its H [s].
        error_norm: its ERR.
        exponent: P.

    Returns:
        A hundred times the trial's H at most; less where derivatives are large, or where ERR of
        the trial says so.
    """
    d1 = _norm((y_middle - y) / trial, scale)
    d2 = _norm((y_end - 2.0 * y_middle + y) / trial**2, scale)
    largest = max(d1, d2)
    degree = max(exponent, 2)  # a solution is at least once differentiable
    by_derivatives = (0.01 / largest) ** (1.0 / degree) if largest > 0.0 else inf
    by_error = trial * power(error_norm, -1.0 / exponent) if error_norm > 0.0 else inf
    return min(100.0 * trial, max(by_derivatives, trial), by_error)


def _norm(values: FloatArray, scale: FloatArray) -> float:
    if not values.size:
        return 0.0
    return float(np.sqrt(np.mean(np.square(values / scale))))
