"""Double steps with a comparison solution: attempt -> judge -> accept or go back.

The two small steps T_n -> T_n + H -> T_n + 2H are compared with another solution (EST_Rich or
EST_mod), and taken back where the difference is beyond the tolerance (the paper, section 3).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import NamedTuple

from master_node.coupling.outputs import Outputs
from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.comparison import StepError
from master_node.methods.base import Back, Counts, Ended, Setup, Shape, Verdict, ended_by, summed
from master_node.methods.first_step_size import FirstStepSize
from master_node.methods.judges import StepJudge
from master_node.methods.next_step_size import StepSizeChoice, controller
from master_node.methods.position import Doubt, Position
from master_node.methods.searching import Discontinuities
from master_node.methods.targets import Targets
from master_node.numerics.discontinuities import Defects
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.extrapolation import CouplingHistory, Polynomials
from master_node.numerics.landing_points import LandingPoints
from master_node.numerics.order_control import OrderMemory
from master_node.numerics.step_size_controller import NOTHING, passes
from master_node.numerics.step_size_limits import StepSizeLimits
from master_node.stepping.double_step import DoubleStep, DoubleStepper
from master_node.stepping.requests import FailedStep
from protocol.calls import Call, StepStatus
from protocol.errors import DoublestepError, SlaveError, StepSizeError

log = logging.getLogger("master_node")

_INF = float("inf")
_NEAR = 0.1
"""Part of the next H that the last one is at least, for the points before to be of use."""

_WHOLE = 0.99
"""Part of the largest H at rest, from which on it is this one that bounds a step."""


class Way(NamedTuple):
    """The next double step.

    Attributes:
        times: of it.
        target: where double steps must end [s].
        crossing: name of the known event that it leads over, whatever its error is; "": none.
    """

    times: DoubleStepTimes
    target: float
    crossing: str = ""


@dataclass(frozen=True)
class Parts:
    """Collaborators of double steps, which differ from method to method.

    Attributes:
        limits: of the step sizes.
        stepper: takes double steps.
        available: the polynomials that a history allows.
        judge: estimates errors.
        first: chooses H where the past tells nothing.
        choice: chooses the next H.
        depth: number of communication points that are kept.
        points: that the polynomial and its comparison solution need.
        restarted: order memory at the start and behind events.
    """

    limits: StepSizeLimits
    stepper: DoubleStepper
    available: AvailablePolynomials
    judge: StepJudge
    first: FirstStepSize
    choice: StepSizeChoice
    depth: int
    points: int
    restarted: OrderMemory


class ComparedSteps:
    """A method of double steps that can be taken back.

    Args:
        setup: what to run.
        parts: what it is made of.

    Attributes:
        parts: as above.
    """

    def __init__(self, setup: Setup, parts: Parts) -> None:
        self._settings = setup.system.simulation
        self._start, self._stop = setup.start, setup.system.simulation.end
        self._coupled = setup.coupled
        self._scheme = setup.scheme
        self._missing = setup.missing
        self.parts = parts
        self._limits = limits = parts.limits
        # Where H is a multiple of something a double step cannot end wherever a kink is.
        kinks = self._coupled.external.kinks if limits.lead_everywhere else ()
        self._landing_points = LandingPoints(kinks, limits.smallest)
        self._targets = Targets(setup, limits)
        self._controller = controller(self._settings, limits)
        self._discontinuities = Discontinuities(setup, limits)
        is_coupled = setup.coupled.source.size or setup.coupled.discrete.holds_inputs
        at_rest = setup.system.simulation.largest_at_rest if is_coupled else _INF
        self._at_rest = max(at_rest, limits.smallest)
        self._loses_events: set[str] = set()

    # --- where attempts lead --------------------------------------------------------------------

    def begin(self, outputs: Outputs) -> Position:
        """See `Method`."""
        settings, u = self._settings, self._coupled.inputs_of(outputs.y)
        depth = self.parts.depth
        history = CouplingHistory.start(self._start, u, depth)
        search, order = self._discontinuities.nothing(), self.parts.restarted
        position = Position(history, outputs, settings.step_size, order, search)
        if settings.initial_step_size is None:
            position = self.parts.first.chosen(position, min(self._limits.largest, self._at_rest))
        step_size = self._limits.bounded(position.step_size)
        if settings.rests_before_start:
            history = CouplingHistory.at_rest(self._start, u, depth, step_size)
        return position._replace(history=history, step_size=step_size)

    def has_reached(self, time: float, target: float) -> bool:
        """See `Method`."""
        return self._limits.has_reached(time, target)

    def way(self, position: Position, until: float) -> Way | None:
        """See `Method`."""
        found = self._targets.following(position.time, until)
        if found is None:
            return None
        target, event = found.time, position.event
        if found.crossing is not None and (event is None or event >= target):
            return Way(found.crossing, target, found.name)
        wanted = position.search.step_size(position.time, position.step_size, self._limits.smallest)
        for nearer in (event, position.unchanged):
            if nearer is not None:
                target = min(target, nearer)
        target = self._landing_points.target(
            position.time, wanted, target, first=position.controller.rejected
        )
        return Way(self._limits.times(self._start, position.time, wanted, target), target)

    # --- attempts -------------------------------------------------------------------------------

    def attempt(self, position: Position, way: Way) -> DoubleStep | Back | Ended:
        """See `Method`."""
        polynomials = self.parts.available.of(position.order.polynomial, position.history)
        doubt = position.doubt
        step = self.parts.stepper.attempt(
            position.history, way.times, polynomials, position.outputs, careful=doubt is not None
        )
        if doubt is not None:
            position = position._replace(doubt=None)
            is_lost = isinstance(step, DoubleStep) or step.status is not StepStatus.EARLY_RETURN
            if is_lost:
                self._tell_lost_events(doubt)
        if isinstance(step, DoubleStep):
            return step
        return self.broken(position, way, polynomials, step, is_careful=doubt is not None)

    def broken(
        self,
        position: Position,
        way: Way,
        polynomials: Polynomials,
        failed: FailedStep,
        *,
        is_careful: bool = True,
    ) -> Back | Ended:
        """Go back after a step that a slave, or a value that is not finite, broke off.

        Args:
            position: from which it was taken.
            way: of it.
            polynomials: of its inputs.
            failed: what happened.
            is_careful: whether it was taken so that an early return is no doubtful one.
        """
        times = way.times
        if failed.status is StepStatus.TERMINATED:
            return ended_by(failed.slave, times.begin)
        back = Back(position, times.step_size, polynomials, _INF, failed.reason)
        if failed.has_doubtful_event and not is_careful:
            doubted = position._replace(doubt=Doubt(failed.slave, failed.time))
            return back._replace(position=doubted, reason=f"{failed.reason} after a restore")
        if failed.missing is not None:  # both small steps must have polynomials of the same kind
            self._missing.note(failed.missing, times.middle)
            without = position._replace(history=position.history.without_slopes())
            return back._replace(position=without)
        if failed.status is StepStatus.EARLY_RETURN:
            return self._before_event(back, way, failed)
        error, errors_in_a_row = failed.original_error, position.errors_in_a_row
        if error is not None and not failed.has_crashed:
            errors_in_a_row += 1
            if errors_in_a_row > 1:
                raise error
        if self._is_smallest(times, times.end if way.crossing else way.target):
            return back._replace(error=error or self._stuck_for(failed.reason, times))
        following = position._replace(
            step_size=self._controller.after_discard(times.first, failed.reached),
            controller=position.controller._replace(rejected=True),
            errors_in_a_row=errors_in_a_row,
        )
        return back._replace(position=following)

    def _tell_lost_events(self, doubt: Doubt) -> None:
        """Warn once of each slave whose step from the same state has ended otherwise."""
        if doubt.slave in self._loses_events:
            return
        self._loses_events.add(doubt.slave)
        log.warning(
            "%s: a step from a restored state returned early at t=%r s, and did not when it was "
            "taken again: its saved states lack the past of its events, so that one may be missed; "
            'state = "fork" in its table saves all of it',
            doubt.slave,
            doubt.time,
        )

    def _before_event(self, back: Back, way: Way, failed: FailedStep) -> Back:
        """Go back, to end the next double step where a slave has found an event."""
        times = way.times
        if failed.time > times.begin:
            return back._replace(position=back.position._replace(event=failed.time))
        error = SlaveError(
            "do_step returned early without getting anywhere",
            slave=failed.slave,
            phase="do_step",
            time=times.begin,
            step_size=times.first,
            remedy="the model may have an error in its event handling",
        )
        return back._replace(error=error)

    # --- judgement ------------------------------------------------------------------------------

    def judge(self, position: Position, way: Way, step: DoubleStep) -> Verdict | Back:
        """See `Method`."""
        return self.decide(position, way, step, self.parts.judge.judge(step))

    def decide(
        self, position: Position, way: Way, step: DoubleStep, error: StepError
    ) -> Verdict | Back:
        """Accept a double step with this error, or go back and look for what changed."""
        if way.crossing:
            return self.over_jump(step, error, None, way.crossing)
        restless = self._discontinuities.restless(position, step)
        position = position._replace(doubt=None, restless=restless)
        return self._decide(position, way.target, step, error)

    def _decide(
        self, position: Position, target: float, step: DoubleStep, error: StepError
    ) -> Verdict | Back:
        discontinuities = self._discontinuities
        jumps = discontinuities.jumps(position, step, error)
        event = discontinuities.event(position, step)
        change = discontinuities.change(position, step, error, target)
        is_smallest = self._is_smallest(step.times, target)
        if is_smallest:
            if jumps.name and not event and jumps.are_answers:
                return discontinuities.leave_to_estimate(position, step, error, jumps)
            name = event or jumps.name
            if position.search.is_near and not passes(error.norm):
                name = name or f"{error.limiting_variable} jumps"
            if name:
                verdict = self.over_jump(step, error, jumps.defects, name)
                return verdict.counting(changes_at_smallest_step_size=int(change is not None))
        if change is not None or jumps.name or position.search.looks_at_point:
            return discontinuities.go_on(position, step, error, jumps, change)
        if passes(error.norm):
            return self._accepted(position, step, error, jumps.defects, event)
        if not is_smallest:
            return self._rejected(position, step, error, jumps.defects)
        if not (position.crossings and error.norm < _INF):
            raise self._stuck(error, step.times)
        verdict = self._accepted(position, step, error, jumps.defects, event)
        verdict = verdict.counting(double_steps_at_discontinuities=1, steps_above_tolerance=1)
        return verdict._replace(remark=_above_tolerance(step, error))

    def over_jump(
        self, step: DoubleStep, error: StepError, defects: Defects | None, name: str
    ) -> Verdict:
        """Accept a double step over a discontinuity, whatever its error is.

        Raises:
            StepSizeError: a value is not finite.
        """
        if not error.norm < _INF:
            raise self._stuck(error, step.times)
        verdict = Verdict(
            error.norm,
            name,
            Shape.JUMP,
            {"discontinuities": 1, "double_steps_at_discontinuities": 1},
            error=error,
            defects=defects,
        )
        if self._limits.quantum is None or passes(error.norm):
            return verdict
        remark = _above_tolerance(step, error)
        return verdict.counting(steps_above_tolerance=1)._replace(remark=remark)

    def _accepted(
        self,
        position: Position,
        step: DoubleStep,
        error: StepError,
        defects: Defects | None,
        event: str,
    ) -> Verdict:
        counts: Counts = {}
        shape = Shape.SMOOTH
        if event:
            shape, counts = Shape.EVENT_AT_END, {"discontinuities": 1}
        elif position.search.end is not None:
            counts = {"double_steps_at_discontinuities": 1}
            if position.search.passed(step.times.end).end is None:
                counts["double_steps_at_false_alarms"] = position.search.attempts + 1
        if step.times.step_size >= _WHOLE * self._at_rest:
            counts = summed(counts, {"double_steps_at_rest": 1})
        return Verdict(
            error.norm,
            error.limiting_variable,
            shape,
            counts,
            error=error,
            defects=defects,
        )

    def _rejected(
        self, position: Position, step: DoubleStep, error: StepError, defects: Defects | None
    ) -> Back:
        times = step.times
        following, memory = self.parts.choice.after_rejection(position, step, error)
        kink = self._landing_points.inside(times)
        if kink is not None:  # the double step up to there is smooth
            following = max(following, (kink - times.begin) / 2.0)
        search = position.search
        if defects is not None:
            search = search.after_rejection(times.first, defects)
        position = position._replace(step_size=following, controller=memory, search=search)
        return Back(
            position, times.step_size, step.polynomials, error.norm, error.limiting_variable
        )

    def _is_smallest(self, times: DoubleStepTimes, target: float) -> bool:
        """True if no smaller H leads from T_n to ``target`` [s]."""
        smallest = self._limits.smallest
        if times.step_size <= smallest:
            return True
        nearest = self._limits.times(self._start, times.begin, smallest, target)
        return times.step_size <= nearest.step_size

    def _stuck(self, error: StepError, times: DoubleStepTimes) -> DoublestepError:
        reason = error.limiting_variable
        if error.norm < _INF:
            reason = f"ERR = {error.norm:.3g}, most of it from {reason}"
        return self._stuck_for(reason, times)

    def _stuck_for(self, reason: str, times: DoubleStepTimes) -> DoublestepError:
        remedy = "raise the tolerances or lower smallest_step_size"
        if self._limits.smallest == self._limits.largest:
            remedy = "raise the tolerances: a slave takes no other step size"
        elif self._limits.quantum is not None and times.step_size == float(self._limits.quantum):
            remedy = f"raise the tolerances: step sizes are multiples of {times.step_size!r} s"
        loop = self._scheme.open_loop(self._coupled)
        if loop:
            remedy = (
                f"solve the algebraic loop {' -> '.join(loop)} at each communication point by "
                f"evaluate_outputs and outputs_follow_inputs; or {remedy}"
            )
        return StepSizeError(
            f"rejected at the smallest communication step size: {reason}",
            phase="double step",
            time=times.begin,
            step_size=times.step_size,
            remedy=remedy,
        )

    # --- behind an accepted step ----------------------------------------------------------------

    def commit(
        self,
        position: Position,  # noqa: ARG002
        step: DoubleStep,
        verdict: Verdict,
    ) -> tuple[DoubleStep, Verdict] | Ended:
        """See `Method`; the state saved at T_n is not needed any more."""
        self.parts.stepper.accepted()
        return step, verdict

    def next(self, position: Position, way: Way, step: DoubleStep, verdict: Verdict) -> Position:  # noqa: ARG002
        """See `Method`."""
        return self.forgetting(position, self.following(position, step, verdict), verdict)

    def following(self, position: Position, step: DoubleStep, verdict: Verdict) -> Position:
        """Where the run stands behind an accepted double step, and what it tries next."""
        restless = self._discontinuities.restless(position, step)
        return self._following(position, step, verdict)._replace(restless=restless)

    def _following(self, position: Position, step: DoubleStep, verdict: Verdict) -> Position:
        times, defects, error = step.times, verdict.defects, verdict.error
        assert error is not None  # as of every double step
        history = step.history.pushed(times.end, step.end_inputs)
        if verdict.shape is not Shape.SMOOTH:
            return self._behind_event(position, step, history)
        next_size, order, memory = self.parts.choice.after_acceptance(
            position, step, error, defects, history
        )
        next_size = min(next_size, self._at_rest)
        search = position.search.passed(times.end)
        if position.search.end is not None and search.end is None:  # a false alarm
            next_size, memory = max(next_size, position.step_size), NOTHING
            if times.first < _NEAR * next_size:  # points so near say nothing of larger H
                restarted = self.parts.restarted
                return Position(history.cut(), step.outputs, next_size, restarted, search)
        smooth = None
        if position.search.is_at_point:  # what T_n had does not belong to what follows
            history, order = history.newest(len(step.reached)), self.parts.restarted
        elif defects is not None:
            smooth = self._discontinuities.of_accepted(step, defects, error)
        return Position(
            history,
            step.outputs,
            next_size,
            order,
            search,
            memory,
            smooth,
            crossings=max(position.crossings - 1, 0),
        )

    def forgetting(self, position: Position, following: Position, verdict: Verdict) -> Position:
        """Without a past where an event was handed on too lately for polynomials to know it."""
        is_crossing = position.crossings and verdict.remark
        if is_crossing and following.crossings >= self._crossings_behind_event[1]:
            return following._replace(history=following.history.cut())
        return following

    def _behind_event(
        self, position: Position, step: DoubleStep, history: CouplingHistory
    ) -> Position:
        return self._restarted(position, history.cut(), step.outputs)

    def _restarted(
        self, position: Position, history: CouplingHistory, outputs: Outputs
    ) -> Position:
        """Go on behind a discontinuity: history cut, order and step size as at the start."""
        behind = Position(
            history,
            outputs,
            position.step_size,
            self.parts.restarted,
            position.search.crossed(),
        )
        if self._limits.quantum is not None:
            whole = OrderMemory(self._settings.polynomial)
            behind = behind._replace(order=whole, crossings=sum(self._crossings_behind_event))
        if history.times[0] >= self._stop:
            return behind
        return self.parts.first.chosen(behind, position.step_size)

    def behind_event(self, position: Position) -> Position:
        """See `Method`."""
        u = self._coupled.inputs_of(position.outputs.y)
        history = CouplingHistory.start(position.time, u, position.history.depth)
        return self._restarted(position, history, position.outputs)

    def check_target(self, position: Position, time: float) -> None:
        """See `Method`."""
        self._targets.check(position.time, time, together=2)

    def way_back(self, slave: int) -> tuple[Call, ...]:
        """See `Method`."""
        return self.parts.stepper.requests.way_back(slave)

    def forget(self) -> None:
        """See `Method`."""
        self.parts.stepper.accepted()

    @property
    def _crossings_behind_event(self) -> tuple[int, int]:
        """Double steps of a grid until all slaves know of an event, and until polynomials have all
        their points.

        Each communication point hands a value on by one slave with direct feed-through.
        """
        return (self._coupled.at_point.highest + 1) // 2, (self.parts.points + 1) // 2


def _above_tolerance(step: DoubleStep, error: StepError) -> str:
    """Warning of a double step that is kept on a grid whatever its error is."""
    return (
        f"behind an event, at t={step.times.begin!r} s, a double step is kept with ERR = "
        f"{error.norm:.3g}, most of it from {error.limiting_variable}: its polynomials have no "
        f"past, and H cannot be below {step.times.step_size!r} s; steps_above_tolerance in "
        "summary.json counts such steps"
    )
