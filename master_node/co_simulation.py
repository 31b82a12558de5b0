"""One run of a coupled system: initialize, step to the stop time, terminate.

Nothing here knows where a slave is. The steps themselves are in ``controlled_run.py`` and, without
an estimator, in ``fixed_run.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from master_node.configuration import System
from master_node.controlled_run import ControlledRun
from master_node.coupling_scheme import CouplingScheme, outputs_follow_inputs
from master_node.fixed_run import FixedRun
from master_node.initialization import initialize
from master_node.numerics.error_estimators import ESTIMATORS
from master_node.observers import Observer, Outcome, RunEnd, RunStart, Statistics
from master_node.run_context import RunContext
from master_node.slave_group import SlaveGroup
from master_node.system import CoupledSystem
from protocol.calls import Terminate
from protocol.errors import ConfigurationError, InterruptedRunError
from protocol.signals import FloatArray
from protocol.slave import StateKind


def check_capabilities(coupled: CoupledSystem, system: System) -> list[str]:
    """What the slaves' capabilities mean for this run, as warnings for the user.

    Raises:
        ConfigurationError: an estimator was asked for and a slave cannot save its state, or
            cannot change its step size and has no ``step_size`` given.
    """
    settings = system.simulation
    warnings = []
    for part in coupled.parts:
        can = part.description.capabilities
        saves_state = part.description.state_kind is not StateKind.NONE
        if settings.estimator != "none" and not saves_state:
            raise ConfigurationError(
                f"{part.name}: its state cannot be saved and restored, so steps cannot be "
                f"controlled: {part.description.state_reason or 'the slave says so'}",
                remedy="use --estimator none with a fixed --step-size",
            )
        fixed = system.slaves[part.name].step_size
        if settings.estimator != "none" and not can.can_handle_variable_step_size and fixed is None:
            raise ConfigurationError(
                f"{part.name}: the model cannot handle variable communication step sizes",
                remedy=f"give [slaves.{part.name}] step_size, or use --estimator none with a fixed "
                "--step-size",
            )
        highest, wanted = part.max_order, settings.order
        if part.connected and (highest < (1 if wanted == "auto" else wanted)):
            warnings.append(
                f"{part.name} cannot interpolate inputs (canInterpolateInputs): its inputs are "
                f"held constant in each step, order {highest} instead of {wanted}"
            )
        if any(coupled.external.changes[part.external_slice]) and not highest:
            warnings.append(
                f"{part.name} cannot interpolate inputs (canInterpolateInputs): its external "
                "inputs are held at their mean in each step"
            )
        has_feed_through = coupled.feed_through[part.output_slice].any()
        evaluates = settings.evaluate_outputs and has_feed_through
        if evaluates and not outputs_follow_inputs(part, system):
            warnings.append(
                f"{part.name}: its outputs with direct feed-through cannot be evaluated again at "
                "communication points, as FMI 2.0 does not promise that they follow its inputs "
                f"without a step; if they do, say so: [slaves.{part.name}] "
                "outputs_follow_inputs = true"
            )
    return warnings + _jumps_off_the_grid(coupled, system)


def _jumps_off_the_grid(coupled: CoupledSystem, system: System) -> list[str]:
    """Without an estimator no communication point is put where an external input jumps."""
    settings = system.simulation
    if settings.estimator != "none":
        return []
    start, stop, step_size = float(settings.start_time), settings.end, settings.step_size
    inside = [jump for jump in coupled.external.jumps if start < jump.time < stop]
    steps = np.array([(jump.time - start) / step_size for jump in inside])
    is_off = np.abs(steps - np.round(steps)) > 1e-9 * np.maximum(1.0, steps)
    if not is_off.any():
        return []
    first = inside[int(np.argmax(is_off))]
    return [
        f"{int(is_off.sum())} jumps of external inputs are not at communication points, the first "
        f"one is that of {first.name} at t={first.time!r} s: in a step over a jump the polynomial "
        "has the right mean only; choose a step size that meets them, or an estimator"
    ]


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
        scheme = CouplingScheme.of(self.coupled, self.system)
        y = initialize(self.group, self.coupled, self.system, scheme.get_outputs).y
        self.group.restart_statistics()
        statistics = Statistics(time=float(settings.start_time), slaves=self.group.statistics)
        self.observer.started(
            RunStart(
                self.coupled.output_names,
                self.coupled.output_units,
                float(settings.start_time),
                settings.end,
                y[0],
            )
        )
        begin = perf_counter()
        outcome, message = Outcome.FAILED, ""
        try:
            try:
                with np.errstate(over="ignore", invalid="ignore"):  # the norm finds them
                    note = self._steps(scheme, y, statistics)
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

    def _steps(self, scheme: CouplingScheme, y: FloatArray, statistics: Statistics) -> str:
        """Step to the end; a slave's wish to end earlier is returned in words."""
        context = RunContext(
            self.group, self.coupled, scheme, self.system, self.observer, statistics
        )
        estimator = ESTIMATORS.get(self.system.simulation.estimator)
        if estimator is None:
            return FixedRun(context).run(y)
        return ControlledRun(context, estimator).run(y)

    def _terminate(self, time: float) -> None:
        self.group.execute_all([(Terminate(),)] * len(self.group), time)
