"""Points in time that are the same but for rounding, or but for the error of a solver."""

from __future__ import annotations

import math
import sys

SLACK = 1e-4
"""The part of a step by which an event moves that is located again in a step that ends there."""

_LOCATED = 200.0 * sys.float_info.epsilon
"""CVode locates a root to half of this part of the time and of its internal step."""


def meet(one: float, other: float) -> bool:
    """True if two times [s] differ by nothing but rounding."""
    return abs(one - other) <= 4.0 * math.ulp(max(abs(one), abs(other)))


def is_within(time: float, begin: float, end: float) -> bool:
    """True if a time lies in a step, or beside it by roundings alone [s].

    The end of many steps differs from the time of an event by one rounding for each of them, and a
    slave that has an event there stops at the event.
    """
    located = _located(begin, end)
    return begin - located <= time <= end + located


def is_at_border(time: float, begin: float, end: float) -> bool:
    """True if an event at ``time`` is one at the begin or the end of a step [s].

    The master is not told of it: it stands there, or will. A master that was told of an event goes
    back and comes again with a step that ends there; then it lies a bit earlier or later. All this
    depends on the step alone, as a slave has no memory of what it was taken back from.
    """
    located = _located(begin, end)
    return time - begin <= located or end - time <= max(located, SLACK * (end - begin))


def _located(begin: float, end: float) -> float:
    return _LOCATED * (max(abs(begin), abs(end)) + end - begin)
