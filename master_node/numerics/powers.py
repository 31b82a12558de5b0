"""Powers of numbers that may be as small or as large as numbers can be."""

from __future__ import annotations

import math


def power(base: float, exponent: float) -> float:
    """``base`` to the power of ``exponent``; infinity where that is too large for a number.

    Args:
        base: not below 0; not 0 where ``exponent`` is negative.
        exponent: any number.
    """
    try:
        return math.pow(base, exponent)
    except OverflowError:
        return math.inf
