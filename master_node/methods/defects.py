"""Steps of slaves of which none can go back: of a controlled size, without rejections.

Each step is one round trip. How far the inputs turn out to be from their polynomials is known after
it, and how far they would have been from other polynomials too: both, order and H of the next step,
follow from the past communication points alone.
"""

from __future__ import annotations

from typing import NamedTuple

from master_node.coupling.outputs import Outputs
from master_node.coupling.step_sizes import step_size_limits
from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.defects import CouplingDefects, SingleStepShape
from master_node.methods.base import Back, Ended, FinalSteps, Setup, Shape, Verdict, ended_by
from master_node.methods.first_step_size import UntriedStepSize
from master_node.methods.position import Position, SecondHalf
from master_node.methods.targets import Targets
from master_node.numerics.extrapolation import CouplingHistory, InputPolynomial
from master_node.numerics.order_control import (
    DEPTH,
    LARGEST_FACTOR,
    SMALLEST_FACTOR,
    OrderMemory,
    beginning,
    ladder,
    prefer,
)
from master_node.numerics.step_size_controller import passes
from master_node.stepping.requests import BrokenOffError
from master_node.stepping.single_step import (
    SingleStep,
    SingleStepper,
    remedy_without_rollback,
    unrepeatable,
)
from protocol.calls import StepStatus


class DefectWay(NamedTuple):
    """The next step.

    Attributes:
        end: of the step [s].
        size: of the step [s].
        crossing: name of the known event that it leads over, whatever its defects are; "": none.
        second_half: step that must follow; None: there is none.
    """

    end: float
    size: float
    crossing: str = ""
    second_half: SecondHalf | None = None


class DefectSteps(FinalSteps):
    """A method that controls H by the defects of the inputs.

    Args:
        setup: what to run.

    Raises:
        ConfigurationError: no step size follows the rules of all slaves.
    """

    def __init__(self, setup: Setup) -> None:
        settings, scheme = setup.system.simulation, setup.scheme
        self._settings = settings
        self._start = setup.start
        self._coupled = setup.coupled
        self._scheme = scheme
        self._limits = step_size_limits(setup.system)
        self._targets = Targets(setup, self._limits)
        self._stepper = SingleStepper(setup.group, self._coupled, scheme)
        self._coupling = CouplingDefects(setup.coupled, scheme, SingleStepShape(scheme))
        self._cautious = UntriedStepSize(setup, self._limits, self._coupling)
        self._available = AvailablePolynomials(scheme.extrapolation, coupling=self._coupling)
        self._ladder: tuple[InputPolynomial, ...] = ()
        if settings.order == "auto":
            self._ladder = ladder(
                has_derivatives=any(kind.has_derivative for kind in scheme.extrapolation.kinds),
                derivative_points=min(1, settings.polynomial.derivative_points),
            )

    def begin(self, outputs: Outputs) -> Position:
        """See `Method`."""
        y = outputs.y
        settings, u = self._settings, self._coupled.inputs_of(y)
        depth = max(settings.polynomial.order + 4 + self._scheme.known_ahead, DEPTH)
        step_size = settings.initial_step_size or self._cautious.step_size(y)
        step_size = self._limits.bounded(float(step_size))
        history = (
            CouplingHistory.at_rest(self._start, u, depth, step_size)
            if settings.rests_before_start
            else CouplingHistory.start(self._start, u, depth)
        )
        return Position(history, outputs, step_size, self._restarted_order())

    def has_reached(self, time: float, target: float) -> bool:
        """See `Method`."""
        return self._limits.has_reached(time, target)

    def way(self, position: Position, until: float) -> DefectWay | None:
        """See `Method`; two steps of the smallest size lead over a known event."""
        half = position.second_half
        if half is not None:
            return DefectWay(*half)
        target = self._targets.following(position.time, until)
        if target is None:
            return None
        times = target.crossing
        if times is not None:
            half = SecondHalf(times.end, times.second, target.name)
            return DefectWay(times.middle, times.first, target.name, half)
        return DefectWay(
            *self._limits.step(self._start, position.time, position.step_size, target.time)
        )

    def attempt(self, position: Position, way: DefectWay) -> SingleStep | Back | Ended:
        """See `Method`; a step that is not completed ends the run."""
        history = position.history
        polynomials = self._available.of(position.order.polynomial, history)
        try:
            return self._stepper.take(history, polynomials, way.end, way.size, position.outputs)
        except BrokenOffError as broken_off:
            failed = broken_off.failed
            if failed.status is StepStatus.TERMINATED:
                return ended_by(failed.slave, position.time)
            remedy = remedy_without_rollback(failed.slave)
            raise unrepeatable(failed, position.time, way.size, remedy) from failed.error

    def judge(self, position: Position, way: DefectWay, step: SingleStep) -> Verdict:
        """See `Method`: each step is accepted, as it cannot be taken back."""
        y, changed = step.outputs.y, ""
        reached = ((step.end, self._coupled.inputs_of(y)),)
        error = self._coupling.judge(position.history, step.polynomials, reached, y[0])
        verdict = Verdict(error.norm, error.limiting_variable)
        if not passes(error.norm):
            verdict = verdict.counting(steps_above_tolerance=1)
        if way.crossing:
            name = way.crossing
        else:
            changed = self._coupled.discrete.changed(
                position.outputs.d, step.outputs.d, step.begin, step.end
            )
            if not changed and not (error.has_jumped and self._settings.discontinuities):
                return verdict
            name = f"{changed} changes" if changed else f"{error.limiting_variable} jumps"
        verdict = verdict._replace(limiting_variable=name, shape=Shape.JUMP)
        return verdict.counting(discontinuities=int(way.second_half is None))

    def next(
        self, position: Position, way: DefectWay, step: SingleStep, verdict: Verdict
    ) -> Position:
        """See `Method`."""
        history = position.history.pushed(step.end, self._coupled.inputs_of(step.outputs.y))
        following = Position(history, step.outputs, position.step_size, position.order)
        if way.second_half is not None:
            return following._replace(second_half=way.second_half)
        if verdict.shape is Shape.JUMP:
            return self._behind_jump(following)
        return self._with_next_step_size(following, way.size)

    def behind_event(self, position: Position) -> Position:
        """See `Method`."""
        u = self._coupled.inputs_of(position.outputs.y)
        history = CouplingHistory.start(position.time, u, position.history.depth)
        return self._behind_jump(position._replace(history=history))

    def check_target(self, position: Position, time: float) -> None:
        """See `Method`."""
        self._targets.check(position.time, time, together=1)

    def _restarted_order(self) -> OrderMemory:
        polynomial = beginning(self._ladder) if self._ladder else self._settings.polynomial
        return OrderMemory(polynomial)

    def _behind_jump(self, position: Position) -> Position:
        """Go on behind a discontinuity: history cut, order and step size as at the start."""
        step_size = min(self._cautious.step_size(position.outputs.y), position.step_size)
        return Position(
            position.history.cut(),
            position.outputs,
            self._limits.bounded(step_size),
            self._restarted_order(),
        )

    def _with_next_step_size(self, position: Position, taken: float) -> Position:
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
        return position._replace(step_size=self._limits.bounded(step_size), order=memory)

    def _foreseen(
        self, position: Position, polynomial: InputPolynomial, smallest: float, largest: float
    ) -> float:
        """H that the defects allow with a polynomial [s]."""
        history = position.history
        polynomials = self._available.of(polynomial, history)
        return self._coupling.step_size(
            history, polynomials, position.outputs.y[0], smallest=smallest, largest=largest
        )
