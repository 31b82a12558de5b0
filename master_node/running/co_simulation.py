"""One run of a coupled system: initialize, step to the stop time, terminate.

Nothing here knows where a slave is. The steps are taken by the loop (`loop.py`), with the method
that the system needs (`methods/choosing.py`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import perf_counter

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.outputs import Outputs
from master_node.coupling.result_points import ResultPoints
from master_node.coupling.scheme import (
    CouplingScheme,
    output_control,
)
from master_node.methods.base import Setup
from master_node.methods.choosing import method_of
from master_node.methods.position import Position
from master_node.observing.observers import (
    DiscreteType,
    Observer,
    Outcome,
    RunEnd,
    RunStart,
    Statistics,
)
from master_node.observing.run_warnings import warnings_of
from master_node.preparing.initialization import initialize
from master_node.resuming.checkpoints import NO_CHECKPOINTS, Checkpoints, Resumed
from master_node.running.actions import Actions
from master_node.running.interrupts import Interrupts
from master_node.running.journal import Journal
from master_node.running.loop import Loop
from master_node.running.run import Run, ignored_overflow
from master_node.running.steering import Steering
from master_node.slaves.group import SlaveGroup
from master_node.system.system import System
from protocol.calls import Terminate
from protocol.errors import DoublestepError, InterruptedRunError
from protocol.variables import VariableType

log = logging.getLogger("master_node")


def enumerations(coupled: CoupledSystem) -> dict[str, Mapping[str, int]]:
    """The items of all enumerations among the results, by ``slave.variable``."""
    recorded = (one for one in coupled.recorded.discrete)
    found = {one.name: one.variable.items for one in recorded}
    for part in coupled.parts:
        items = {v.name: v.items for v in part.description.variables if v.items}
        found |= {f"{part.name}.{n}": items[n] for n in part.discrete_outputs if n in items}
    return {name: items for name, items in found.items() if items}


def _discrete_type(type_: VariableType) -> DiscreteType:
    """Type of the results of a variable of this type."""
    if type_.is_real:
        return "float"
    if type_.integer_range is not None:
        return "integer"
    return _DISCRETE_TYPES[type_]


_DISCRETE_TYPES: Mapping[VariableType, DiscreteType] = {
    VariableType.BOOLEAN: "boolean",
    VariableType.STRING: "string",
    VariableType.BINARY: "binary",
}


@dataclass
class CoSimulation:
    """One run of a coupled system, from instantiated slaves to terminated ones.

    Args:
        group: the slaves, instantiated.
        coupled: their connections.
        system: the settings.
        observer: is told of everything.
        outputs: at T_0 of slaves that stand there already; None: they are
            still to be initialized.
        checkpoints: are told where the run stands.
        resumed: where to go on, with slaves that can be restored; None: at T_0.

    Attributes:
        has_begun: True when the observer was told of the beginning.
        end: what the observer is told at the end; None: it is not there yet.
    """

    group: SlaveGroup
    coupled: CoupledSystem
    system: System
    observer: Observer
    outputs: Outputs | None = None
    checkpoints: Checkpoints = NO_CHECKPOINTS
    resumed: Resumed | None = None
    has_begun: bool = field(default=False, init=False)
    end: RunEnd | None = field(default=None, init=False)

    def run(self) -> Statistics:
        """Initialize, step to the stop time, terminate.

        Returns:
            The run's statistics, which the observer has got too.

        Raises:
            DoublestepError: after the observer was told; `InterruptedRunError` for Ctrl-C.
        """
        with self.opened() as run:
            run.through()
        return run.statistics

    @contextmanager
    def opened(self) -> Iterator[Run]:
        """A run at its first communication point; at the end slaves are terminated.

        Raises:
            DoublestepError: after the observer was told; `InterruptedRunError` for Ctrl-C.
        """
        settings = self.system.simulation
        actions = Actions(self.system, Steering(self.coupled, self.system))
        scheme = CouplingScheme.of(self.coupled, self.system)
        outputs = self.outputs
        if outputs is None:
            outputs = initialize(self.group, self.coupled, self.system, scheme.get_outputs)
        outputs = outputs._replace(y=outputs.y[: scheme.output_rows])
        self.group.restart_statistics()
        statistics = Statistics(time=float(settings.start_time), slaves=self.group.statistics)
        if self.resumed is not None:
            self.checkpoints.restore(self.resumed)
            self.group.continue_statistics(self.resumed.statistics)
            statistics = replace(self.resumed.statistics, slaves=self.group.statistics)
        self.observer.started(self._start(outputs))
        self.has_begun = True
        begin = perf_counter() - statistics.wall_time

        def update() -> None:
            statistics.wall_time = perf_counter() - begin
            statistics.round_trips = self.group.round_trips
            statistics.wait_time = self.group.wait_time
            for slave, restarts in self.checkpoints.restarts().items():
                statistics.slaves[slave].restarts = restarts

        outcome, message = Outcome.FAILED, ""
        run: Run | None = None
        try:
            self.checkpoints.begin(statistics, update)
            try:
                run = self._run(scheme, outputs, statistics, actions)
                run.begin()
                yield run
            finally:
                update()
                self.group.restart_statistics()
            refusal = self._terminate(statistics.time)
            outcome, note = run.outcome
            message = "; ".join(filter(None, (note, refusal)))
        except KeyboardInterrupt:
            outcome, message, error = self._interrupted(run, statistics.time)
            raise error from None
        except BaseException as failure:
            message = str(failure)
            raise
        finally:
            if not outcome.is_complete:
                self.checkpoints.broken_off()
            for warning in warnings_of(statistics):
                log.warning("%s", warning)
            self._tell_end(RunEnd(outcome, statistics, message))

    def _interrupted(
        self, run: Run | None, time: float
    ) -> tuple[Outcome, str, InterruptedRunError]:
        """Outcome, message and error where Ctrl-C came at ``time`` [s].

        A run that has taken its last step is complete: nothing of its results is missing.
        """
        if run is not None and run.ended is not None:
            return *run.outcome, InterruptedRunError("interrupted behind the last step")
        message = f"interrupted at t={time!r} s"
        error = InterruptedRunError(message, remedy=self.checkpoints.remedy)
        return Outcome.INTERRUPTED, message, error

    def _tell_end(self, end: RunEnd) -> None:
        self.end = end
        self.observer.ended(end)
        if end.outcome.is_complete:
            self.checkpoints.remove()

    def _start(self, outputs: Outputs) -> RunStart:
        """Beginning of the run, as observers are told of it."""
        coupled, settings = self.coupled, self.system.simulation
        discrete, recorded = coupled.discrete, coupled.recorded
        y, d = recorded.split(outputs.y, outputs.d)
        return RunStart(
            (*coupled.output_names, *(one.name for one in recorded.continuous)),
            (*coupled.output_units, *(one.variable.unit for one in recorded.continuous)),
            float(settings.start_time),
            settings.end,
            y[0],
            (*discrete.names, *(one.name for one in recorded.discrete)),
            (
                *map(_discrete_type, discrete.types),
                *(_discrete_type(one.variable.type) for one in recorded.discrete),
            ),
            (*discrete.units, *(one.variable.unit for one in recorded.discrete)),
            d,
            frozenset(one.name for one in (*recorded.continuous, *recorded.discrete)),
            enumerations(coupled),
            output_control(coupled, self.system),
            {part.name: part.description.state_kind for part in coupled.parts},
            self.group.statistics,
        )

    def _run(
        self,
        scheme: CouplingScheme,
        outputs: Outputs,
        statistics: Statistics,
        actions: Actions,
    ) -> Run:
        setup = Setup(self.group, self.coupled, scheme, self.system)
        method, interrupts = method_of(setup), Interrupts()
        grid, start = self.system.simulation.output_grid, setup.start
        results = ResultPoints(grid, self.coupled, scheme.has_derivative, start, outputs)
        with interrupts.deferrable(), ignored_overflow():
            if self.resumed is None:
                position = method.begin(outputs)
            else:
                position, results.memory = self.resumed.place(Position)
                self.coupled.overrides.set(position.overrides)
        journal = Journal(results, self.observer, statistics, interrupts)
        loop = Loop(method, position, journal, self.checkpoints, setup.missing)
        return Run(setup, method, loop, journal, self.checkpoints, actions=actions)

    def _terminate(self, time: float) -> str:
        """Terminate all slaves at the end [s]; the results are complete, whatever they say to it.

        Returns:
            What went wrong in words, which is a warning, too; or "".
        """
        try:
            replies = self.group.execute([(Terminate(),)] * len(self.group), time)
            errors = [reply.error for reply in replies if reply.error is not None]
        except DoublestepError as error:
            errors = [error]
        failures = [str(error) for error in errors]
        for failure in failures:
            log.warning("the run is complete, but: %s", failure)
        return "; ".join(failures)
