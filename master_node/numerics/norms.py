"""The error indicator ERR (the paper, equation (8))."""

from __future__ import annotations

from math import sqrt

import numpy as np

from protocol.signals import FloatArray


def weighted_rms_norm(
    error: FloatArray,
    y: FloatArray,
    absolute_tolerance: FloatArray,
    relative_tolerance: FloatArray,
) -> tuple[float, int]:
    """ERR = sqrt( mean_j ( EST_j / (ATOL_j + RTOL_j |y_j|) )^2 ), and which j has most of it.

    Args:
        error: EST, shape (m,), unit [y], m >= 1.
        y: outputs at the end of the double step, shape (m,).
        absolute_tolerance: ATOL_j, shape (m,), unit [y].
        relative_tolerance: RTOL_j, shape (m,).

    Returns:
        ERR and the index j of the largest part. Anything that is not finite in ``error`` or ``y``
        gives infinity and the index of such a value: NaN never passes. NumPy may warn of such
        values on the way, unless the caller has it ignore them.
    """
    scale = np.abs(y)
    scale *= relative_tolerance
    scale += absolute_tolerance
    weighted = np.abs(error)
    weighted /= scale
    square = weighted.dot(weighted)
    if square < np.inf and scale.dot(scale) < np.inf:  # false for NaN too
        return sqrt(square / len(weighted)), int(weighted.argmax())
    bad = ~(np.isfinite(weighted) & np.isfinite(y))
    if bad.any():
        return np.inf, int(bad.argmax())
    return sqrt(square / len(weighted)), int(weighted.argmax())  # only large


def first_not_finite(y: FloatArray) -> int | None:
    """The first output with a NaN or an infinity in ``y``, shape (rows, m); None: there is none."""
    if np.vdot(y, y) < np.inf:
        return None
    bad = ~np.isfinite(y).all(axis=0)
    return int(bad.argmax()) if bad.any() else None
