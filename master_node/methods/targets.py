"""Targets: points in time where steps must end, and known events that they lead over."""

from __future__ import annotations

from typing import NamedTuple

from master_node.coupling.step_sizes import crossings
from master_node.methods.base import Setup
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.step_size_limits import StepSizeLimits


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
        self._end = setup.system.simulation.end

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
