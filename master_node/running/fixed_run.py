"""A run with a fixed communication step size and no estimator: one round trip for each step."""

from __future__ import annotations

from math import ulp
from typing import NamedTuple

from master_node.coupling.outputs import Outputs
from master_node.coupling.result_points import ReachedPoint, ResultPoints, count_accepted
from master_node.coupling.step_sizes import fixed_step_limits
from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.missing_derivatives import MissingDerivatives
from master_node.numerics.extrapolation import CouplingHistory, highest
from master_node.numerics.step_size_controller import fixed_steps
from master_node.observing.observers import Attempt
from master_node.running.context import RunContext
from master_node.stepping.requests import BrokenOffError
from master_node.stepping.single_step import SingleStepper, unrepeatable
from protocol.calls import DoStep, StepStatus
from protocol.step_sums import step_to

_NAN = float("nan")
_REMEDY = "lower --step-size, or use an estimator, which repeats such steps"


class _Position(NamedTuple):
    """Where a run stands.

    Attributes:
        steps: taken so far.
        history: inputs up to there.
        outputs: there, those of continuous variables of shape (rows, m).
    """

    steps: int
    history: CouplingHistory
    outputs: Outputs


class FixedRun:
    """Steps of one size, as far as the slaves follow: nothing is estimated or taken back."""

    def __init__(self, context: RunContext) -> None:
        self._context = context
        settings = context.system.simulation
        self._start, self._stop = float(settings.start_time), settings.end
        self._step_size = settings.step_size
        self._number = fixed_steps(self._start, self._stop, self._step_size)
        self._limits = fixed_step_limits(context.system)

    def run(self, outputs: Outputs) -> str:
        """Step from outputs at T_0, those of continuous variables (rows, m), to the stop time.

        Communication points are start + n H, so that rounding does not add up, and step sizes
        the differences of them. Where these are above the largest size that a slave takes, the
        points fall behind by rounding, and the last step becomes two.

        Returns:
            A slave's wish to end earlier in words, or "".
        """
        context = self._context
        coupled, scheme = context.coupled, context.scheme
        settings = context.system.simulation
        start, stop, h = self._start, self._stop, self._step_size
        wanted = settings.polynomial
        stepper = SingleStepper(context.group, coupled, scheme)
        missing = MissingDerivatives(coupled, scheme)
        missing.note(outputs.y, start)
        available = AvailablePolynomials(scheme.extrapolation)
        results = ResultPoints(settings.output_grid, coupled, scheme.has_derivative, start, outputs)
        depth, u = wanted.order + 1 + scheme.known_ahead, coupled.inputs_of(outputs.y)
        history = (
            CouplingHistory.at_rest(start, u, depth, h)
            if settings.rests_before_start
            else CouplingHistory.start(start, u, depth)
        )
        done = 0
        if context.resumed is not None:
            place, results.memory = context.resumed.place(_Position)
            done, history, outputs = place
        rounding = 8.0 * ulp(max(abs(start), abs(stop)))
        while done < self._number or not self._limits.has_reached(history.times[0], stop):
            done += 1
            time = history.times[0]
            end, size = self._next(time, done)
            polynomials = available.of(wanted, history)
            step = DoStep(time, size, True)
            try:
                outputs = stepper.take(history, polynomials, end, step, outputs)
            except BrokenOffError as broken_off:
                failed = broken_off.failed
                if failed.status is StepStatus.TERMINATED:
                    return f"{failed.slave} ended the simulation after t={time!r} s"
                raise unrepeatable(failed, step, _REMEDY) from failed.error
            context.checkpoints.settle()
            missing.note(outputs.y, end)
            history = history.pushed(end, coupled.inputs_of(outputs.y))
            reached = (ReachedPoint(end, *outputs),)
            order, slopes = highest(polynomials)
            points = results.reached(reached, order)
            taken = h if abs(size - h) <= rounding else size
            with context.interrupts:
                count_accepted(context.statistics, taken, reached)
                context.observer.attempted(
                    Attempt(time, taken, order, slopes, _NAN, True, "", points)
                )
            context.checkpoints.reached(_Position(done, history, outputs), results.memory)
        return ""

    def _next(self, time: float, number: int) -> tuple[float, float]:
        """The end and the size [s] of the step of this ``number`` from ``time`` [s]."""
        limits, stop = self._limits, self._stop
        end = stop
        if number < self._number:
            end = self._start + number * self._step_size
        elif number == self._number and limits.quantum is None and stop - time > limits.longest:
            end = time + 0.5 * (stop - time)
        size = step_to(time, end, largest=limits.longest)
        return limits.reached(time + size, end), size
