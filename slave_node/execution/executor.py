"""Runs programs of calls on one slave: life-cycle check, saved states, errors into replies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from time import perf_counter
from typing import Any

from protocol.calls import (
    Call,
    Configure,
    Describe,
    DeserializeState,
    DoStep,
    Examine,
    ExitInitializationMode,
    FreeState,
    GetDiscreteOutputs,
    GetOutputs,
    GetRecordedVariables,
    GetState,
    Initialize,
    Reply,
    Reset,
    SerializeState,
    SetDiscreteInputs,
    SetInputs,
    SetState,
    SetValues,
    StepResult,
    StepStatus,
    Terminate,
)
from protocol.description import SlaveDescription
from protocol.errors import (
    DoublestepError,
    FatalSlaveError,
    LifeCycleError,
    ModelError,
    SlaveError,
)
from protocol.life_cycle import LIFE_CYCLE, LifeCycleState, refusal
from protocol.slave import Slave
from slave_node.execution.examination import examine
from slave_node.execution.snapshots import SnapshotStore
from slave_node.floating_point import restore_floating_point

_OK = StepStatus.OK

Load = Callable[[Configure], Slave]
"""Loads the model in a configuration; raises `ModelError`."""


class _Mode:
    """A life-cycle state with what to run for each call that it allows, and where that leads."""

    __slots__ = ("allowed", "state")

    def __init__(self, state: LifeCycleState) -> None:
        self.state = state
        self.allowed: dict[type[Call], tuple[Callable[[Any], object], _Mode]] = {}


class Executor:
    """Implements `protocol.slave.CallExecutor` for a slave that it owns.

    Whatever goes wrong in the slave becomes the reply's error, with the call named; the life
    cycle then says what is still possible. Single-threaded.

    Args:
        slave: instantiated.
        load: loads the same model in another configuration; None: it has only this one.
    """

    def __init__(self, slave: Slave, load: Load | None = None) -> None:
        self._load = load
        self._configuration = Configure()
        self._modes = {state: _Mode(state) for state in LifeCycleState}
        self._mode = self._modes[LifeCycleState.INSTANTIATED]
        self._bind(slave)

    def _bind(self, slave: Slave) -> None:
        """Run calls on this slave from here on."""
        self._slave = slave
        self._is_loaded = True
        restore_floating_point()  # loading it may have changed that
        self._snapshots = SnapshotStore(slave)
        save, restore = self._snapshots.save, self._snapshots.restore
        set_inputs, do_step, get_outputs = slave.set_inputs, slave.do_step, slave.get_outputs
        run: Mapping[type[Call], Callable[[Any], object]] = {
            Describe: lambda _: slave.description,
            Configure: self._configure,
            Initialize: self._initialize,
            ExitInitializationMode: lambda _: slave.exit_initialization_mode(),
            Examine: lambda call: examine(slave, call),
            SetInputs: lambda call: set_inputs(call.derivatives),
            SetDiscreteInputs: lambda call: slave.set_discrete_inputs(call.values),
            SetValues: lambda call: slave.set_values(call.values),
            DoStep: lambda call: do_step(
                call.communication_point, call.step_size, call.no_set_state_prior
            ),
            GetOutputs: lambda call: get_outputs(call.order),
            GetDiscreteOutputs: lambda _: slave.get_discrete_outputs(),
            GetRecordedVariables: lambda _: slave.get_recorded_variables(),
            GetState: lambda call: save(call.state),
            SetState: lambda call: restore(call.state, free=call.free),
            FreeState: lambda call: self._snapshots.free(call.state),
            SerializeState: lambda call: self._snapshots.serialize(call.state),
            DeserializeState: lambda call: self._snapshots.deserialize(call.state, call.data),
            Terminate: lambda _: slave.terminate(),
            Reset: self._reset,
        }
        for state, following in LIFE_CYCLE.items():
            for kind, after in following.items():
                self._modes[state].allowed[kind] = (run[kind], self._modes[after])

    @property
    def description(self) -> SlaveDescription:
        """Description of the slave."""
        return self._slave.description

    @property
    def state(self) -> LifeCycleState:
        """Where the slave stands in its life cycle."""
        return self._mode.state

    @property
    def saved_states(self) -> int:
        """Number of states that are saved now."""
        return len(self._snapshots)

    def execute(self, calls: Sequence[Call]) -> Reply:
        """Run the calls in order until one fails or a step is not ``ok``."""
        begin = perf_counter()
        results: list[object] = []
        mode = self._mode
        try:
            for call in calls:
                run, following = mode.allowed[type(call)]
                result = run(call)
                results.append(result)
                if type(result) is StepResult and result.status is not _OK:
                    mode = self._modes[LifeCycleState.STEP_FAILED]
                    break
                mode = following
        except Exception as exception:
            self._mode = mode
            error = self._failed(calls[len(results)], exception)
            warnings = self._slave.take_warnings()
            return Reply(results, error, perf_counter() - begin, warnings)
        finally:
            restore_floating_point()
        self._mode = mode
        return Reply(results, None, perf_counter() - begin, self._slave.take_warnings())

    def close(self) -> None:
        """Free saved states and the slave, whatever they say to it. Idempotent."""
        state = self._mode.state
        self._mode = self._modes[LifeCycleState.FATAL]
        if state is LifeCycleState.FATAL:
            return
        with suppress(Exception):  # of foreign code; the run has its results
            self._snapshots.clear()
            if state in (LifeCycleState.STEP_COMPLETE, LifeCycleState.STEP_FAILED):
                self._slave.terminate()
        self._slave.close()

    def _failed(self, call: Call, exception: Exception) -> DoublestepError:
        if type(call) not in self._mode.allowed:
            error: DoublestepError = refusal(self._mode.state, type(call))
        elif isinstance(exception, DoublestepError):
            error = exception
        else:
            error = SlaveError(f"{type(exception).__name__}: {exception}")
            error.__cause__ = exception
        if isinstance(call, DoStep):
            error.located(time=call.communication_point, step_size=call.step_size)
        if isinstance(error, FatalSlaveError) or not self._is_loaded:
            self._mode = self._modes[LifeCycleState.FATAL]
        elif not isinstance(error, LifeCycleError):
            self._mode = self._modes[LifeCycleState.ERROR]
        return error.located(phase=call.verb)

    def _configure(self, call: Configure) -> SlaveDescription:
        """Replace the slave by one that is loaded as the call says; if there is none, by itself."""
        if call != self._configuration:
            self._load_anew(call)
        return self._slave.description

    def _load_anew(self, configuration: Configure) -> None:
        """Replace the slave; where it cannot be loaded so, by one as it was."""
        if self._load is None:
            raise SlaveError(f"{self._slave.description.model} cannot be loaded anew")
        with suppress(SlaveError):
            self._snapshots.clear()
        self._slave.close()
        self._is_loaded = False
        try:
            self._bind(self._load(configuration))
        except ModelError:
            self._bind(self._load(self._configuration))
            raise
        self._configuration = configuration

    def _initialize(self, call: Initialize) -> None:
        self._slave.record(call.recorded)
        self._slave.initialize(call)

    def _reset(self, call: Reset) -> None:
        if call.loads:
            self._load_anew(self._configuration)
        else:
            self._snapshots.clear()
            self._slave.reset()
