"""Steps of one size, as far as the slaves follow: nothing is estimated or taken back."""

from __future__ import annotations

from math import floor, ulp
from typing import NamedTuple

from master_node.coupling.outputs import Outputs
from master_node.coupling.step_sizes import fixed_step_limits
from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.methods.base import Back, Ended, FinalSteps, Setup, Verdict, ended_by
from master_node.methods.position import Position
from master_node.methods.targets import off_the_grid
from master_node.numerics.extrapolation import CouplingHistory
from master_node.numerics.order_control import OrderMemory
from master_node.numerics.step_size_controller import fixed_steps
from master_node.stepping.requests import BrokenOffError
from master_node.stepping.single_step import SingleStep, SingleStepper, unrepeatable
from protocol.calls import StepStatus
from protocol.step_sums import step_to

_NAN = float("nan")
_REMEDY = "lower --step-size, or use an estimator, which repeats such steps"


class FixedWay(NamedTuple):
    """The next step.

    Attributes:
        end: of the step [s].
        size: of the step [s].
    """

    end: float
    size: float


class FixedSteps(FinalSteps):
    """A method without an estimator: one round trip for each step.

    Communication points are start + n H, so that rounding does not add up, and step sizes the
    differences of them. Where these are above the largest size that a slave takes, the points fall
    behind by rounding, and the last step becomes two.

    Args:
        setup: what to run.

    Raises:
        ConfigurationError: the step size is against the rules of a slave.
    """

    def __init__(self, setup: Setup) -> None:
        settings, scheme = setup.system.simulation, setup.scheme
        self._settings = settings
        self._coupled = setup.coupled
        self._start, self._stop = setup.start, settings.end
        self._step_size = settings.step_size
        self._number = fixed_steps(self._start, self._stop, self._step_size)
        self._limits = fixed_step_limits(setup.system)
        self._depth = settings.polynomial.order + 1 + scheme.known_ahead
        self._stepper = SingleStepper(setup.group, setup.coupled, scheme)
        self._available = AvailablePolynomials(scheme.extrapolation)
        self._rounding = 8.0 * ulp(max(abs(self._start), abs(self._stop)))

    def begin(self, outputs: Outputs) -> Position:
        """See `Method`."""
        start, depth, u = self._start, self._depth, self._coupled.inputs_of(outputs.y)
        history = (
            CouplingHistory.at_rest(start, u, depth, self._step_size)
            if self._settings.rests_before_start
            else CouplingHistory.start(start, u, depth)
        )
        return Position(history, outputs, self._step_size, OrderMemory(self._settings.polynomial))

    def has_reached(self, time: float, target: float) -> bool:
        """See `Method`."""
        return self._limits.has_reached(time, target)

    def way(self, position: Position, until: float) -> FixedWay | None:  # noqa: ARG002  a grid
        """See `Method`; ``until`` is a communication point already."""
        time, stop, number = position.time, self._stop, position.steps + 1
        if number > self._number and self._limits.has_reached(time, stop):
            return None
        limits, end = self._limits, stop
        if number < self._number:
            end = self._start + number * self._step_size
        elif number == self._number and limits.quantum is None and stop - time > limits.longest:
            end = time + 0.5 * (stop - time)
        size = step_to(time, end, largest=limits.longest)
        return FixedWay(limits.reached(time + size, end), size)

    def attempt(self, position: Position, way: FixedWay) -> SingleStep | Back | Ended:
        """See `Method`."""
        polynomials = self._available.of(self._settings.polynomial, position.history)
        try:
            step = self._stepper.take(position.history, polynomials, *way, position.outputs)
        except BrokenOffError as broken_off:
            failed = broken_off.failed
            if failed.status is StepStatus.TERMINATED:
                return ended_by(failed.slave, position.time)
            raise unrepeatable(failed, position.time, way.size, _REMEDY) from failed.error
        if abs(way.size - self._step_size) <= self._rounding:
            return step._replace(step_size=self._step_size)
        return step

    def judge(self, position: Position, way: FixedWay, step: SingleStep) -> Verdict:  # noqa: ARG002
        """See `Method`: each step is accepted."""
        return Verdict(_NAN)

    def next(
        self,
        position: Position,
        way: FixedWay,  # noqa: ARG002
        step: SingleStep,
        verdict: Verdict,  # noqa: ARG002
    ) -> Position:
        """See `Method`."""
        history = position.history.pushed(step.end, self._coupled.inputs_of(step.outputs.y))
        return position._replace(history=history, outputs=step.outputs, steps=position.steps + 1)

    def behind_event(self, position: Position) -> Position:
        """See `Method`."""
        u = self._coupled.inputs_of(position.outputs.y)
        return position._replace(history=CouplingHistory.start(position.time, u, self._depth))

    def check_target(self, position: Position, time: float) -> None:  # noqa: ARG002
        """See `Method`."""
        steps = (time - self._start) / self._step_size
        below = self._start + floor(steps) * self._step_size
        above = min(self._stop, below + self._step_size)
        if not any(abs(time - point) <= self._rounding for point in (below, above)):
            raise off_the_grid(time, below, above)
