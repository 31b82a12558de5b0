"""Points in time that are the same but for rounding, or but for the error of a solver."""

from __future__ import annotations

import math
import sys

_SLACK = 1e-4

_LOCATED = 200.0 * sys.float_info.epsilon
"""CVode locates a root to half of this part of the time and of its internal step."""


def meet(one: float, other: float) -> bool:
    """Whether two times [s] differ by nothing but rounding."""
    return abs(one - other) <= 4.0 * math.ulp(max(abs(one), abs(other)))


class ReportedEvent:
    """The event within a step that the master was told of last.

    The master goes back and comes again with a step that ends there. Then the event can lie a bit
    earlier or later, as the solver takes other steps: it is not to be told of once more.

    Attributes:
        time: of the event [s], NaN if there was none.
        slack: how far it can have moved [s].
    """

    def __init__(self) -> None:
        self.time = math.nan
        self.slack = 0.0

    def report(self, time: float, begin: float) -> None:
        """The master is told of an event at ``time`` in a step from ``begin`` [s]."""
        self.time = time
        self.slack = _SLACK * (time - begin)

    def is_expected(self, time: float, begin: float, end: float) -> bool:
        """Whether ``time`` is that event, in a step that ends or begins with it, or is ``begin``."""
        borders = meet(end, self.time) or meet(begin, self.time)
        is_begin = time - begin <= _LOCATED * (abs(time) + end - begin)
        return is_begin or (borders and abs(time - self.time) <= self.slack)
