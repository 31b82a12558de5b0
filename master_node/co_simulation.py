"""The co-simulation loop: attempt -> decide -> accept or reject.

Nothing here knows where a slave is, and nothing is undone: a rejected step keeps the history.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from master_node.configuration import SimulationSettings, System
from master_node.double_step import DoubleStep, DoubleStepper, FailedStep
from master_node.initialization import gather, initialize
from master_node.numerics.error_estimators import ESTIMATORS, ErrorEstimator
from master_node.numerics.extrapolation import CouplingHistory
from master_node.numerics.norms import weighted_rms_norm
from master_node.numerics.step_size_controller import StepSizeController, last_step_size
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
        stop = settings.end
        controller = StepSizeController(
            settings.alpha,
            settings.theta_min,
            settings.theta_max,
            settings.smallest,
            settings.largest,
        )
        orders = effective_orders(coupled, settings.order)
        stepper = DoubleStepper(self.group, coupled, estimator, orders)
        history = self._first_history(y, estimator.points(settings.order))
        ratios = [
            estimator.ratio(np.minimum(np.array(orders), k)[coupled.output_slave])
            for k in range(settings.order + 1)
        ]
        lowest_order = min(orders)
        step_size = settings.step_size
        errors_in_a_row = 0
        while (time := history.times[0]) < stop:
            h = last_step_size(time, stop, step_size)
            is_last = 2.0 * h >= stop - time
            order = estimator.order(settings.order, len(history.times))
            solution = stepper.attempt(history, h, order, stop if is_last else None)
            if isinstance(solution, DoubleStep):
                error = estimator.estimate(solution.y, solution.y_comparison, ratios[order])
                norm, worst = weighted_rms_norm(
                    error, solution.y, coupled.absolute_tolerance, coupled.relative_tolerance
                )
                exponent = min(lowest_order, order) + (1 if coupled.has_feed_through else 2)
                decision = controller.decide(h, norm, exponent)
                limiting = coupled.output_names[worst]
                following = decision.step_size
                if decision.accepted:
                    errors_in_a_row = 0
                    stepper.accepted()
                    history = solution.history.pushed(solution.end, solution.y[coupled.source])
                    self._accept(statistics, h, 2, solution.end)
                    self.observer.attempted(
                        Attempt(
                            time,
                            h,
                            order,
                            norm,
                            True,
                            limiting,
                            ((solution.middle, solution.y_middle), (solution.end, solution.y)),
                        )
                    )
                    step_size = following if h == step_size else max(following, step_size)
                    continue
                if norm == _INF and not np.isfinite(solution.y).all():
                    limiting += " is not finite"
            else:
                norm, limiting = _INF, solution.reason
                if solution.status is StepStatus.TERMINATED:
                    return f"{solution.slave} ended the simulation after t={time!r} s"
                if solution.error is not None:
                    errors_in_a_row += 1
                    if errors_in_a_row > 1:
                        raise solution.error
                following = controller.after_discard(h, solution.reached)
            stepper.rejected()
            statistics.rejected_double_steps += 1
            self.observer.attempted(Attempt(time, h, order, norm, False, limiting))
            if h <= settings.smallest:
                raise self._stuck(solution, time, h, norm, limiting)
            step_size = following
        return ""

    def _first_history(self, y: FloatArray, depth: int) -> CouplingHistory:
        settings = self.system.simulation
        u, start = y[self.coupled.source], float(settings.start_time)
        if settings.initial_history == "rest":
            return CouplingHistory.at_rest(start, u, depth, settings.step_size)
        return CouplingHistory.start(start, u, depth)

    def _stuck(
        self, solution: DoubleStep | FailedStep, time: float, h: float, norm: float, limiting: str
    ) -> DoublestepError:
        if isinstance(solution, FailedStep) and solution.error is not None:
            return solution.error
        reason = f"ERR = {norm:.3g}, most of it from {limiting}" if norm < _INF else limiting
        return StepSizeError(
            f"rejected at the smallest communication step size: {reason}",
            phase="double step",
            time=time,
            step_size=h,
            remedy="raise the tolerances or lower smallest_step_size",
        )

    @staticmethod
    def _accept(statistics: Statistics, h: float, steps: int, time: float) -> None:
        statistics.communication_steps += steps
        statistics.time = time
        if not h >= statistics.smallest_step_size:
            statistics.smallest_step_size = h
        if not h <= statistics.largest_step_size:
            statistics.largest_step_size = h

    # --- without: a fixed step, one round trip each ----------------------------------------------

    def _fixed_steps(self, y: FloatArray, statistics: Statistics) -> str:
        """Communication points start + n H, so that rounding does not add up."""
        settings, coupled = self.system.simulation, self.coupled
        start, stop, h = float(settings.start_time), settings.end, settings.step_size
        orders = effective_orders(coupled, settings.order)
        history = self._first_history(y, settings.order + 1)
        names = coupled.output_names
        n = 0
        while (time := history.times[0]) < stop:
            n += 1
            end = min(start + n * h, stop)
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
            self._accept(statistics, end - time, 1, end)
            self.observer.attempted(Attempt(time, end - time, order, _NAN, True, "", ((end, y),)))
        return ""
