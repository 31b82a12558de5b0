"""Runs programs of calls on one slave: life-cycle check, saved states, errors into replies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from time import perf_counter
from typing import Any

from protocol.calls import (
    Call,
    Describe,
    DeserializeState,
    DoStep,
    ExitInitializationMode,
    FreeState,
    GetOutputs,
    GetState,
    Initialize,
    Reply,
    Reset,
    SerializeState,
    SetInputs,
    SetState,
    StepResult,
    Terminate,
)
from protocol.errors import DoublestepError, FatalSlaveError, LifeCycleError, SlaveError
from protocol.life_cycle import LIFE_CYCLE, LifeCycleState, next_state
from protocol.slave import Slave, SlaveDescription, StepStatus
from slave_node.snapshots import SnapshotStore


class Executor:
    """Implements `protocol.slave.CallExecutor` for a slave that it owns.

    Whatever goes wrong in the slave becomes the reply's error, with the call named; the life
    cycle then says what is still possible. Single-threaded.
    """

    def __init__(self, slave: Slave) -> None:
        self._slave = slave
        self._snapshots = SnapshotStore(slave)
        self._state = LifeCycleState.INSTANTIATED
        self._run: Mapping[type[Call], Callable[[Any], object]] = {
            Describe: lambda _: slave.description,
            Initialize: self._initialize,
            ExitInitializationMode: lambda _: slave.exit_initialization_mode(),
            SetInputs: lambda call: slave.set_inputs(call.derivatives),
            DoStep: self._do_step,
            GetOutputs: lambda call: slave.get_outputs(call.order),
            GetState: lambda call: self._snapshots.save(call.state),
            SetState: lambda call: self._snapshots.restore(call.state),
            FreeState: lambda call: self._snapshots.free(call.state),
            SerializeState: lambda call: self._snapshots.serialize(call.state),
            DeserializeState: lambda call: self._snapshots.deserialize(call.state, call.data),
            Terminate: lambda _: slave.terminate(),
            Reset: self._reset,
        }

    @property
    def description(self) -> SlaveDescription:
        """Of the slave."""
        return self._slave.description

    @property
    def state(self) -> LifeCycleState:
        """Where the slave stands in its life cycle."""
        return self._state

    @property
    def saved_states(self) -> int:
        """How many states are saved now."""
        return len(self._snapshots)

    def execute(self, calls: Sequence[Call]) -> Reply:
        """Run the calls in order until one fails or a step is not ``ok``."""
        begin = perf_counter()
        results: list[object] = []
        error: DoublestepError | None = None
        run = self._run
        for call in calls:
            kind = type(call)
            following = LIFE_CYCLE[self._state].get(kind)
            try:
                if following is None:
                    next_state(self._state, kind)  # raises, with the words for it
                result = run[kind](call)
            except Exception as exception:
                error = self._failed(call, exception)
                break
            results.append(result)
            if kind is DoStep and result.status is not StepStatus.OK:  # type: ignore[attr-defined]
                self._state = LifeCycleState.STEP_FAILED
                break
            self._state = following  # type: ignore[assignment]
        return Reply(results, error, perf_counter() - begin)

    def close(self) -> None:
        """Free saved states and the slave, whatever they say to it. Idempotent."""
        state, self._state = self._state, LifeCycleState.FATAL
        if state is LifeCycleState.FATAL:
            return
        with suppress(DoublestepError):
            self._snapshots.clear()
            if state in (LifeCycleState.STEP_COMPLETE, LifeCycleState.STEP_FAILED):
                self._slave.terminate()
        self._slave.close()

    def _failed(self, call: Call, exception: Exception) -> DoublestepError:
        if isinstance(exception, DoublestepError):
            error = exception
        else:
            error = SlaveError(f"{type(exception).__name__}: {exception}")
            error.__cause__ = exception
        if isinstance(call, DoStep):
            error.located(time=call.communication_point, step_size=call.step_size)
        if isinstance(error, FatalSlaveError):
            self._state = LifeCycleState.FATAL
        elif not isinstance(error, LifeCycleError):
            self._state = LifeCycleState.ERROR
        return error.located(phase=call.verb)

    def _initialize(self, call: Initialize) -> None:
        self._slave.initialize(
            start_time=call.start_time,
            stop_time=call.stop_time,
            relative_tolerance=call.relative_tolerance,
            start_values=call.start_values,
            inputs=call.inputs,
            outputs=call.outputs,
        )

    def _do_step(self, call: DoStep) -> StepResult:
        return StepResult(
            *self._slave.do_step(call.communication_point, call.step_size, call.no_set_state_prior)
        )

    def _reset(self, _: Reset) -> None:
        self._snapshots.clear()
        self._slave.reset()
