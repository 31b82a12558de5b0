"""A run with a fixed communication step size and no estimator: one round trip for each step."""

from __future__ import annotations

from math import ulp
from typing import NamedTuple

from master_node.numerics.extrapolation import CouplingHistory, highest
from master_node.numerics.step_size_controller import fixed_steps
from master_node.observers import Attempt
from master_node.outputs import Outputs
from master_node.result_points import ReachedPoint, ResultPoints, count_accepted
from master_node.run_context import RunContext
from master_node.single_step import SingleStepper, unrepeatable
from master_node.step_requests import BrokenOffError
from protocol.calls import DoStep
from protocol.slave import StepStatus

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

    def run(self, outputs: Outputs) -> str:
        """Step from outputs at T_0, those of continuous variables (rows, m), to the stop time.

        Communication points are start + n H, so that rounding does not add up.

        Returns:
            A slave's wish to end earlier in words, or "".
        """
        context = self._context
        coupled, scheme = context.coupled, context.scheme
        settings = context.system.simulation
        start, stop, h = float(settings.start_time), settings.end, settings.step_size
        wanted = settings.polynomial
        stepper = SingleStepper(context)
        results = ResultPoints(settings.output_grid, scheme.has_derivative, start, outputs)
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
        last = fixed_steps(start, stop, h)
        rounding = 8.0 * ulp(max(abs(start), abs(stop)))
        for n in range(done + 1, last + 1):
            time = history.times[0]
            end = start + n * h if n < last else stop
            polynomials = scheme.extrapolation.polynomials(wanted, len(history.times))
            rest = end - time  # H but for rounding, unless the last step is a shorter one
            step = DoStep(time, h if abs(rest - h) <= rounding else rest, True)
            try:
                outputs = stepper.take(history, polynomials, end, step, outputs)
            except BrokenOffError as broken_off:
                failed = broken_off.failed
                if failed.status is StepStatus.TERMINATED:
                    return f"{failed.slave} ended the simulation after t={time!r} s"
                raise unrepeatable(failed, step, _REMEDY) from failed.error
            context.checkpoints.settle()
            history = history.pushed(end, coupled.inputs_of(outputs.y))
            reached = (ReachedPoint(end, *outputs),)
            order, slopes = highest(polynomials)
            points = results.reached(reached, order)
            with context.interrupts:
                count_accepted(context.statistics, step.step_size, reached)
                context.observer.attempted(
                    Attempt(time, step.step_size, order, slopes, _NAN, True, "", points)
                )
            context.checkpoints.reached(_Position(n, history, outputs), results.memory)
        return ""
