"""A run with error-controlled step sizes: attempt -> judge -> accept or go back.

What is tried next is a value (`Position`), so a rejected step is one that is not put in its place.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from master_node.coupling.outputs import Outputs
from master_node.coupling.result_points import Reached, ReachedPoint, ResultPoints, count_accepted
from master_node.coupling.step_sizes import crossings, step_size_limits
from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.comparison import ErrorControl, StepError
from master_node.judging.jumps import InputDefects
from master_node.judging.missing_derivatives import MissingDerivatives
from master_node.judging.order import OrderSelection
from master_node.judging.unanswered_inputs import Bound, UnansweredInputs
from master_node.methods.coupling_memory import CouplingMemory
from master_node.numerics.discontinuities import Defects, Inputs, Search, SmoothStep
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.error_estimators import ErrorEstimator
from master_node.numerics.extrapolation import CouplingHistory, Polynomials, highest
from master_node.numerics.initial_step_size import initial_step_size, trial_step_size
from master_node.numerics.landing_points import LandingPoints
from master_node.numerics.order_control import DEPTH, OrderMemory
from master_node.numerics.step_size_controller import (
    EXPONENTS,
    NOTHING,
    ControllerMemory,
    StepSizeController,
)
from master_node.observing.observers import Attempt, Points
from master_node.running.context import RunContext
from master_node.stepping.double_step import DoubleStep, DoubleStepper
from master_node.stepping.requests import FailedStep
from protocol.calls import StepStatus
from protocol.errors import DeadlineError, DoublestepError, SlaveError, StepSizeError

log = logging.getLogger("master_node")

_INF = float("inf")
_TRIALS = 5
_NEAR = 0.1
"""Part of the next H that the last one is at least, for the points before to be of use."""

_COMPARABLE = 16.0
"""Factor by which a first H is above the smallest one, so that a smaller one tells a jump."""


class Position(NamedTuple):
    """Where a run stands and what it will try next.

    Attributes:
        history: inputs up to T_n.
        outputs: at T_n, those of continuous variables of shape (rows, m).
        step_size: H that is wanted [s].
        controller: the step size controller's memory.
        order: the order control's memory; holds the input polynomial.
        search: what is known of jumps behind T_n.
        smooth: what the last accepted step says of defects; None: nothing.
        errors_in_a_row: attempts that a slave ended with an error.
        event: where a slave has returned early, and a double step must end [s]; None: nowhere.
        unchanged: up to where discrete outputs are known not to change, and a double step must end
            [s]; None: nowhere.
        crossings: how many more double steps behind an event are kept whatever ERR is, as H is on a
            grid and cannot be made smaller.
        coupling: explicit or implicit, and what is known of it.
    """

    history: CouplingHistory
    outputs: Outputs
    step_size: float
    order: OrderMemory
    search: Search
    controller: ControllerMemory = NOTHING
    smooth: SmoothStep | None = None
    errors_in_a_row: int = 0
    event: float | None = None
    unchanged: float | None = None
    crossings: int = 0
    coupling: CouplingMemory = CouplingMemory()

    @property
    def time(self) -> float:
        """T_n [s]."""
        return self.history.times[0]


class _Jumps(NamedTuple):
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


class ControlledRun:
    """Double steps with an estimator, from the first communication point to the stop time.

    Args:
        context: what to run.
        estimator: EST_Rich or EST_mod.

    Raises:
        ConfigurationError: no step size follows the rules of all slaves.
    """

    def __init__(self, context: RunContext, estimator: ErrorEstimator) -> None:
        settings, coupled, scheme = context.system.simulation, context.coupled, context.scheme
        self._settings = settings
        self._start = float(settings.start_time)
        self._coupled = coupled
        self._scheme = scheme
        self._observer = context.observer
        self._interrupts = context.interrupts
        self._statistics = context.statistics
        self._checkpoints = context.checkpoints
        self._resumed = context.resumed
        self._estimator = estimator
        self._limits = step_size_limits(context.system)
        external = coupled.external
        self._crossings = crossings(context.system, self._limits, coupled.jumps)
        # Where H is a multiple of something a double step cannot end wherever a kink is.
        kinks = external.kinks if self._limits.lead_everywhere else ()
        self._landing_points = LandingPoints(kinks, self._limits.smallest)
        self._searches_changes = settings.discontinuities and coupled.discrete.holds_inputs
        self._stepper = self._make_stepper(context, estimator)
        self._control = self._make_control(context, estimator)
        self._available = self._make_available(context, estimator)
        self._defects = InputDefects(coupled, scheme)
        self._missing = MissingDerivatives(coupled, scheme)
        self._loses_events: set[str] = set()
        self._unanswered = UnansweredInputs(coupled, scheme)
        present, past = EXPONENTS[settings.controller]
        self._controller = StepSizeController(
            settings.alpha,
            settings.theta_min,
            settings.theta_max,
            self._limits.smallest,
            self._limits.largest,
            present,
            past,
            grows_after_rejection=settings.controller == "elementary",
        )
        self._orders = None
        if settings.order == "auto" and coupled.output_names:
            self._orders = self._make_orders(context)

    def _make_stepper(self, context: RunContext, estimator: ErrorEstimator) -> DoubleStepper:
        return DoubleStepper(context.group, context.coupled, context.scheme, estimator)

    def _make_control(self, context: RunContext, estimator: ErrorEstimator) -> ErrorControl:
        constants = context.system.simulation.constants
        return ErrorControl(context.coupled, context.scheme, estimator, constants)

    def _make_available(
        self, context: RunContext, estimator: ErrorEstimator
    ) -> AvailablePolynomials:
        return AvailablePolynomials(context.scheme.extrapolation, estimator)

    def _make_orders(self, context: RunContext) -> OrderSelection:
        settings = context.system.simulation
        return OrderSelection(
            context.coupled,
            context.scheme,
            control=self._control,
            available=self._available,
            largest=settings.polynomial,
            alpha=settings.alpha,
        )

    def run(self, outputs: Outputs) -> str:
        """Step from outputs at T_0, those of continuous variables (rows, m), to the stop time.

        Returns:
            A slave's wish to end earlier in words, or "".

        Raises:
            DoublestepError: a slave was lost or failed, or H would have to be too small.
        """
        self._results = ResultPoints(
            self._settings.output_grid,
            self._coupled,
            self._scheme.has_derivative,
            self._start,
            outputs,
        )
        if self._resumed is None:
            position = self._first_position(outputs)
        else:
            position, self._results.memory = self._resumed.place(Position)
        self._reached(position)
        for target, crossing in self._targets():
            while not self._limits.has_reached(position.time, target):
                following = self._advance(position, target)
                if isinstance(following, str):
                    return following
                position = following
                self._reached(position)
            if crossing is not None and position.time < crossing[0].middle:
                times = self._limits.crossed(position.time, crossing[0])
                following = self._cross(position, times, crossing[1])
                if isinstance(following, str):
                    return following
                position = following
                self._reached(position)
        return ""

    def _reached(self, position: Position) -> None:
        self._missing.note(position.outputs.y, position.time)
        self._checkpoints.reached(position, self._results.memory)

    def _targets(self) -> Iterator[tuple[float, tuple[DoubleStepTimes, str] | None]]:
        """Where double steps must end: before each known event, and at the stop time."""
        for crossing in self._crossings:
            yield crossing[0].begin, crossing
        yield self._settings.end, None

    # --- beginnings -----------------------------------------------------------------------------

    def _first_position(self, outputs: Outputs) -> Position:
        settings, u = self._settings, self._coupled.inputs_of(outputs.y)
        depth = self._depth(settings.polynomial.order + 1)  # inputs without derivatives need all
        history = CouplingHistory.start(self._start, u, depth)
        search = Search.nothing(self._defects.number)
        position = Position(history, outputs, settings.step_size, self._restarted_order(), search)
        if settings.initial_step_size is None:
            position = self._with_initial_step_size(position, self._limits.largest)
        step_size = self._controller.bounded(position.step_size)
        if settings.rests_before_start:
            history = CouplingHistory.at_rest(self._start, u, depth, step_size)
        return position._replace(history=history, step_size=step_size)

    def _depth(self, points: int) -> int:
        """How many communication points are kept for polynomials through ``points`` points."""
        depth = self._estimator.points(points) + self._scheme.known_ahead
        return max(depth + 1, DEPTH if self._orders else 0)  # and one that a step pushes out

    def _restarted_order(self) -> OrderMemory:
        if self._orders is None:
            return OrderMemory(self._settings.polynomial)
        return self._orders.restart()

    def _with_initial_step_size(self, position: Position, largest: float) -> Position:
        """The position with H from the behaviour of the slaves there, ``largest`` at most [s]."""
        y, stop = position.outputs.y, self._settings.end
        scale = self._coupled.controlled_scale(self._control.scale(y[0]))
        slope = np.where(self._scheme.trusts_derivative, y[1], np.nan) if len(y) > 1 else None
        trial = trial_step_size(y[0], slope, scale, stop - self._start)
        deadlines = 0
        for _ in range(_TRIALS):
            trial = min(trial, largest, (stop - position.time) / 2.0)
            times = self._limits.times(
                self._start, position.time, max(trial, self._limits.smallest), stop
            )
            polynomials = self._polynomials(position)
            step = self._stepper.attempt(position.history, times, polynomials, position.outputs)
            if isinstance(step, FailedStep) and isinstance(step.original_error, DeadlineError):
                deadlines += 1
                if deadlines > 1:
                    raise step.original_error
            if isinstance(step, FailedStep) and step.missing is not None:
                self._missing.note(step.missing, times.middle)
                position = position._replace(history=position.history.without_slopes())
                continue
            if isinstance(step, DoubleStep):
                error = self._judge(step)
                if error.norm < _INF:
                    step_size = initial_step_size(
                        y[0],
                        step.middle[0],
                        step.end[0],
                        scale,
                        trial=times.first,
                        error_norm=error.norm,
                        exponent=self._control.exponent(polynomials),
                    )
                    step_size = max(step_size, _COMPARABLE * self._limits.smallest)
                    bounded = self._controller.bounded(min(step_size, largest))
                    return position._replace(step_size=bounded)
            trial = 0.1 * times.first
        return position._replace(step_size=self._controller.bounded(trial))

    def _polynomials(self, position: Position) -> Polynomials:
        return self._available.of(position.order.polynomial, position.history)

    # --- one attempt ----------------------------------------------------------------------------

    def _advance(self, position: Position, target: float) -> Position | str:
        """One double step, or the attempt of one, towards ``target`` [s]."""
        smallest, search = self._limits.smallest, position.search
        wanted = search.step_size(position.time, position.step_size, smallest)
        for nearer in (position.event, position.unchanged):
            if nearer is not None:
                target = min(target, nearer)
        target = self._landing_points.target(
            position.time, wanted, target, first=position.controller.rejected
        )
        times = self._limits.times(self._start, position.time, wanted, target)
        position, polynomials, step = self._attempt(position, times)
        if isinstance(step, FailedStep):
            return self._after_failure(position, step, times, polynomials, target)
        return self._decide(position, step, self._judge(step), target)

    def _decide(
        self, position: Position, step: DoubleStep, error: StepError, target: float
    ) -> Position:
        """Accept a double step towards ``target`` [s], or go back and look for what changed."""
        jumps = self._jumps(position, step, error)
        event = self._event(position, step) or jumps.name
        searched = None
        if self._searches_changes:
            searched = self._search_change(position, step, error, target)
        if self._is_smallest(step.times, target):
            if jumps.name and event == jumps.name and jumps.are_answers:
                return self._leave_to_estimate(position, step, error, jumps)
            if position.search.is_near and not error.norm <= 1.0:
                event = event or f"{error.limiting_variable} jumps"
            if event:
                self._statistics.changes_at_smallest_step_size += searched is not None
                return self._accept_jump(position, step, error, event)
        if searched is not None or jumps.name or position.search.looks_at_point:
            return self._go_on_searching(position, step, error, jumps, searched)
        if error.norm <= 1.0:
            return self._accept(position, step, error, jumps.defects)
        if position.crossings and error.norm < _INF and self._is_smallest(step.times, target):
            return self._accept_behind_event(position, step, error, jumps.defects)
        return self._reject(position, step, error, jumps.defects, target)

    def _attempt(
        self, position: Position, times: DoubleStepTimes
    ) -> tuple[Position, Polynomials, DoubleStep | FailedStep]:
        """One attempt, once more where it says nothing of what comes.

        Without derivatives, where one turns out to be missing at T_n + H: both small steps must
        have polynomials of the same kind. Carefully, where a slave returns early in its first step
        from a restored state: some do so once because their states lack the past of their event
        indicators.
        """
        polynomials = self._polynomials(position)
        step = self._stepper.attempt(position.history, times, polynomials, position.outputs)
        if isinstance(step, FailedStep) and step.has_doubtful_event:
            doubtful = step
            self._tell_rejected(times, polynomials, _INF, f"{step.reason} after a restore")
            step = self._stepper.attempt(
                position.history, times, polynomials, position.outputs, careful=True
            )
            if not isinstance(step, FailedStep) or step.status is not StepStatus.EARLY_RETURN:
                self._tell_lost_events(doubtful)
        if isinstance(step, FailedStep) and step.missing is not None:
            self._missing.note(step.missing, times.middle)
            self._tell_rejected(times, polynomials, _INF, step.reason)
            without = position._replace(history=position.history.without_slopes())
            return self._attempt(without, times)
        return position, polynomials, step

    def _tell_lost_events(self, doubtful: FailedStep) -> None:
        """Warn once of each slave whose step from the same state has ended otherwise."""
        if doubtful.slave in self._loses_events:
            return
        self._loses_events.add(doubtful.slave)
        log.warning(
            "%s: a step from a restored state returned early at t=%r s, and did not when it was "
            "taken again: its saved states lack the past of its events, so that one may be missed; "
            'state = "fork" in its table saves all of it',
            doubtful.slave,
            doubtful.time,
        )

    def _judge(self, step: DoubleStep) -> StepError:
        return self._control.judge(step)

    def _accept(
        self, position: Position, step: DoubleStep, error: StepError, defects: Defects | None
    ) -> Position:
        self._stepper.accepted()
        self._checkpoints.settle()
        times, polynomials = step.times, step.polynomials
        history = step.history.pushed(times.end, step.end_inputs)
        reached = _reached(step)
        points = self._results.reached(reached, highest(polynomials).order)
        self._tell_accepted(step, error, reached, points)
        if self._event(position, step):
            self._statistics.discontinuities += 1
            self._results.cut(reached[-1])
            return self._behind_event(position, step, history)
        following, memory, controller = self._next(position, step, error, defects, history)
        is_searching = position.search.end is not None
        search = position.search.passed(times.end)
        if is_searching:
            self._statistics.double_steps_at_discontinuities += 1
            if search.end is None:  # a false alarm
                self._statistics.double_steps_at_false_alarms += position.search.attempts + 1
                following, controller = max(following, position.step_size), NOTHING
                if times.first < _NEAR * following:  # points so near say nothing of larger H
                    memory = self._restarted_order()
                    return Position(history.cut(), _end(step), following, memory, search)
        smooth = None
        if position.search.is_at_point:  # what T_n had does not belong to what follows
            history, memory = history.newest(len(reached)), self._restarted_order()
        elif defects is not None:
            smooth = self._defects.of_accepted(step, defects, error)
        return Position(
            history,
            _end(step),
            following,
            memory,
            search,
            controller,
            smooth,
            crossings=max(position.crossings - 1, 0),
        )

    def _next(
        self,
        position: Position,
        step: DoubleStep,
        error: StepError,
        defects: Defects | None,
        history: CouplingHistory,
    ) -> tuple[float, OrderMemory, ControllerMemory]:
        """H for the double step that follows an accepted one, with the memories for it."""
        times, polynomials = step.times, step.polynomials
        _, following, controller = self._controller.decide(
            times.first, error.norm, self._control.exponent(polynomials), position.controller
        )
        is_cut_short = self._limits.is_cut_short(times, position.step_size)
        if is_cut_short:  # by a target or a bracket
            following = max(following, position.step_size)
        memory, bound = position.order, self._bound(step, error, defects, history)
        is_searching = position.search.end is not None
        if self._orders is not None and not (is_searching and is_cut_short):
            memory, factor = self._orders.choose(memory, step, error, history, bound)
            if factor is not None:
                factor = min(factor, self._settings.theta_max)
                if position.controller.rejected:
                    factor = min(factor, 1.0)
                following = self._controller.bounded(times.first * factor)
                controller = NOTHING
        if bound is not None and memory.polynomial.order:  # constants would ask for any number
            polynomials = self._available.of(memory.polynomial, history)
            bounded = min(following, times.first * bound(polynomials))
            following = self._controller.bounded(bounded)
        return following, memory, controller

    def _bound(
        self,
        step: DoubleStep,
        error: StepError,
        defects: Defects | None,
        history: CouplingHistory,
    ) -> Bound | None:
        """The bound of the next H by inputs of which ERR tells nothing; None: there is none."""
        inputs = None if defects is None else self._unanswered.of(defects, error)
        if inputs is None:
            return None
        return self._unanswered.bound(inputs, history, step, error)

    def _reject(
        self,
        position: Position,
        step: DoubleStep,
        error: StepError,
        defects: Defects | None,
        target: float,
    ) -> Position:
        times = step.times
        if self._is_smallest(times, target):
            raise self._stuck(error, times)
        self._tell_rejected(times, step.polynomials, error.norm, error.limiting_variable)
        following, controller = self._smaller(position, step, error)
        kink = self._landing_points.inside(times)
        if kink is not None:  # the double step up to there is smooth
            following = max(following, (kink - times.begin) / 2.0)
        search = position.search
        if defects is not None:
            search = search.after_rejection(times.first, defects)
        return position._replace(step_size=following, controller=controller, search=search)

    def _smaller(
        self, position: Position, step: DoubleStep, error: StepError
    ) -> tuple[float, ControllerMemory]:
        """H after a rejected double step [s]."""
        exponent = self._control.exponent(step.polynomials)
        _, following, controller = self._controller.decide(
            step.times.first, error.norm, exponent, position.controller
        )
        return following, controller

    def _after_failure(
        self,
        position: Position,
        failed: FailedStep,
        times: DoubleStepTimes,
        polynomials: Polynomials,
        target: float,
    ) -> Position | str:
        if failed.status is StepStatus.TERMINATED:
            return f"{failed.slave} ended the simulation after t={times.begin!r} s"
        if failed.status is StepStatus.EARLY_RETURN:
            return self._before_event(position, failed, times, polynomials)
        error, errors_in_a_row = failed.original_error, position.errors_in_a_row
        if error is not None and not failed.has_crashed:
            errors_in_a_row += 1
            if errors_in_a_row > 1:
                raise error
        self._tell_rejected(times, polynomials, _INF, failed.reason)
        if self._is_smallest(times, target):
            raise error or self._stuck_for(failed.reason, times)
        return position._replace(
            step_size=self._controller.after_discard(times.first, failed.reached),
            controller=position.controller._replace(rejected=True),
            errors_in_a_row=errors_in_a_row,
        )

    def _before_event(
        self,
        position: Position,
        failed: FailedStep,
        times: DoubleStepTimes,
        polynomials: Polynomials,
    ) -> Position:
        """Go back, to end the next double step where a slave has found an event."""
        self._tell_rejected(times, polynomials, _INF, failed.reason)
        if not failed.time > times.begin:
            raise SlaveError(
                "do_step returned early without getting anywhere",
                slave=failed.slave,
                phase="do_step",
                time=times.begin,
                step_size=times.first,
                remedy="the model may have an error in its event handling",
            )
        return position._replace(event=failed.time)

    def _is_smallest(self, times: DoubleStepTimes, target: float) -> bool:
        """Whether no smaller H leads from T_n to ``target`` [s]."""
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

    # --- discontinuities ------------------------------------------------------------------------

    def _cross(self, position: Position, times: DoubleStepTimes, name: str) -> Position | str:
        """The double step over a known event, whatever its error is."""
        position, polynomials, step = self._attempt(position, times)
        if isinstance(step, FailedStep):
            following = self._after_failure(position, step, times, polynomials, times.end)
            assert isinstance(following, str)  # such a small step is not made smaller
            return following
        error = self._judge(step)
        if not error.norm < _INF:
            raise self._stuck(error, times)
        return self._accept_jump(position, step, error, name)

    def _accept_jump(
        self, position: Position, step: DoubleStep, error: StepError, name: str
    ) -> Position:
        """Go on behind a discontinuity: history cut, order and step size as at the start."""
        if not error.norm < _INF:
            raise self._stuck(error, step.times)
        self._stepper.accepted()
        self._checkpoints.settle()
        self._statistics.discontinuities += 1
        self._statistics.double_steps_at_discontinuities += 1
        if self._limits.quantum is not None and error.norm > 1.0:
            self._note_above_tolerance(step, error)
        times = step.times
        reached = _reached(step)
        error = error._replace(limiting_variable=name)
        self._tell_accepted(step, error, reached, self._results.jumped(reached))
        history = step.history.pushed(times.end, step.end_inputs)
        return self._behind_event(position, step, history)

    def _behind_event(
        self, position: Position, step: DoubleStep, history: CouplingHistory
    ) -> Position:
        """Where to go on: the past says nothing any more."""
        search = position.search.crossed()
        order = self._restarted_order()
        behind = Position(history.cut(), _end(step), position.step_size, order, search)
        if self._limits.quantum is not None:
            whole = OrderMemory(self._settings.polynomial)
            behind = behind._replace(order=whole, crossings=sum(self._crossings_behind_event))
        if step.times.end >= self._settings.end:
            return behind
        return self._with_initial_step_size(behind, position.step_size)

    @property
    def _crossings_behind_event(self) -> tuple[int, int]:
        """Double steps of a grid until all slaves know of an event, and until polynomials have all
        their points.

        Each communication point hands a value on by one slave with direct feed-through.
        """
        points = self._estimator.points(self._settings.polynomial.order + 1)
        return (self._coupled.at_point.highest + 1) // 2, (points + 1) // 2

    def _accept_behind_event(
        self, position: Position, step: DoubleStep, error: StepError, defects: Defects | None
    ) -> Position:
        """Cross what follows an event: with the smallest H of a grid there is no other way."""
        self._note_above_tolerance(step, error)
        self._statistics.double_steps_at_discontinuities += 1
        following = self._accept(position, step, error, defects)
        if following.crossings >= self._crossings_behind_event[1]:
            return following._replace(history=following.history.cut())
        return following

    def _note_above_tolerance(self, step: DoubleStep, error: StepError) -> None:
        """Count a double step that is kept on a grid whatever its error is; tell the first one."""
        if not self._statistics.steps_above_tolerance:
            log.warning(
                "behind an event, at t=%r s, a double step is kept with ERR = %.3g, most of it "
                "from %s: its polynomials have no past, and H cannot be below %r s; "
                "steps_above_tolerance in summary.json counts such steps",
                step.times.begin,
                error.norm,
                error.limiting_variable,
                step.times.step_size,
            )
        self._statistics.steps_above_tolerance += 1

    def _jumps(self, position: Position, step: DoubleStep, error: StepError) -> _Jumps:
        """The inputs that jump in a double step, as far as defects tell."""
        if not self._settings.discontinuities or self._begins_from_rest(position):
            return _Jumps()
        search, smooth = position.search, position.smooth
        defects = self._defects.of(step, error.scale, position.history, smooth)
        inputs = search.jumps(defects, step.times.first, is_accurate=error.norm <= 1.0)
        if not inputs.any():
            return _Jumps(defects, inputs)
        return _Jumps(
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

    def _go_on_searching(
        self,
        position: Position,
        step: DoubleStep,
        error: StepError,
        jumps: _Jumps,
        change: tuple[str, Position] | None,
    ) -> Position:
        """Go back where something changes or inputs jump, or where a look at T_n met no jump."""
        search = position.search
        if change is not None:
            name, following = change
            self._tell_searched(step, error, f"{name} changes")
            return following
        if jumps.defects is None or jumps.inputs is None or not jumps.name:
            self._tell_searched(step, error, "a look for a jump")
            return position._replace(search=search.not_at_point())
        self._tell_searched(step, error, jumps.name)
        smallest = self._limits.smallest
        return position._replace(
            search=search.found(step.times, jumps.defects, jumps.inputs, smallest)
        )

    def _leave_to_estimate(
        self, position: Position, step: DoubleStep, error: StepError, jumps: _Jumps
    ) -> Position:
        """Go back where slaves answer at T_n: no smaller H shows more, and ERR decides."""
        assert jumps.inputs is not None  # as wherever inputs jump
        search = position.search
        self._statistics.late_jumps += jumps.are_late
        self._statistics.double_steps_at_false_alarms += search.attempts + 1
        self._tell_searched(step, error, f"{jumps.name} late" if jumps.are_late else jumps.name)
        return position._replace(search=search.at_point(jumps.inputs))

    def _search_change(
        self, position: Position, step: DoubleStep, error: StepError, target: float
    ) -> tuple[str, Position] | None:
        """Go back where a discrete output changes, until its delay is within the tolerance.

        A change in the first small step makes the second one other than the comparison solution, so
        ERR says what it does to hand it over late. One in the second small step shows in no
        estimate: a double step must end before it, and the next one meets it in its first step.

        Returns:
            The output, and what to try next if H can be smaller; None: there is nothing to search.
        """
        times = step.times
        d_middle, d_end = step.discrete
        changed = self._coupled.discrete.changed
        step_size, unchanged = 0.5 * times.first, position.unchanged
        name = changed(d_middle, d_end, times.middle, times.end)
        if name:
            landing = self._limits.landing(self._start, times.begin, times.middle, target)
            if landing is not None:
                step_size, unchanged = times.second, landing
        else:
            name = changed(position.outputs.d, d_middle, times.begin, times.middle)
            if not name or error.norm <= 1.0:
                return None
        step_size = self._controller.bounded(step_size)
        return name, position._replace(step_size=step_size, unchanged=unchanged)

    def _event(self, position: Position, step: DoubleStep) -> str:
        """What changed at once in a double step, in words; "" if nothing did."""
        event = position.event
        if event is not None and self._limits.has_reached(step.times.end, event):
            return "event"
        if not self._coupled.discrete.holds_inputs:
            return ""
        d_middle, d_end = step.discrete
        changed = self._coupled.discrete.changed
        begin, middle, end = step.times[:3]
        name = changed(position.outputs.d, d_middle, begin, middle)
        name = name or changed(d_middle, d_end, middle, end)
        return f"{name} changes" if name else ""

    # --- what observers and counters are told ---------------------------------------------------

    def _tell_accepted(
        self, step: DoubleStep, error: StepError, reached: Reached, points: Points
    ) -> None:
        times, (order, slopes) = step.times, highest(step.polynomials)
        size, limiting = times.step_size, error.limiting_variable
        with self._interrupts:
            count_accepted(self._statistics, size, reached)
            self._observer.attempted(
                Attempt(
                    times.begin,
                    size,
                    order,
                    slopes,
                    error.norm,
                    True,
                    limiting,
                    points,
                    step.iterations,
                )
            )

    def _tell_searched(self, step: DoubleStep, error: StepError, reason: str) -> None:
        self._statistics.double_steps_at_discontinuities += 1
        self._tell_rejected(step.times, step.polynomials, error.norm, reason)

    def _tell_rejected(
        self, times: DoubleStepTimes, polynomials: Polynomials, norm: float, reason: str
    ) -> None:
        order, slopes = highest(polynomials)
        with self._interrupts:
            self._statistics.rejected_double_steps += 1
            self._observer.attempted(
                Attempt(times.begin, times.step_size, order, slopes, norm, False, reason)
            )


def _reached(step: DoubleStep) -> Reached:
    d_middle, d_end = step.discrete
    return (
        ReachedPoint(step.times.middle, step.middle, d_middle),
        ReachedPoint(step.times.end, step.end, d_end),
    )


def _end(step: DoubleStep) -> Outputs:
    return Outputs(step.end, step.discrete[1])
