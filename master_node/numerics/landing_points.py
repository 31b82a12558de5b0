"""Where double steps end rather than go over a point at which a known signal has a kink.

A double step may go over such points: its polynomials keep the mean and the first moment of the
signal. Ending there costs little and makes each step smooth. So a double step ends on the last such
point in its reach. Points closer to one another than the accuracy asks of H are passed over in this
way, as long as the error estimate allows it: after a rejection the next one ends on the first.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable

from master_node.numerics.double_step_times import DoubleStepTimes

_ROUNDING = 1.0 + 1e-9


class LandingPoints:
    """Some points in time.

    Args:
        times: of the points [s].
        smallest: bound of H [s]: what is nearer than a double step of it is passed over.
    """

    def __init__(self, times: Iterable[float], smallest: float) -> None:
        self._times = sorted(set(times))
        self._nearest = 2.0 * smallest

    def target(self, begin: float, step_size: float, target: float, *, first: bool) -> float:
        """Where the double steps from ``begin`` lead [s]: a point, or else ``target``.

        Args:
            begin: T_n [s].
            step_size: H that is wanted [s].
            target: where double steps must end [s].
            first: whether to end on the first point in reach, in place of the last.
        """
        times = self._times
        if not times:
            return target
        low = bisect_left(times, begin + self._nearest)
        high = bisect_right(times, target - self._nearest)
        reached = bisect_right(times, begin + 2.0 * step_size * _ROUNDING, low, max(low, high))
        if reached > low:
            return times[low if first else reached - 1]
        if low < high and times[low] < begin + 4.0 * step_size:
            return times[low]  # two double steps share the way, so that the second is not tiny
        return target

    def inside(self, times: DoubleStepTimes) -> float | None:
        """The first point strictly inside a double step [s], if H may be so small as to end there.

        None: there is none.
        """
        index = bisect_left(self._times, times.begin + self._nearest)
        if index < len(self._times) and self._times[index] < times.end:
            return self._times[index]
        return None
