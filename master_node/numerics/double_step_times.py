"""Where a double step begins, has its middle, and ends."""

from __future__ import annotations

from typing import NamedTuple


class DoubleStepTimes(NamedTuple):
    """T_n, T_n + H and T_n + 2H [s], with the step sizes between them.

    The times are given beside the step sizes so that a run's last point is the stop time itself
    and points on a grid are multiples of its interval, not sums of rounded steps.

    Attributes:
        begin, middle, end: communication points [s].
        first, second: sizes of the small steps [s]; both are H but for rounding.
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
        if stop_time is None:
            return DoubleStepTimes(begin, middle, middle + step_size, step_size, step_size)
        return DoubleStepTimes(begin, middle, stop_time, step_size, stop_time - middle)
