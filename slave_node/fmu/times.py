"""Points in time that are the same but for rounding."""

from __future__ import annotations

import math


def meet(one: float, other: float) -> bool:
    """Whether two times [s] differ by nothing but rounding."""
    return abs(one - other) <= 4.0 * math.ulp(max(abs(one), abs(other)))
