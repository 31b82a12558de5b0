"""The error indicator ERR (the paper, equation (8))."""

from __future__ import annotations

from math import sqrt

import numpy as np

from protocol.signals import FloatArray


def error_scale(
    y: FloatArray, absolute_tolerance: FloatArray, relative_tolerance: FloatArray
) -> FloatArray:
    """ATOL_j + RTOL_j |y_j|, shape (m,), unit [y]; not finite where y_j is not.

    Args:
        y: outputs at the end of the double step, shape (m,).
        absolute_tolerance: ATOL_j, shape (m,), unit [y].
        relative_tolerance: RTOL_j, shape (m,).
    """
    scale: FloatArray = np.abs(y)
    scale *= relative_tolerance
    scale += absolute_tolerance
    return scale


def weighted_rms_norm(error: FloatArray, scale: FloatArray) -> tuple[float, int]:
    """ERR = sqrt( mean_j ( EST_j / (ATOL_j + RTOL_j |y_j|) )^2 ), and which j has most of it.

    Args:
        error: EST, shape (m,), unit [y].
        scale: see `error_scale`, shape (m,), unit [y].

    Returns:
        ERR and the index j of the largest part. Anything that is not finite in ``error`` or
        ``scale`` gives infinity and the index of such a value: NaN never passes. NumPy may warn of
        such values on the way, unless the caller has it ignore them. Without outputs ERR is 0.
    """
    if not error.size:
        return 0.0, 0
    weighted = np.abs(error)
    weighted /= scale
    square = weighted.dot(weighted)
    if not (square < _INF and scale.dot(scale) < _INF):  # true for NaN too
        bad = ~(np.isfinite(weighted) & np.isfinite(scale))
        if bad.any():
            return _INF, int(bad.argmax())
    return sqrt(square / len(weighted)), int(weighted.argmax())


def first_not_finite(y: FloatArray) -> int | None:
    """The first output with a NaN or an infinity in ``y``, shape (..., m); None: there is none."""
    if np.vdot(y, y) < _INF:
        return None
    bad = ~np.isfinite(y.reshape(-1, y.shape[-1])).all(axis=0)
    return int(bad.argmax()) if bad.any() else None


_INF = float("inf")
