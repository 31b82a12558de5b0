"""Where a double step begins, has its middle, and ends."""

from __future__ import annotations

from math import inf, nextafter
from typing import NamedTuple

from protocol.step_sums import step_to


class DoubleStepTimes(NamedTuple):
    """T_n, T_n + H and T_n + 2H [s], with the step sizes between them.

    Slaves are told the points and the sizes to the last bit: begin + first is the middle and
    middle + second the end, as slaves add them (`step_to`), and neither is beyond what was wanted.

    Attributes:
        begin, middle, end: communication points [s].
        first, second: sizes of the small steps [s]; both are H but for the rounding of the times,
            unless the middle was moved (`with_middle`).
        step_size: H [s]: half of the double step.
    """

    begin: float
    middle: float
    end: float
    first: float
    second: float
    step_size: float

    @staticmethod
    def from_step_size(begin: float, step_size: float) -> DoubleStepTimes:
        """Two steps of H [s]. See `step_end`."""
        middle, first = step_end(begin, step_size)
        end, second = step_end(middle, step_size)
        return DoubleStepTimes(begin, middle, end, first, second, first)

    @staticmethod
    def through(
        begin: float, middle: float, end: float, step_size: float, largest: float = inf
    ) -> DoubleStepTimes:
        """Two steps of H over these points [s], or where no size leads there just before them.

        Args:
            begin: communication point [s].
            middle: the next one [s].
            end: the one after that [s].
            step_size: H [s], but for rounding the difference of the points.
            largest: bound of H [s].
        """
        first = step_to(begin, middle, step_size, largest)
        middle = begin + first
        second = step_to(middle, end, step_size, largest)
        return DoubleStepTimes(begin, middle, middle + second, first, second, step_size)

    def with_middle(self, part: float) -> DoubleStepTimes:
        """This double step with its middle at ``part`` of the way, 0 to 1."""
        middle = self.begin + part * (self.end - self.begin)
        return DoubleStepTimes.through(self.begin, middle, self.end, self.step_size)

    @property
    def long(self) -> float:
        """The size of one step over both [s]: 2H, but not beyond the end."""
        return step_to(self.begin, self.end, self.first + self.second, self.first + self.second)


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
