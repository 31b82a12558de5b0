"""`ForkSlave`: the model lives in a process of its own, and a fork of that is a saved state.

To save is to let the holder fork; the copy waits, frozen, for what never comes unless the state is
restored. To restore is to go on with the copy: with the copy itself if the state is given up with
that, else with a fork of it. The process that was the slave before ends then.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path

from protocol.calls import (
    Call,
    Configure,
    Describe,
    DoStep,
    ExitInitializationMode,
    GetDiscreteOutputs,
    GetOutputs,
    Initialize,
    Reset,
    SetDiscreteInputs,
    SetInputs,
    StepResult,
    Terminate,
)
from protocol.codec import decode_reply, encode_map, encode_program
from protocol.errors import (
    DoublestepError,
    FatalSlaveError,
    SlaveCrashedError,
    SlaveError,
    StepRejectedError,
)
from protocol.signals import FloatArray
from protocol.slave import Slave, SlaveDescription, StartValue, StateKind
from slave_node.states.channel import PROCESS, Channel, Message
from slave_node.states.fork_family import HolderFamily
from slave_node.states.step_message import decode_stepped, encode_step

_CLOSE_TIME = 0.5


@dataclass(frozen=True, slots=True)
class HeldModel:
    """What a holder loads: the arguments of `slave_node.loading.load_model`."""

    model: str
    base: Path
    name: str
    scratch: Path
    log_all: bool = False
    configuration: Configure = field(default_factory=Configure)


@dataclass(frozen=True, slots=True, eq=False)
class _Holder:
    """A process that holds the model: the slave itself, or a saved state."""

    channel: Channel
    process: int


class ForkSlave(Slave):
    """A slave whose model another process holds.

    Inputs travel with the step that they are for, and a step brings back the outputs that were
    read after the one before: a step is one message and one answer.

    Args:
        model: what to hold.
        reason: why the state is not saved natively.

    Raises:
        ModelError: the model cannot be loaded.
        SlaveCrashedError: its process died while loading.
    """

    def __init__(self, model: HeldModel, reason: str) -> None:
        self._model = model
        self._reason = reason
        self._loads = count()
        self._saved: set[_Holder] = set()
        self._load()

    def _load(self) -> None:
        """Start with a new family; there is none."""
        self._family = HolderFamily()
        self._active: _Holder | None = _Holder(self._family.first, self._family.first_process)
        self._forget()
        try:
            self.description = self._describe()
        except BaseException:
            self._end()
            raise

    def _describe(self) -> SlaveDescription:
        model = self._model
        scratch = model.scratch / f"holder-{next(self._loads)}"
        scratch.mkdir()
        message = encode_map(
            {
                "model": model.model,
                "base": str(model.base),
                "name": model.name,
                "scratch": str(scratch),
                "log_all": model.log_all,
                "configuration": encode_program([model.configuration]),
            }
        )
        _, answer = self._ask(Message.LOAD, message)
        reply = decode_reply([Describe()], answer)
        if reply.error is not None:
            raise reply.error
        (description,) = reply.results
        assert isinstance(description, SlaveDescription)
        return replace(description, state_kind=StateKind.FORK, state_reason=self._reason)

    def _forget(self) -> None:
        """Nothing is under way: no inputs wait for a step, no outputs were brought back."""
        self._pending: list[Call] = []
        self._order: int | None = None
        self._outputs: FloatArray | None = None
        self._discrete_outputs: tuple[StartValue, ...] | None = None

    # ---- Calls to the holder ------------------------------------------------------------------

    def _holder(self) -> _Holder:
        if self._active is None:
            raise SlaveCrashedError(
                "the process that held the model is gone",
                remedy="restore a saved state, or reset the slave",
            )
        return self._active

    def _ask(self, kind: Message, payload: bytes) -> tuple[Message, bytes]:
        """What the holder answers.

        Raises:
            SlaveCrashedError: it died.
        """
        holder = self._holder()
        try:
            holder.channel.send(kind, payload)
            return holder.channel.receive()
        except (EOFError, OSError):
            self._drop_active()
            raise self._died(holder) from None
        except BaseException:  # Ctrl-C: what it answers would be for nobody
            self._drop_active()
            raise

    def _drop_active(self) -> None:
        """Let the process that is the slave end, unless it has already."""
        if self._active is not None:
            self._active.channel.close()
            self._active = None

    def _died(self, holder: _Holder) -> SlaveCrashedError:
        return SlaveCrashedError(
            f"the process that held the model {self._family.death(holder.process)}"
        )

    def _run(self, *calls: Call) -> list[object]:
        """Results of ``calls``, after those that were put off.

        Raises:
            DoublestepError: one of them failed.
        """
        pending, self._pending = self._pending, []
        program = [*pending, *calls]
        self._outputs = self._discrete_outputs = None
        _, answer = self._ask(Message.PROGRAM, encode_program(program))
        reply = decode_reply(program, answer)
        if reply.error is not None:
            raise reply.error
        return reply.results[len(pending) :]

    # ---- Slave --------------------------------------------------------------------------------

    def initialize(
        self,
        *,
        start_time: float,
        stop_time: float | None,
        relative_tolerance: float | None,
        start_values: Mapping[str, StartValue],
        inputs: Sequence[str],
        outputs: Sequence[str],
        discrete_inputs: Sequence[str] = (),
        discrete_outputs: Sequence[str] = (),
        early_return: bool = False,
    ) -> None:
        """See `Slave`."""
        self._run(
            Initialize(
                start_time,
                stop_time,
                relative_tolerance,
                dict(start_values),
                tuple(inputs),
                tuple(outputs),
                tuple(discrete_inputs),
                tuple(discrete_outputs),
                early_return,
            )
        )

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""
        self._run(ExitInitializationMode())

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`; what the model says to them comes with the next call."""
        self._pending.append(SetInputs(derivatives.copy()))
        self._outputs = self._discrete_outputs = None

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`; as `set_inputs`."""
        self._pending.append(SetDiscreteInputs(tuple(values)))
        self._outputs = self._discrete_outputs = None

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`. A model that dies, or says fmi2Fatal, took only its process with it.

        Raises:
            StepRejectedError: also then, if there is a saved state to go back to.
            FatalSlaveError: if there is none.
        """
        step = DoStep(communication_point, step_size, no_set_state_prior)
        try:
            return self._step(step)
        except (SlaveCrashedError, FatalSlaveError) as error:
            raise self._fallen(error) from None

    def _step(self, step: DoStep) -> StepResult:
        """Take it, after the inputs that were put off, and bring back outputs."""
        self._outputs = self._discrete_outputs = None
        inputs: FloatArray | None = None
        match self._pending:
            case []:
                pass
            case [SetInputs(derivatives=inputs)]:
                self._pending = []
            case _:
                self._run()
        order = self._order
        kind, answer = self._ask(Message.STEP, encode_step(inputs, step, order))
        if kind is not Message.DONE:
            raise _refusal(answer)
        result, self._outputs = decode_stepped(answer, order)
        return result

    def _fallen(self, error: SlaveError) -> SlaveError:
        """What a step that ended the model means for the caller."""
        self._drop_active()  # it must not be called any more
        kind = StepRejectedError if self._saved else FatalSlaveError
        return kind(error.cause, remedy=error.remedy)

    def get_outputs(self, order: int) -> FloatArray:
        """See `Slave`."""
        if self._outputs is None or order != self._order:
            self._order = order
            self._outputs, *_ = self._run(GetOutputs(order))  # type: ignore[assignment]
        assert self._outputs is not None
        return self._outputs

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        """See `Slave`."""
        if self._discrete_outputs is None:
            self._discrete_outputs, *_ = self._run(GetDiscreteOutputs())  # type: ignore[assignment]
        assert self._discrete_outputs is not None
        return self._discrete_outputs

    def terminate(self) -> None:
        """See `Slave`."""
        self._run(Terminate())

    def reset(self) -> None:
        """See `Slave`. A model that died is loaded anew."""
        self._free_all()
        self._forget()
        if self._active is None:
            self._family.close()
            self._load()
        else:
            self._run(Reset())

    def close(self) -> None:
        """See `Slave`. Ends all processes."""
        if self._active is not None:
            with suppress(OSError):  # it died of that
                self._active.channel.send(Message.CLOSE)
                self._active.channel.wait(_CLOSE_TIME)
        self._end()

    def _end(self) -> None:
        self._free_all()
        self._drop_active()
        self._family.close()

    # ---- Saved states -------------------------------------------------------------------------

    def get_state(self) -> object:
        """See `Slave`.

        Raises:
            SlaveError: the process cannot be forked, with the reason.
        """
        if self._pending:
            self._run()
        state = self._fork(self._holder())
        self._saved.add(state)
        return state

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        self._go_on_with(self._fork(self._state(state)))

    def set_state_and_free(self, state: object) -> None:
        """See `Slave`. Needs no fork."""
        holder = self._state(state)
        self._saved.discard(holder)
        self._go_on_with(holder)

    def free_state(self, state: object) -> None:
        """See `Slave`."""
        holder = self._state(state)
        self._saved.discard(holder)
        holder.channel.close()

    def serialize_state(self, state: object) -> bytes:  # noqa: ARG002
        """See `Slave`: a process cannot be put into bytes."""
        raise SlaveError(f"a saved state of {self.description.model} is a process, not bytes")

    def deserialize_state(self, data: bytes) -> object:  # noqa: ARG002
        """See `serialize_state`."""
        raise SlaveError(f"a saved state of {self.description.model} is a process, not bytes")

    def _state(self, state: object) -> _Holder:
        if not isinstance(state, _Holder) or state not in self._saved:
            raise SlaveError("no such state is saved")
        return state

    def _fork(self, holder: _Holder) -> _Holder:
        """A copy of a holder, as it stands.

        Raises:
            SlaveCrashedError: it is dead.
            SlaveError: it cannot be forked.
        """
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                holder.channel.send(Message.FORK)
                holder.channel.send_socket(theirs)
                kind, answer = holder.channel.receive()
            except (EOFError, OSError):
                ours.close()
                if holder is self._active:
                    self._drop_active()
                raise self._died(holder) from None
        if kind is not Message.DONE:
            ours.close()
            raise _refusal(answer)
        return _Holder(self._family.channel(ours), *PROCESS.unpack(answer))

    def _go_on_with(self, holder: _Holder) -> None:
        self._drop_active()
        self._active = holder
        self._pending = []
        self._outputs = self._discrete_outputs = None

    def _free_all(self) -> None:
        for holder in self._saved:
            holder.channel.close()
        self._saved.clear()


def _refusal(answer: bytes) -> DoublestepError:
    """The error in an answer that is not `Message.DONE`."""
    error = decode_reply([], answer).error
    assert error is not None
    return error
