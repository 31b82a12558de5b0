"""`ReplaySlave`: going back is doing everything again, from the start.

For hosts without fork, and models that must not be forked. It needs a model that repeats: the same
calls lead to the same state. A restore costs as much as all steps before it, so that a run costs
the square of its length; the record of the past takes one byte for each call and eight for each
number in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

from protocol.calls import (
    Call,
    DoStep,
    ExitInitializationMode,
    GetDiscreteOutputs,
    GetOutputs,
    GetRecordedVariables,
    Initialize,
    RecordedValues,
    SetDiscreteInputs,
    SetInputs,
    SetValues,
    StepResult,
    StepStatus,
)
from protocol.description import StateKind
from protocol.errors import SlaveError
from protocol.signals import FloatArray
from protocol.slave import Slave
from protocol.variables import StartValue
from slave_node.execution.executor import Executor
from slave_node.states.call_record import CallRecord
from slave_node.wrapped_slave import WrappedSlave

REMARK = "a restored state is computed anew from the start time: its cost grows with the time"
_CALLS_AT_ONCE = 1000


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A saved state: how many calls of a record lead to it."""

    record: CallRecord
    length: int


class ReplaySlave(WrappedSlave):
    """A slave around another one, whose calls it remembers.

    Args:
        load: makes the slave; made anew where it cannot be reset.
        reason: why the state is not saved natively.

    Raises:
        ModelError: what ``load`` raises.
    """

    def __init__(self, load: Callable[[], Slave], reason: str) -> None:
        super().__init__(load())
        self._load = load
        described = self._slave.description
        self.description = replace(
            described,
            state_kind=StateKind.REPLAY,
            state_reason=reason,
            remarks=(*described.remarks, REMARK),
        )
        self._record = CallRecord(Initialize())
        self._recorded: tuple[str, ...] = ()

    # ---- Calls that lead to a state -----------------------------------------------------------

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        self._slave.initialize(experiment)
        self._record = CallRecord(replace(experiment, recorded=self._recorded))

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""
        self._slave.exit_initialization_mode()
        self._record.add(ExitInitializationMode())

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`."""
        self._slave.set_inputs(derivatives)
        self._record.add(SetInputs(derivatives))

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`."""
        self._slave.set_discrete_inputs(values)
        self._record.add(SetDiscreteInputs(tuple(values)))

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """See `Slave`."""
        self._slave.set_values(values)
        self._record.add(SetValues(dict(values)))

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`."""
        result = self._slave.do_step(communication_point, step_size, no_set_state_prior)
        if result.status is StepStatus.OK:  # after any other no state is saved
            self._record.add(DoStep(communication_point, step_size, no_set_state_prior))
        return result

    def get_outputs(self, order: int) -> FloatArray:
        """See `Slave`. Recorded too: to read can start a computation that leaves its traces."""
        outputs = self._slave.get_outputs(order)
        self._record.add(GetOutputs(order))
        return outputs

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        """See `Slave`; as `get_outputs`."""
        outputs = self._slave.get_discrete_outputs()
        self._record.add(GetDiscreteOutputs())
        return outputs

    def record(self, names: Sequence[str]) -> None:
        """See `Slave`."""
        self._slave.record(names)
        self._recorded = tuple(names)

    def get_recorded_variables(self) -> RecordedValues:
        """See `Slave`; as `get_outputs`."""
        values = self._slave.get_recorded_variables()
        self._record.add(GetRecordedVariables())
        return values

    # ---- Saved states -------------------------------------------------------------------------

    def get_state(self) -> object:
        """See `Slave`: costs nothing."""
        return _Place(self._record, len(self._record))

    def set_state(self, state: object) -> None:
        """See `Slave`: costs all steps since the start time.

        Raises:
            SlaveError: a step does not end as it ended before.
        """
        if not isinstance(state, _Place):
            raise SlaveError("no such state is saved")
        record = state.record.copy(state.length)
        self._restart()
        executor = Executor(self._slave)
        calls = record.calls()
        while some := list(islice(calls, _CALLS_AT_ONCE)):
            results, error, *_ = executor.execute(some)
            if error is not None:
                raise _did_not_repeat(some[len(results)], error.cause)
            last = results[-1]
            if isinstance(last, StepResult) and last.status is not StepStatus.OK:
                raise _did_not_repeat(some[len(results) - 1], str(last.status))
        self._record = record

    def free_state(self, state: object) -> None:
        """See `Slave`: the record goes with its last state."""

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`: the calls that lead to the state."""
        if not isinstance(state, _Place):
            raise SlaveError("no such state is saved")
        return state.record.copy(state.length).to_bytes()

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`."""
        record = CallRecord.from_bytes(data)
        return _Place(record, len(record))

    def _restart(self) -> None:
        """Back to the state after instantiation, by reset or, where that fails, by loading."""
        try:
            self._slave.reset()
        except SlaveError:
            self._slave.close()
            self._slave = self._load()

    # ---- Ends ---------------------------------------------------------------------------------

    def reset(self) -> None:
        """See `Slave`."""
        self._restart()
        self._record = CallRecord(Initialize())


def _did_not_repeat(call: Call, how: str) -> SlaveError:
    where = f" from {call.communication_point!r} s" if isinstance(call, DoStep) else ""
    return SlaveError(
        f"the model does not repeat: {call.verb}{where}, which succeeded before, ended with {how}",
        remedy='choose another way to save its state: state = "fork" or state = "none"',
    )
