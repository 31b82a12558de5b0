"""The co-simulation loop: attempt -> decide -> accept or reject.

Nothing here knows where a slave is, and nothing is undone: a rejected step keeps the history.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from master_node.configuration import SimulationSettings, System
from master_node.double_step import DoubleStep, DoubleStepper, FailedStep
from master_node.error_control import ErrorControl, Verdict
from master_node.initialization import gather, initialize
from master_node.numerics.error_estimators import ESTIMATORS, ErrorEstimator
from master_node.numerics.extrapolation import CouplingHistory
from master_node.numerics.step_size_controller import (
    fixed_steps,
    last_step_size,
)
from master_node.observers import Attempt, Observer, Outcome, RunEnd, RunStart, Statistics
from master_node.slave_group import Program, SlaveGroup
from master_node.system import CoupledSystem
from protocol.calls import DoStep, GetOutputs, SetInputs, StepResult, Terminate
from protocol.errors import (
    ConfigurationError,
    DoublestepError,
    InterruptedRunError,
    SlaveError,
    StepSizeError,
)
from protocol.signals import FloatArray
from protocol.slave import StepStatus

_NAN = float("nan")
_INF = float("inf")

Points = tuple[tuple[float, FloatArray], ...]
"""Communication points reached and the outputs there, shape (m,) each."""


def effective_orders(coupled: CoupledSystem, order: int) -> tuple[int, ...]:
    """For each slave the degree of polynomial it can take: k, or 0 without canInterpolateInputs."""
    return tuple(
        order if part.description.capabilities.can_interpolate_inputs or not part.inputs else 0
        for part in coupled.parts
    )


def check_capabilities(coupled: CoupledSystem, settings: SimulationSettings) -> list[str]:
    """What the slaves' capabilities mean for this run, as warnings for the user.

    Raises:
        ConfigurationError: an estimator was asked for and a slave cannot save its state.
    """
    warnings = []
    for part, order in zip(coupled.parts, effective_orders(coupled, settings.order), strict=True):
        can = part.description.capabilities
        if settings.estimator != "none" and not can.can_get_and_set_state:
            raise ConfigurationError(
                f"{part.name}: the model cannot save and restore its state "
                "(canGetAndSetFMUstate), so steps cannot be controlled",
                remedy="use --estimator none with a fixed --step-size",
            )
        if settings.estimator != "none" and not can.can_handle_variable_step_size:
            raise ConfigurationError(
                f"{part.name}: the model cannot handle variable communication step sizes",
                remedy="use --estimator none with a fixed --step-size",
            )
        if order < settings.order:
            warnings.append(
                f"{part.name} cannot interpolate inputs (canInterpolateInputs): its inputs are "
                f"held constant in each step, order 0 instead of {settings.order}"
            )
    return warnings


@dataclass
class CoSimulation:
    """One run of a coupled system, from instantiated slaves to terminated ones.

    Args:
        group: the slaves, instantiated.
        coupled: their connections.
        system: the settings.
        observer: is told of everything.
    """

    group: SlaveGroup
    coupled: CoupledSystem
    system: System
    observer: Observer

    def run(self) -> Statistics:
        """Initialize, step to the stop time, terminate.

        Returns:
            The run's statistics, which the observer has got too.

        Raises:
            DoublestepError: after the observer was told; `InterruptedRunError` for Ctrl-C.
        """
        settings = self.system.simulation
        y = initialize(self.group, self.coupled, self.system)
        self.group.restart_statistics()
        statistics = Statistics(time=float(settings.start_time), slaves=self.group.statistics)
        self.observer.started(
            RunStart(
                self.coupled.output_names,
                self.coupled.output_units,
                float(settings.start_time),
                settings.end,
                y,
            )
        )
        begin = perf_counter()
        outcome, message = Outcome.FAILED, ""
        try:
            try:
                with np.errstate(over="ignore", invalid="ignore"):  # the norm finds them
                    note = self._steps(y, statistics)
            finally:
                statistics.wall_time = perf_counter() - begin
                statistics.round_trips = self.group.round_trips
                statistics.wait_time = self.group.wait_time
                self.group.restart_statistics()
            self._terminate(statistics.time)
            outcome, message = (Outcome.TERMINATED, note) if note else (Outcome.COMPLETED, "")
        except KeyboardInterrupt:
            outcome, message = Outcome.INTERRUPTED, f"interrupted at t={statistics.time!r} s"
            raise InterruptedRunError(message) from None
        except BaseException as error:
            message = str(error)
            raise
        finally:
            self.observer.ended(RunEnd(outcome, statistics, message))
        return statistics

    def _steps(self, y: FloatArray, statistics: Statistics) -> str:
        """Step to the end; a slave's wish to end earlier is returned in words."""
        estimator = ESTIMATORS.get(self.system.simulation.estimator)
        if estimator is None:
            return self._fixed_steps(y, statistics)
        return self._controlled_steps(y, statistics, estimator)

    def _terminate(self, time: float) -> None:
        self.group.execute_all([(Terminate(),)] * len(self.group), time)

    # --- with an estimator ----------------------------------------------------------------------

    def _controlled_steps(
        self, y: FloatArray, statistics: Statistics, estimator: ErrorEstimator
    ) -> str:
        settings, coupled = self.system.simulation, self.coupled
        stop, largest_order = settings.end, settings.order
        orders = effective_orders(coupled, largest_order)
        control = ErrorControl(coupled, settings, estimator, orders)
        stepper = DoubleStepper(self.group, coupled, estimator, orders)
        history = self._first_history(y, estimator.points(largest_order))
        step_size, errors_in_a_row = settings.step_size, 0
        while (time := history.times[0]) < stop:
            h = last_step_size(time, stop, step_size)
            is_last = 2.0 * h >= stop - time
            order = estimator.order(largest_order, len(history.times))
            attempt = stepper.attempt(history, h, order, stop if is_last else None)
            verdict = control.judge(attempt, h, order)
            if isinstance(attempt, DoubleStep) and verdict.accepted:
                stepper.accepted()
                history = attempt.history.pushed(attempt.end, attempt.y[coupled.source])
                points = ((attempt.middle, attempt.y_middle), (attempt.end, attempt.y))
                _accept(statistics, h, points)
                self._tell(time, h, order, verdict, points)
                step_size = (
                    verdict.step_size if h == step_size else max(step_size, verdict.step_size)
                )
                errors_in_a_row = 0
                continue
            if isinstance(attempt, FailedStep):
                if attempt.status is StepStatus.TERMINATED:
                    return f"{attempt.slave} ended the simulation after t={time!r} s"
                errors_in_a_row += attempt.error is not None
                if attempt.error is not None and errors_in_a_row > 1:
                    raise attempt.error
            stepper.rejected()
            statistics.rejected_double_steps += 1
            self._tell(time, h, order, verdict, ())
            if h <= settings.smallest:
                raise _stuck(attempt, time, h, verdict)
            step_size = verdict.step_size
        return ""

    def _tell(
        self, time: float, step_size: float, order: int, verdict: Verdict, points: Points
    ) -> None:
        accepted, _, norm, limiting = verdict
        self.observer.attempted(Attempt(time, step_size, order, norm, accepted, limiting, points))

    def _first_history(self, y: FloatArray, depth: int) -> CouplingHistory:
        settings = self.system.simulation
        u, start = y[self.coupled.source], float(settings.start_time)
        if settings.initial_history == "rest":
            return CouplingHistory.at_rest(start, u, depth, settings.step_size)
        return CouplingHistory.start(start, u, depth)

    # --- without: a fixed step, one round trip each ----------------------------------------------

    def _fixed_steps(self, y: FloatArray, statistics: Statistics) -> str:
        """Communication points start + n H, so that rounding does not add up."""
        settings, coupled = self.system.simulation, self.coupled
        start, stop, h = float(settings.start_time), settings.end, settings.step_size
        orders = effective_orders(coupled, settings.order)
        history = self._first_history(y, settings.order + 1)
        names = coupled.output_names
        last = fixed_steps(start, stop, h)
        for n in range(1, last + 1):
            time = history.times[0]
            end = start + n * h if n < last else stop
            order = min(settings.order, len(history.times) - 1)
            d = history.signal(order).derivatives
            step, get = DoStep(time, end - time, True), GetOutputs()
            programs: list[Program] = [
                (SetInputs(d[: k + 1, part.input_slice]), step, get)
                for part, k in zip(coupled.parts, orders, strict=True)
            ]
            replies = self.group.execute(programs, time, end - time)
            self.group.count_all(1, 0)
            for name, reply in zip(self.group.names, replies, strict=True):
                if reply.error is not None:
                    raise reply.error
                result = reply.results[1]
                assert isinstance(result, StepResult)
                if result.status is StepStatus.TERMINATED:
                    return f"{name} ended the simulation after t={time!r} s"
                if result.status is StepStatus.DISCARD:
                    raise SlaveError(
                        f"fmi2Discard: the step was completed only up to t={result.time!r} s",
                        slave=name,
                        phase="do_step",
                        time=time,
                        step_size=end - time,
                        remedy="lower --step-size, or use an estimator, which repeats such steps",
                    )
            y = gather(replies, -1)
            if not np.isfinite(y).all():
                bad = names[int(np.argmin(np.isfinite(y)))]
                raise SlaveError(
                    f"{bad} is not finite",
                    phase="do_step",
                    time=time,
                    step_size=end - time,
                    remedy="lower --step-size, or use an estimator, which repeats such steps",
                )
            history = history.pushed(end, y[coupled.source])
            _accept(statistics, end - time, ((end, y),))
            self.observer.attempted(Attempt(time, end - time, order, _NAN, True, "", ((end, y),)))
        return ""


def _accept(statistics: Statistics, step_size: float, points: Points) -> None:
    statistics.communication_steps += len(points)
    statistics.time = points[-1][0]
    if not step_size >= statistics.smallest_step_size:
        statistics.smallest_step_size = step_size
    if not step_size <= statistics.largest_step_size:
        statistics.largest_step_size = step_size


def _stuck(
    attempt: DoubleStep | FailedStep, time: float, step_size: float, verdict: Verdict
) -> DoublestepError:
    """The error for a rejection at the smallest communication step size."""
    if isinstance(attempt, FailedStep) and attempt.error is not None:
        return attempt.error
    reason = verdict.limiting_variable
    if verdict.error_norm < _INF:
        reason = f"ERR = {verdict.error_norm:.3g}, most of it from {reason}"
    return StepSizeError(
        f"rejected at the smallest communication step size: {reason}",
        phase="double step",
        time=time,
        step_size=step_size,
        remedy="raise the tolerances or lower smallest_step_size",
    )
