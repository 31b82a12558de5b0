"""Where a double step begins, has its middle, and ends."""

from __future__ import annotations

from typing import NamedTuple


class DoubleStepTimes(NamedTuple):
    """T_n, T_n + H and T_n + 2H [s], with the step sizes between them.

    The times are given beside the step sizes so that a run's last point is the stop time itself
    and points on a grid are multiples of its interval, not sums of rounded steps.

    Attributes:
        begin, middle, end: communication points [s].
        first, second: sizes of the small steps [s]; both are H but for the rounding of the times.
            See `size_between`.
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
        middle = begin + step_size
        first = size_between(begin, middle, step_size)
        if stop_time is None:
            end = middle + step_size
            return DoubleStepTimes(begin, middle, end, first, size_between(middle, end, step_size))
        return DoubleStepTimes(begin, middle, stop_time, first, stop_time - middle)


def size_between(begin: float, end: float, step_size: float) -> float:
    """The size of a step of H between times [s] of which one is the other + H, but for rounding.

    Far from t = 0 rounding moves T + H by up to a percent of H, the same way in step after step of
    the same H. Slaves that took H would get ahead of the time or fall behind it, so there it is the
    difference of the times. Where that is H to twelve digits it is H as it was given.
    """
    difference = end - begin
    return step_size if abs(difference - step_size) <= _NEGLIGIBLE * step_size else difference


_NEGLIGIBLE = 1e-12
