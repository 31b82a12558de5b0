"""Targets: points in time where steps must end, and known events that they lead over."""

from __future__ import annotations

from math import floor
from typing import NamedTuple

from master_node.coupling.step_sizes import crossings
from master_node.methods.base import Setup
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.step_size_limits import StepSizeLimits
from protocol.errors import SteeringError


class Target(NamedTuple):
    """Where steps must end.

    Attributes:
        time: of the end [s].
        crossing: the double step over a known event that is due; None: steps lead up to ``time``.
        name: of that event.
    """

    time: float
    crossing: DoubleStepTimes | None = None
    name: str = ""


class Targets:
    """Targets of one run: before each known event, behind it, and at the stop time.

    Args:
        setup: of the run.
        limits: of its step sizes.
    """

    def __init__(self, setup: Setup, limits: StepSizeLimits) -> None:
        self._limits = limits
        self._crossings = crossings(setup.system, limits, setup.coupled.jumps)
        self._start, self._end = setup.start, setup.system.simulation.end

    def following(self, time: float, until: float) -> Target | None:
        """The target of the steps from ``time`` [s], not beyond ``until``; None: the end."""
        for crossing, name in self._crossings:
            if not self._limits.has_reached(time, crossing.begin):
                return Target(min(crossing.begin, until))
            if time < crossing.middle:
                times = self._limits.crossed(time, crossing)
                return Target(times.end, times, name)
        if self._limits.has_reached(time, self._end):
            return None
        return Target(min(self._end, until))

    def check(self, time: float, until: float, *, together: int) -> None:
        """Make sure that steps from ``time`` can end at ``until`` [s], and go on from there.

        Args:
            time: where the run stands [s].
            until: later than that, and not behind the stop time [s].
            together: number of steps that are of one size each time.

        Raises:
            SteeringError: they cannot; names the points nearest to it.
        """
        limits, quantum = self._limits, self._limits.quantum
        if quantum is None:
            nearest = together * limits.smallest
            if until - time < (1.0 - _ROUNDING) * nearest:
                raise SteeringError(
                    f"t={until!r} s is nearer to the point where the run stands, t={time!r} s, "
                    "than steps can be",
                    remedy=f"lower smallest_step_size, or go to t={time + nearest!r} s",
                )
            return
        size = float(together * quantum)
        below = self._start + floor((until - self._start) / size + _ROUNDING) * size
        if abs(until - below) > _ROUNDING * size:
            raise off_the_grid(until, below, min(below + size, self._end))


def off_the_grid(time: float, below: float, above: float) -> SteeringError:
    """Error for a point between the communication points of a grid [s]."""
    return SteeringError(
        f"t={time!r} s is no communication point: step sizes are on a grid",
        remedy=f"go to t={below!r} s or t={above!r} s",
    )


_ROUNDING = 1e-9
