"""Search for discontinuities: jumps of inputs, changes of discrete outputs, events of slaves.

An attempt in which something changed is taken back until the change lies in a double step of the
smallest H, or in the first small step of one whose error is within the tolerance.
"""

from __future__ import annotations

import logging
from typing import NamedTuple

from master_node.judging.comparison import StepError
from master_node.judging.jumps import InputDefects
from master_node.judging.restless import RestlessOutputs
from master_node.methods.base import Back, Setup, summed
from master_node.methods.position import Position
from master_node.numerics.discontinuities import Defects, Inputs, Search, SmoothStep
from master_node.numerics.step_size_controller import passes
from master_node.numerics.step_size_limits import StepSizeLimits
from master_node.stepping.double_step import DoubleStep

log = logging.getLogger("master_node")


class Jumps(NamedTuple):
    """Jumps in a double step, as far as defects tell.

    Attributes:
        defects: of the double step; None: they are not looked at.
        inputs: those that jump, shape (n,); None: as above.
        name: the jump in words; "" if nothing jumps.
        are_answers: whether they lie at T_n, as slaves answer there to corrected inputs.
        are_late: whether these inputs had been so wrong that the answers may be due earlier.
    """

    defects: Defects | None = None
    inputs: Inputs | None = None
    name: str = ""
    are_answers: bool = False
    are_late: bool = False


class Change(NamedTuple):
    """Change of a discrete output that a smaller double step can meet earlier.

    Attributes:
        name: of the output.
        position: what to try next.
    """

    name: str
    position: Position


class Discontinuities:
    """Finds what changes at once in the double steps of one run.

    Args:
        setup: of the run.
        limits: of its step sizes.
    """

    def __init__(self, setup: Setup, limits: StepSizeLimits) -> None:
        self._coupled = setup.coupled
        self._start = setup.start
        self._limits = limits
        self._looks_for_jumps = setup.system.simulation.discontinuities
        self._looks_for_changes = self._looks_for_jumps and self._coupled.discrete.holds_inputs
        self._defects = InputDefects(self._coupled, setup.scheme)
        self._told_restless: set[int] = set()

    def nothing(self) -> Search:
        """The beginning: nothing is looked for, no false alarm is known."""
        return Search.nothing(self._defects.number)

    def of_accepted(self, step: DoubleStep, defects: Defects, error: StepError) -> SmoothStep:
        """The defects to come, as an accepted double step lets expect them."""
        return self._defects.of_accepted(step, defects, error)

    def jumps(self, position: Position, step: DoubleStep, error: StepError) -> Jumps:
        """The inputs that jump in a double step, as far as defects tell."""
        if not self._looks_for_jumps or self._begins_from_rest(position):
            return Jumps()
        search, smooth = position.search, position.smooth
        defects = self._defects.of(step, error.scale, position.history, smooth)
        inputs = search.jumps(defects, step.times.first, is_accurate=passes(error.norm))
        if not inputs.any():
            return Jumps(defects, inputs)
        return Jumps(
            defects,
            inputs,
            f"{self._defects.name(defects, inputs)} jumps",
            are_answers=self._defects.are_answers(defects, inputs, smooth),
            are_late=self._defects.are_late(inputs, smooth),
        )

    def _begins_from_rest(self, position: Position) -> bool:
        """True if the past is made up, so that no defect tells a jump from the first motion."""
        times = position.history.times
        return len(times) > 1 and times[1] < self._start

    def restless(self, position: Position, step: DoubleStep) -> RestlessOutputs:
        """The outputs that change all the time, as one more double step shows; warns of each."""
        if not self._looks_for_changes:
            return position.restless
        d_middle, d_end = step.discrete
        changing = self._coupled.discrete.changing
        found = position.restless.noted(
            changing(position.outputs.d, d_middle), changing(d_middle, d_end)
        )
        for index in sorted(found.outputs - self._told_restless):
            self._told_restless.add(index)
            log.warning(
                "%s is discrete and changes in every small step, at t=%r s with H = %r s: its "
                "changes are not searched for while it does, and its input is held in each step; "
                "ERR tells what that costs. An output that moves all the time is better declared "
                "continuous",
                self._coupled.discrete.names[index],
                step.times.begin,
                step.times.step_size,
            )
        return found

    def event(self, position: Position, step: DoubleStep) -> str:
        """Changes at once in a double step, in words; "" if there is none."""
        event = position.event
        if event is not None and self._limits.has_reached(step.times.end, event):
            return "event"
        if not self._coupled.discrete.holds_inputs:
            return ""
        d_middle, d_end = step.discrete
        changed = self._coupled.discrete.changed
        begin, middle, end = step.times[:3]
        restless = position.restless.outputs
        name = changed(position.outputs.d, d_middle, begin, middle, restless)
        name = name or changed(d_middle, d_end, middle, end, restless)
        return f"{name} changes" if name else ""

    def change(
        self, position: Position, step: DoubleStep, error: StepError, target: float
    ) -> Change | None:
        """Go back where a discrete output changes, until its delay is within the tolerance.

        A change in the first small step makes the second one other than the comparison solution, so
        ERR says what it does to hand it over late. One in the second small step shows in no
        estimate: a double step must end before it, and the next one meets it in its first step.

        Returns:
            None: there is nothing to search.
        """
        if not self._looks_for_changes:
            return None
        times = step.times
        d_middle, d_end = step.discrete
        changed, restless = self._coupled.discrete.changed, position.restless.outputs
        step_size, unchanged = 0.5 * times.first, position.unchanged
        name = changed(d_middle, d_end, times.middle, times.end, restless)
        if name:
            landing = self._limits.landing(self._start, times.begin, times.middle, target)
            if landing is not None:
                step_size, unchanged = times.second, landing
        else:
            name = changed(position.outputs.d, d_middle, times.begin, times.middle, restless)
            if not name or passes(error.norm):
                return None
        step_size = self._limits.bounded(step_size)
        return Change(name, position._replace(step_size=step_size, unchanged=unchanged))

    def go_on(
        self,
        position: Position,
        step: DoubleStep,
        error: StepError,
        jumps: Jumps,
        change: Change | None,
    ) -> Back:
        """Go back where something changes or inputs jump, or where a look at T_n met no jump."""
        search = position.search
        if change is not None:
            return _back(change.position, step, error, f"{change.name} changes")
        if jumps.defects is None or jumps.inputs is None or not jumps.name:
            following = position._replace(search=search.not_at_point())
            return _back(following, step, error, "a look for a jump")
        smallest = self._limits.smallest
        found = search.found(step.times, jumps.defects, jumps.inputs, smallest)
        return _back(position._replace(search=found), step, error, jumps.name)

    def leave_to_estimate(
        self, position: Position, step: DoubleStep, error: StepError, jumps: Jumps
    ) -> Back:
        """Go back where slaves answer at T_n: no smaller H shows more, and ERR decides."""
        assert jumps.inputs is not None  # as wherever inputs jump
        search = position.search
        reason = f"{jumps.name} late" if jumps.are_late else jumps.name
        back = _back(position._replace(search=search.at_point(jumps.inputs)), step, error, reason)
        false = {
            "late_jumps": int(jumps.are_late),
            "double_steps_at_false_alarms": search.attempts + 1,
        }
        return back._replace(counts=summed(back.counts, false))


def _back(position: Position, step: DoubleStep, error: StepError, reason: str) -> Back:
    counts = {"double_steps_at_discontinuities": 1}
    return Back(position, step.times.step_size, step.polynomials, error.norm, reason, counts)
