"""Communication step sizes that the slaves take at all: bounds, fixed ones, multiples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import ceil, inf, lcm, ulp
from typing import NamedTuple, TypeVar

from master_node.numerics.double_step_times import DoubleStepTimes, step_end
from master_node.numerics.step_size_controller import last_step_size
from protocol.step_sums import step_to

_ROUNDING = 1e-10
"""Part of the smallest H by which a step may be smaller, as differences of times are."""


_NO_STEP = 0.25
"""Part of the smallest H that is left over by rounding only."""


class SlaveLimits(NamedTuple):
    """The rules of one slave for the size of its do_steps [s]; None: no such rule."""

    name: str
    step_size: float | None = None
    step_multiple: float | None = None
    smallest_step_size: float | None = None
    largest_step_size: float | None = None


class StepSizeLimitsError(Exception):
    """No communication step size follows all rules; the message says which contradict."""


@dataclass(frozen=True, slots=True)
class StepSizeLimits:
    """Limits of step sizes that hold for all slaves together.

    Attributes:
        smallest, largest: bounds of H [s].
        quantum: every H is a multiple of this [s], in the decimal digits that were given; None:
            any H.
        longest: H that the slaves take at most [s]: no step is longer, by the last bit.
        stop_time: where no step begins [s]: what ends a rounding before it ends there.
    """

    smallest: float
    largest: float
    quantum: Fraction | None = None
    longest: float = inf
    stop_time: float = inf

    @staticmethod
    def of(
        slaves: Sequence[SlaveLimits],
        smallest: float,
        largest: float,
        *,
        long_step: bool,
        given_by: str = "the simulation",
        stop_time: float = inf,
    ) -> StepSizeLimits:
        """The rules of all slaves, within the bounds of the simulation.

        Args:
            slaves: their rules.
            smallest: bound of the simulation [s].
            largest: bound of the simulation [s].
            long_step: whether steps of 2H are taken too.
            given_by: what to call the source of these bounds in messages.
            stop_time: of the simulation [s].

        Raises:
            StepSizeLimitsError: they contradict each other.
        """
        together = 2 if long_step else 1
        low = max(
            [(smallest, given_by)]
            + [(s.smallest_step_size, s.name) for s in slaves if s.smallest_step_size is not None]
        )
        ceilings = [
            (s.largest_step_size / together, s.name)
            for s in slaves
            if s.largest_step_size is not None
        ]
        high = min([(largest, given_by), *ceilings])
        longest = min((bound for bound, _ in ceilings), default=inf)
        multiples = [_decimal(s.step_multiple) for s in slaves if s.step_multiple is not None]
        quantum = _common(multiples)
        fixed = _fixed(slaves, multiples, long_step=long_step)
        if fixed is not None:
            quantum, low, high = _decimal(fixed[0]), max(low, fixed), min(high, fixed)
        elif quantum is not None:
            low = max(low, (float(quantum), "the common multiple"))
            low = (float(-(_decimal(low[0]) // -quantum) * quantum), low[1])
            high = (float(_decimal(high[0]) // quantum * quantum), high[1])
        if low[0] > high[0]:
            raise StepSizeLimitsError(
                f"the smallest step size {low[0]!r} s (of {low[1]}) is above the largest one, "
                f"{high[0]!r} s (of {high[1]})"
            )
        return StepSizeLimits(low[0], high[0], quantum, longest, stop_time)

    def check_span(self, begin: float, end: float, together: int = 2) -> None:
        """True if steps lead from ``begin`` to ``end`` [s], ``together`` of one size each time.

        Raises:
            StepSizeLimitsError: not with steps that are multiples of the quantum.
        """
        if self.quantum is None:
            return
        if (_decimal(end) - _decimal(begin)) % (together * self.quantum):
            number = "even" if together == 2 else "whole"
            raise StepSizeLimitsError(
                f"from {begin!r} s to {end!r} s there is no {number} number of steps of "
                f"{float(self.quantum)!r} s"
            )

    def check_ways(self, origin: float, ways: Sequence[tuple[float, float]]) -> None:
        """True if double steps lead from each beginning to its end [s].

        Args:
            origin: from where multiples are counted [s].
            ways: beginnings and ends.

        Raises:
            StepSizeLimitsError: one cannot be filled with double steps between the bounds of H.
        """
        for begin, end in ways:
            if not self.leads(origin, begin, end):
                raise StepSizeLimitsError(
                    f"from {begin!r} s to {end!r} s there are no double steps of two times "
                    f"{self.smallest!r} s to two times {self.largest!r} s each"
                )

    @property
    def lead_everywhere(self) -> bool:
        """True if double steps lead to any point that is not nearer than one of the smallest H."""
        return self.quantum is None and self.largest >= 2.0 * self.smallest

    def leads(self, origin: float, begin: float, end: float) -> bool:
        """True if double steps between the bounds of H lead from ``begin`` to ``end`` [s]."""
        if self.quantum is None:
            left = (end - begin) / 2.0
            rounding = self._rounding(begin, end)
            return _can_be_filled(left, self.smallest - rounding, self.largest + rounding)
        units = self._units(origin, end) - self._units(origin, begin)
        return units % 2 == 0 and _can_be_filled(units // 2, self._fewest, self._most)

    def landing(self, origin: float, begin: float, until: float, target: float) -> float | None:
        """The last point not behind ``until`` at which a double step from ``begin`` can end [s].

        Args:
            origin: from where multiples are counted [s].
            begin: T_n [s].
            until: not more than twice the largest H behind ``begin`` [s].
            target: to which double steps must lead from that point [s].

        Returns:
            None: there is none.
        """
        point = until
        if self.quantum is not None:
            done = self._units(origin, begin)
            units = (self._units(origin, until) - done) // 2
            point = float(_decimal(origin) + (done + 2 * units) * self.quantum)
        if point <= begin:
            return None
        leads = self.leads(origin, begin, point) and self.leads(origin, point, target)
        return point if leads else None

    def times(
        self, origin: float, begin: float, step_size: float, target: float
    ) -> DoubleStepTimes:
        """The next double step, so that the last one ends exactly on ``target``.

        When less than two double steps are left they share what is left, so that the last one is
        not arbitrarily small.

        Args:
            origin: from where multiples are counted [s].
            begin: T_n [s].
            step_size: H that is wanted [s].
            target: where double steps must end [s].
        """
        if self.quantum is None:
            times = self._free_times(begin, step_size, target)
        else:
            quantum, zero = self.quantum, _decimal(origin)
            done = self._units(origin, begin)
            left_units = (self._units(origin, target) - done) // 2
            units = self._planned_units(step_size, left_units)
            middle = float(zero + (done + units) * quantum)
            end = float(zero + (done + 2 * units) * quantum)
            size = float(units * quantum)
            times = DoubleStepTimes.through(begin, middle, end, size, self.longest)
        return times._replace(end=self.reached(times.end, target))

    def _free_times(self, begin: float, step_size: float, target: float) -> DoubleStepTimes:
        left = (target - begin) / 2.0
        size = self._planned(last_step_size(begin, target, step_size), left, begin, target)
        times = DoubleStepTimes.from_step_size(begin, min(size, self.longest))
        if size < left:
            return times
        times = DoubleStepTimes.through(begin, times.middle, target, size)
        if max(times.first, times.second) <= self.largest:
            return times
        half = 0.5 * size  # rounding makes two of this size too long, so there are two more
        if half >= self.smallest - self._rounding(begin, target):
            return DoubleStepTimes.from_step_size(begin, half)
        return DoubleStepTimes.through(begin, times.middle, target, size, self.longest)

    def reached(self, end: float, target: float) -> float:
        """The end of a step towards ``target`` [s]: itself, or the stop time if it is just that."""
        is_last = target == self.stop_time and self.has_reached(end, target)
        return target if is_last else end

    def bounded(self, step_size: float) -> float:
        """``step_size`` within the smallest and the largest one [s]."""
        return min(self.largest, max(self.smallest, step_size))

    def has_reached(self, time: float, target: float) -> bool:
        """True if ``time`` is ``target`` [s], or nearer to it than any step leads."""
        return target - time < _NO_STEP * self.smallest

    def is_cut_short(self, times: DoubleStepTimes, step_size: float) -> bool:
        """True if a double step has a smaller H than it would have with nothing to end on.

        Args:
            times: of the double step.
            step_size: H that was wanted [s].
        """
        if self.quantum is None:
            return times.first < DoubleStepTimes.from_step_size(times.begin, step_size).first
        return _decimal(times.step_size) + self.quantum <= _decimal(step_size)

    def step(
        self, origin: float, begin: float, step_size: float, target: float
    ) -> tuple[float, float]:
        """The end and the size of the next single step, so that the last one ends on ``target``.

        When less than two steps are left they share what is left. Arguments as for `times`.
        """
        if self.quantum is None:
            left = target - begin
            size = left if step_size >= left else min(step_size, left / 2.0)
            size = self._planned(size, left, begin, target)
            end, size = (target, left) if size >= left else step_end(begin, size)
        else:
            quantum, zero = self.quantum, _decimal(origin)
            done = self._units(origin, begin)
            units = self._planned_units(step_size, self._units(origin, target) - done)
            end, size = float(zero + (done + units) * quantum), float(units * quantum)
        size = step_to(begin, end, size, self.longest)
        return self.reached(begin + size, target), size

    def _planned(self, size: float, left: float, begin: float, target: float) -> float:
        """See `_planned`; above the largest H by rounding only where nothing else leads there."""
        rounding = self._rounding(begin, target)
        low = self.smallest - rounding
        planned = _planned(size, left, low, self.largest, rounding)
        if planned <= self.largest:
            return planned
        return _planned(size, left, low, self.largest + rounding, rounding)

    def _planned_units(self, step_size: float, left: int) -> int:
        """Number of quanta of the next H, with ``left`` of them to fill."""
        assert self.quantum is not None
        fewest = self._fewest
        units = max(fewest, int(_decimal(step_size) // self.quantum))
        if units >= left:
            units = left
        elif 2 * units > left:
            units = (left + 1) // 2
        return max(1, _planned(units, left, fewest, self._most))

    def _rounding(self, begin: float, end: float) -> float:
        """By what H of a double step between these times may miss its bounds [s]."""
        return 4.0 * ulp(max(abs(begin), abs(end))) + _ROUNDING * self.smallest

    def _units(self, origin: float, time: float) -> int:
        """Number of quanta from ``origin`` [s] to ``time`` [s]."""
        assert self.quantum is not None
        return round((Fraction(time) - _decimal(origin)) / self.quantum)

    @property
    def _fewest(self) -> int:
        """Smallest number of quanta of H."""
        assert self.quantum is not None
        return max(1, ceil(_decimal(self.smallest) / self.quantum))

    @property
    def _most(self) -> int:
        """Largest number of quanta of H."""
        assert self.quantum is not None
        return int(_decimal(self.largest) // self.quantum)

    def crossing(self, origin: float, event: float) -> DoubleStepTimes:
        """The double step of the smallest size that leads over an event at ``event`` [s].

        Its middle is the event; on a grid, which need not meet the event, its end is the first
        even multiple of the smallest size that is not before it.
        """
        size = self.smallest
        if self.quantum is None:
            mirrored, first = step_end(-event, size)
            end, second = step_end(event, size)
            return DoubleStepTimes(-mirrored, event, end, first, second, size)
        zero, step = _decimal(origin), _decimal(size)
        pair = 2 * step
        last = zero + pair * ceil((_decimal(event) - zero) / pair)
        begin, middle, end = float(last - pair), float(last - step), float(last)
        return DoubleStepTimes(begin, middle, end, middle - begin, end - middle, size)

    def crossed(self, begin: float, crossing: DoubleStepTimes) -> DoubleStepTimes:
        """The double step over an event as it is taken.

        Args:
            begin: where the slaves stand [s], before the event by a `crossing`'s way.
            crossing: over the event.
        """
        middle, end, size = crossing.middle, crossing.end, crossing.step_size
        return DoubleStepTimes.through(begin, middle, end, size, self.longest)


_Size = TypeVar("_Size", int, float)


def _planned(
    size: _Size, left: _Size, smallest: _Size, largest: _Size, rounding: float = 0.0
) -> _Size:
    """A size near ``size`` that leaves a rest which sizes between the bounds can fill.

    n sizes fill what is between n times the smallest and n times the largest. A rest in a gap
    between these is made larger if this size can be so small, else smaller.

    Args:
        size: that is wanted, not more than ``left``.
        left: to fill with this size and those that follow.
        smallest: bound of all of them.
        largest: bound of all of them.
        rounding: by which the last step was missed.
    """
    rest = left - size
    number = ceil(rest / largest)
    if number * smallest <= rest:
        return size
    smaller = left - number * smallest
    if smaller >= smallest - rounding:
        return smaller
    return min(left, left - (number - 1) * largest)


def _can_be_filled(left: _Size, smallest: _Size, largest: _Size) -> bool:
    """True if sizes between the bounds fill what is left; see `_planned`."""
    return ceil(left / largest) * smallest <= left


def _fixed(
    slaves: Sequence[SlaveLimits], multiples: Sequence[Fraction], *, long_step: bool
) -> tuple[float, str] | None:
    """The only step size that some slaves take [s], and one of them."""
    fixed = [(slave.step_size, slave.name) for slave in slaves if slave.step_size is not None]
    if not fixed:
        return None
    size, name = fixed[0]
    if long_step:
        raise StepSizeLimitsError(
            f"{name} takes steps of {size!r} s only, and EST_Rich needs steps of twice the size "
            "as well"
        )
    for other_size, other in fixed[1:]:
        if other_size != size:
            raise StepSizeLimitsError(
                f"{name} takes steps of {size!r} s only, {other} of {other_size!r} s only"
            )
    for multiple in multiples:
        if _decimal(size) % multiple:
            raise StepSizeLimitsError(
                f"{name} takes steps of {size!r} s only, which is no multiple of "
                f"{float(multiple)!r} s"
            )
    return size, name


def _decimal(value: float) -> Fraction:
    """The number as it was written: 0.1 is a tenth."""
    return Fraction(repr(float(value)))


def _common(multiples: Sequence[Fraction]) -> Fraction | None:
    """The smallest number that is a multiple of all."""
    if not multiples:
        return None
    denominator = lcm(*(m.denominator for m in multiples))
    return Fraction(lcm(*(int(m * denominator) for m in multiples)), denominator)
