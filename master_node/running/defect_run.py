"""A run of slaves of which none can go back: steps of a controlled size, without rejections.

Each step is one round trip. How far the inputs turn out to be from their polynomials is known after
it, and how far they would have been from other polynomials too: both, order and H of the next step,
follow from the past communication points alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from master_node.coupling.outputs import Outputs
from master_node.coupling.result_points import Reached, ReachedPoint, ResultPoints, count_accepted
from master_node.coupling.step_sizes import crossings, step_size_limits
from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.defects import CouplingDefects, CouplingError, SingleStepShape
from master_node.judging.missing_derivatives import MissingDerivatives
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.extrapolation import (
    CouplingHistory,
    InputPolynomial,
    Polynomials,
    highest,
)
from master_node.numerics.initial_step_size import untried_step_size
from master_node.numerics.order_control import (
    DEPTH,
    LARGEST_FACTOR,
    SMALLEST_FACTOR,
    OrderMemory,
    beginning,
    ladder,
    prefer,
)
from master_node.observing.observers import Attempt, Points
from master_node.running.context import RunContext
from master_node.stepping.requests import BrokenOffError
from master_node.stepping.single_step import SingleStepper, remedy_without_rollback, unrepeatable
from protocol.calls import DoStep, StepStatus
from protocol.signals import FloatArray


@dataclass(frozen=True, slots=True)
class _Position:
    """Where a run stands and what it takes next.

    Attributes:
        history: inputs up to T_n.
        outputs: at T_n, those of continuous variables of shape (rows, m).
        step_size: H that is wanted [s].
        order: the order control's memory; holds the input polynomial.
    """

    history: CouplingHistory
    outputs: Outputs
    step_size: float
    order: OrderMemory

    @property
    def time(self) -> float:
        return self.history.times[0]


class DefectRun:
    """Steps from the first communication point to the stop time.

    Args:
        context: what to run.

    Raises:
        ConfigurationError: no step size follows the rules of all slaves.
    """

    def __init__(self, context: RunContext) -> None:
        settings, scheme = context.system.simulation, context.scheme
        self._settings = settings
        self._start = float(settings.start_time)
        self._coupled = context.coupled
        self._scheme = scheme
        self._observer = context.observer
        self._interrupts = context.interrupts
        self._statistics = context.statistics
        self._checkpoints = context.checkpoints
        self._resumed = context.resumed
        self._limits = step_size_limits(context.system)
        self._crossings = crossings(context.system, self._limits, self._coupled.jumps)
        self._stepper = SingleStepper(context.group, self._coupled, scheme)
        self._missing = MissingDerivatives(context.coupled, scheme)
        self._coupling = CouplingDefects(context.coupled, scheme, SingleStepShape(scheme))
        self._available = AvailablePolynomials(scheme.extrapolation, coupling=self._coupling)
        self._ladder: tuple[InputPolynomial, ...] = ()
        if settings.order == "auto":
            self._ladder = ladder(
                has_derivatives=any(kind.has_derivative for kind in scheme.extrapolation.kinds),
                derivative_points=min(1, settings.polynomial.derivative_points),
            )

    def run(self, outputs: Outputs) -> str:
        """Step from outputs at T_0, those of continuous variables (rows, m), to the stop time.

        Returns:
            A slave's wish to end earlier in words, or "".

        Raises:
            DoublestepError: a slave was lost, or did not complete a step.
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
            position, self._results.memory = self._resumed.place(_Position)
        try:
            for target, crossing in self._targets():
                while not self._limits.has_reached(position.time, target):
                    end, size = self._limits.step(
                        self._start, position.time, position.step_size, target
                    )
                    position = self._step(position, end, size)
                    self._checkpoints.reached(position, self._results.memory)
                if crossing is not None and position.time < crossing[0].middle:
                    times = self._limits.crossed(position.time, crossing[0])
                    position = self._cross(position, times, crossing[1])
                    self._checkpoints.reached(position, self._results.memory)
        except BrokenOffError as broken_off:  # a slave's wish
            time = self._statistics.time
            return f"{broken_off.failed.slave} ended the simulation after t={time!r} s"
        return ""

    def _targets(self) -> Iterator[tuple[float, tuple[DoubleStepTimes, str] | None]]:
        """Where steps must end: before each known event, and at the stop time."""
        for crossing in self._crossings:
            yield crossing[0].begin, crossing
        yield self._settings.end, None

    # --- beginnings -----------------------------------------------------------------------------

    def _first_position(self, outputs: Outputs) -> _Position:
        y = outputs.y
        self._missing.note(y, self._start)
        settings, u = self._settings, self._coupled.inputs_of(y)
        depth = max(settings.polynomial.order + 4 + self._scheme.known_ahead, DEPTH)
        step_size = settings.initial_step_size or self._cautious(y)
        step_size = self._bounded(float(step_size))
        history = (
            CouplingHistory.at_rest(self._start, u, depth, step_size)
            if settings.rests_before_start
            else CouplingHistory.start(self._start, u, depth)
        )
        return _Position(history, outputs, step_size, self._restarted_order())

    def _restarted_order(self) -> OrderMemory:
        polynomial = beginning(self._ladder) if self._ladder else self._settings.polynomial
        return OrderMemory(polynomial)

    def _cautious(self, y: FloatArray) -> float:
        """An H so small that the step need not be taken back [s]."""
        return untried_step_size(
            y[0],
            y[1] if len(y) > 1 and self._scheme.has_derivative.all() else None,
            self._coupled.controlled_scale(self._coupling.scale(y[0])),
            self._settings.end - self._start,
        )

    def _bounded(self, step_size: float) -> float:
        return min(self._limits.largest, max(self._limits.smallest, step_size))

    # --- one step -------------------------------------------------------------------------------

    def _step(self, position: _Position, end: float, size: float) -> _Position:
        """One step to ``end`` [s], and what comes next."""
        following, polynomials, error = self._take(position, end, size)
        reached: Reached = (ReachedPoint(end, *following.outputs),)
        attempt = _attempt(position.time, size, polynomials, error)
        changed = self._coupled.discrete.changed(
            position.outputs.d, following.outputs.d, position.time, end
        )
        if changed or (error.has_jumped and self._settings.discontinuities):
            self._statistics.discontinuities += 1
            name = f"{changed} changes" if changed else f"{error.limiting_variable} jumps"
            attempt = attempt._replace(limiting_variable=name)
            self._tell(attempt, reached, self._results.jumped(reached))
            return self._behind_jump(following)
        self._tell(attempt, reached, self._results.reached(reached, attempt.order))
        return self._with_next_step_size(following, size)

    def _cross(self, position: _Position, times: DoubleStepTimes, name: str) -> _Position:
        """Two steps of the smallest size over a known event, whatever the defects are."""
        for end, size in ((times.middle, times.first), (times.end, times.second)):
            following, polynomials, error = self._take(position, end, size)
            reached: Reached = (ReachedPoint(end, *following.outputs),)
            attempt = _attempt(position.time, size, polynomials, error)
            attempt = attempt._replace(limiting_variable=name)
            self._tell(attempt, reached, self._results.jumped(reached))
            position = following
        self._statistics.discontinuities += 1
        return self._behind_jump(position)

    def _take(
        self, position: _Position, end: float, size: float
    ) -> tuple[_Position, Polynomials, CouplingError]:
        """All slaves to ``end`` [s]; with the step's polynomials and defects.

        Raises:
            BrokenOffError: a slave wants to end the simulation.
            DoublestepError: a slave is lost, or did not complete the step.
        """
        history = position.history
        polynomials = self._available.of(position.order.polynomial, history)
        step = DoStep(position.time, size, True)
        try:
            outputs = self._stepper.take(history, polynomials, end, step, position.outputs)
        except BrokenOffError as broken_off:
            failed = broken_off.failed
            if failed.status is StepStatus.TERMINATED:
                raise
            remedy = remedy_without_rollback(failed.slave)
            raise unrepeatable(failed, step, remedy) from failed.error
        self._checkpoints.settle()
        y = outputs.y
        self._missing.note(y, end)
        u = self._coupled.inputs_of(y)
        error = self._coupling.judge(history, polynomials, ((end, u),), y[0])
        following = _Position(history.pushed(end, u), outputs, position.step_size, position.order)
        return following, polynomials, error

    def _behind_jump(self, position: _Position) -> _Position:
        """Go on behind a discontinuity: history cut, order and step size as at the start."""
        step_size = min(self._cautious(position.outputs.y), position.step_size)
        return _Position(
            position.history.cut(),
            position.outputs,
            self._bounded(step_size),
            self._restarted_order(),
        )

    def _with_next_step_size(self, position: _Position, taken: float) -> _Position:
        """The position with the polynomial and H of the next step, after one of ``taken`` [s]."""
        wanted, grows = position.step_size, self._settings.theta_max
        memory = position.order
        if self._ladder:
            memory = memory._replace(steps=memory.steps + 1)
            factors = {
                polynomial: self._foreseen(
                    position, polynomial, SMALLEST_FACTOR * taken, LARGEST_FACTOR * taken
                )
                / taken
                for polynomial in self._ladder
                if abs(polynomial.order - memory.polynomial.order) <= 1
                and self._available.allow(polynomial, position.history)
            }
            memory, _ = prefer(memory, factors)
        largest = max(grows * taken, wanted) if taken < wanted else grows * taken
        step_size = self._foreseen(position, memory.polynomial, SMALLEST_FACTOR * taken, largest)
        return replace(position, step_size=self._bounded(step_size), order=memory)

    def _foreseen(
        self, position: _Position, polynomial: InputPolynomial, smallest: float, largest: float
    ) -> float:
        """H that the defects allow with a polynomial [s]."""
        history = position.history
        polynomials = self._available.of(polynomial, history)
        return self._coupling.step_size(
            history, polynomials, position.outputs.y[0], smallest=smallest, largest=largest
        )

    def _tell(self, attempt: Attempt, reached: Reached, points: Points) -> None:
        """Tell the observers of a step and count it."""
        with self._interrupts:
            count_accepted(self._statistics, attempt.step_size, reached)
            if not attempt.error_norm <= 1.0:
                self._statistics.steps_above_tolerance += 1
            self._observer.attempted(attempt._replace(points=points))


def _attempt(time: float, size: float, polynomials: Polynomials, error: CouplingError) -> Attempt:
    """What observers are told of a step, but for the points that it reached."""
    order, slopes = highest(polynomials)
    return Attempt(time, size, order, slopes, error.norm, True, error.limiting_variable)
