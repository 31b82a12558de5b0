"""Where a double step begins, has its middle, and ends."""

from __future__ import annotations

from math import nextafter
from typing import NamedTuple


class DoubleStepTimes(NamedTuple):
    """T_n, T_n + H and T_n + 2H [s], with the step sizes between them.

    The times are given beside the step sizes so that a run's last point is the stop time itself
    and points on a grid are multiples of its interval, not sums of rounded steps.

    Attributes:
        begin, middle, end: communication points [s].
        first, second: sizes of the small steps [s]; both are H but for the rounding of the times.
            See `step_end`.
    """

    begin: float
    middle: float
    end: float
    first: float
    second: float

    @staticmethod
    def from_step_size(
        begin: float, step_size: float, stop_time: float | None = None
    ) -> DoubleStepTimes:
        """Two steps of H [s]; with ``stop_time`` the second ends exactly there."""
        middle, first = step_end(begin, step_size)
        if stop_time is not None:
            return DoubleStepTimes(begin, middle, stop_time, first, stop_time - middle)
        end, second = step_end(middle, step_size)
        return DoubleStepTimes(begin, middle, end, first, second)


def step_end(begin: float, step_size: float) -> tuple[float, float]:
    """Where a step of H from ``begin`` ends [s], and its size.

    It is not above H, unless there is no number between ``begin`` and that end.

    Far from t = 0 rounding moves T + H by up to a percent of H, the same way in step after step of
    the same H. Slaves that took H would get ahead of the time or fall behind it, so there the size
    is the difference of the times. Where that is H to twelve digits it is H as it was given.
    """
    end = begin + step_size
    size = end - begin
    if abs(size - step_size) <= _NEGLIGIBLE * step_size:
        return end, step_size
    before = nextafter(end, begin)
    if size > step_size and before > begin:  # a slave may take no more than H
        return before, before - begin
    return end, size


_NEGLIGIBLE = 1e-12
