"""Sums of times as slaves make them: a step of h from t ends at t + h, rounded once.

A slave knows where it stands only from what it was told: t and h. A strict one refuses a step that
begins elsewhere, by the last bit, and one that leads beyond a time that it was told. So a master
tells sizes whose sums are the points that it tells next.
"""

from __future__ import annotations

from math import inf, nextafter


def step_to(begin: float, end: float, wanted: float | None = None, largest: float = inf) -> float:
    """The size h of a step from ``begin`` that ends on ``end`` [s], as a slave adds it.

    Never beyond it: begin + h <= end. Where no size up to ``largest`` leads there, begin + h is
    the last time before it to which one does. (From t > 0 to 2t at most there always is one.
    Others leave out every second time or so, far nearer to 0 than the step is long.)

    Args:
        begin: where the slave stands [s].
        end: later than that [s].
        wanted: taken if it leads there [s], rather than the difference of the times; None: that.
        largest: size that the slave takes [s].
    """
    if wanted is not None and wanted <= largest and begin + wanted == end:
        return wanted
    size = min(end - begin, largest)
    if begin + size > end:
        return nextafter(size, 0.0)
    larger = nextafter(size, inf)
    return larger if begin + size < begin + larger <= end and larger <= largest else size
