"""A run with a fixed communication step size and no estimator: one round trip for each step."""

from __future__ import annotations

from functools import partial
from math import ulp

from master_node.numerics.extrapolation import CouplingHistory, Polynomials
from master_node.numerics.step_size_controller import fixed_steps
from master_node.observers import Attempt
from master_node.result_points import ResultPoints, count_accepted
from master_node.run_context import RunContext
from master_node.step_requests import BrokenOffError, FailedStep, Piece, StepRequests
from protocol.calls import DoStep
from protocol.errors import DoublestepError, SlaveError
from protocol.signals import FloatArray
from protocol.slave import StepStatus

_NAN = float("nan")


class FixedRun:
    """Steps of one size, as far as the slaves follow: nothing is estimated or taken back."""

    def __init__(self, context: RunContext) -> None:
        self._context = context

    def run(self, y: FloatArray) -> str:
        """Step from outputs ``y`` at T_0, shape (rows, m), to the stop time.

        Communication points are start + n H, so that rounding does not add up.

        Returns:
            A slave's wish to end earlier in words, or "".
        """
        context = self._context
        coupled, scheme = context.coupled, context.scheme
        settings = context.system.simulation
        start, stop, h = float(settings.start_time), settings.end, settings.step_size
        wanted = settings.polynomial
        requests = StepRequests(context.group, coupled, scheme)
        results = ResultPoints(settings.output_grid, scheme.has_derivative, start, y)
        depth, u = wanted.order + 1 + scheme.known_ahead, coupled.inputs_of(y)
        history = (
            CouplingHistory.at_rest(start, u, depth, h)
            if settings.rests_before_start
            else CouplingHistory.start(start, u, depth)
        )
        last = fixed_steps(start, stop, h)
        rounding = 8.0 * ulp(max(abs(start), abs(stop)))
        for n in range(1, last + 1):
            time = history.times[0]
            end = start + n * h if n < last else stop
            polynomials = scheme.extrapolation.polynomials(wanted, len(history.times))
            inputs = partial(self._inputs, history, polynomials, end)
            rest = end - time  # H but for rounding, unless the last step is a shorter one
            step = DoStep(time, h if abs(rest - h) <= rounding else rest, True)
            external = coupled.external.over(time, end)
            piece = Piece((), inputs, external, step, scheme.get_outputs, scheme.output_rows)
            try:
                (y,) = requests.take([piece])
            except BrokenOffError as broken_off:
                failed = broken_off.failed
                if failed.status is StepStatus.TERMINATED:
                    return f"{failed.slave} ended the simulation after t={time!r} s"
                raise _error(failed, step) from failed.error
            history = history.pushed(end, coupled.inputs_of(y))
            count_accepted(context.statistics, step.step_size, ((end, y),))
            order = max(polynomial.order for polynomial in polynomials)
            slopes = max(polynomial.derivative_points for polynomial in polynomials)
            points = results.reached(((end, y),), order)
            context.observer.attempted(
                Attempt(time, step.step_size, order, slopes, _NAN, True, "", points)
            )
        return ""

    def _inputs(
        self, history: CouplingHistory, polynomials: Polynomials, end: float, known: FloatArray
    ) -> FloatArray:
        """Derivatives of all inputs in a step to ``end``, with what is ``known`` there."""
        scheme, coupled = self._context.scheme, self._context.coupled
        ahead = scheme.known_ahead
        past = history.pushed(end, coupled.inputs_of(known)) if ahead else history
        return scheme.extrapolation.signal(past, polynomials, ahead).derivatives


def _error(failed: FailedStep, step: DoStep) -> DoublestepError:
    """Nothing is taken back here, so a step that was not completed ends the run."""
    if failed.error is not None:
        return failed.error
    reason = failed.reason
    if failed.status is StepStatus.DISCARD:
        reached = step.communication_point + failed.reached * step.step_size
        reason = f"fmi2Discard: the step was completed only up to t={reached!r} s"
    return SlaveError(
        reason,
        slave=failed.slave,
        phase="do_step",
        time=step.communication_point,
        step_size=step.step_size,
        remedy="lower --step-size, or use an estimator, which repeats such steps",
    )
