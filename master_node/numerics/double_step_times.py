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
            They are the differences of the times, so that slaves get neither ahead of the time nor
            behind it, however far apart neighbouring numbers are.
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
        end = middle + step_size if stop_time is None else stop_time
        return DoubleStepTimes(begin, middle, end, middle - begin, end - middle)
