"""`ForkSlave`: the model lives in a process of its own, and a fork of that is a saved state.

To save is to let the holder fork; the copy waits, frozen, for what never comes unless the state is
restored. To restore is to go on with the copy; the process that was the slave before ends then.
Copies make that expensive, so that there are as few as can be, and at the best time:

- A copy is asked for and not waited for, and where habit says that one will be needed, beforehand:
  right behind the step before it, so that it is made while the results are on their way.
- A state that is restored and stays saved gives its copy away. It can still be had, as each state
  that habit says will not be restored at all: by the *trail* from an earlier copy, the *origin*,
  that did not move. Another copy of that does the same again. Trails are short, see `Trail`.
"""

from __future__ import annotations

import json
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
    GetRecordedVariables,
    Initialize,
    ModelWarnings,
    RecordedValues,
    Reset,
    SetDiscreteInputs,
    SetInputs,
    SetValues,
    StepResult,
    Terminate,
)
from protocol.description import SlaveDescription, StateKind
from protocol.errors import (
    FatalSlaveError,
    SlaveCrashedError,
    SlaveError,
    SlaveKilledError,
    StepRejectedError,
)
from protocol.host.log_files import SILENT, LogOutput
from protocol.signals import FloatArray
from protocol.slave import Slave
from protocol.variables import StartValue
from protocol.wire.programs import encode_program
from protocol.wire.records import encode_map
from protocol.wire.replies import decode_reply
from slave_node.states.channel import DURATION, Message
from slave_node.states.fork_family import HolderFamily
from slave_node.states.fork_habits import Event, Habits, Situation
from slave_node.states.fork_trail import START, Task, Trail
from slave_node.states.held_process import HeldProcess, refusal
from slave_node.states.repeating import RepeatingPart
from slave_node.states.step_message import decode_stepped, encode_step
from slave_node.states.warnings_file import WarningsFile

_CLOSE_TIME = 0.5


@dataclass(frozen=True, slots=True)
class HeldModel:
    """Model that a holder loads: the arguments of `slave_node.loading.load_model`."""

    model: str
    base: Path
    name: str
    scratch: Path
    output: LogOutput = SILENT
    configuration: Configure = field(default_factory=Configure)


@dataclass(slots=True, eq=False)
class _State:
    """A saved state.

    Attributes:
        situation: in which it was saved.
        origin: a process that stands still as long as a state has it for its origin.
        trail: from there to the state.
        copy: a process that stands at the state; ``origin`` may be one too.
        is_used: whether it was restored, ever.
    """

    situation: Situation
    origin: HeldProcess
    trail: Trail
    copy: HeldProcess | None = None
    is_used: bool = False


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
        self._saved: set[_State] = set()
        self._habits = Habits()
        self._recorded_names: tuple[str, ...] = ()
        self._warnings = WarningsFile(model.scratch / "warnings")
        self._load()

    def _load(self) -> None:
        """Start with a new family; there is none."""
        self._family = HolderFamily(RepeatingPart(self._model.configuration.not_repeating))
        self._active: HeldProcess | None = HeldProcess(
            self._family, self._family.first, self._family.first_process
        )
        self._origin: HeldProcess | None = None
        self._trail: Trail | None = None
        self._ahead: HeldProcess | None = None
        self._latest: _State | None = None
        self._unconfirmed: list[HeldProcess] = []
        self._has_forked = False
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
                "output": json.dumps(model.output._replace(warnings=str(self._warnings.path))),
                "configuration": encode_program([model.configuration]),
            }
        )
        _, answer = self._exchange(Message.LOAD, message)
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

    def _holder(self) -> HeldProcess:
        if self._active is None:
            raise SlaveKilledError(
                "the process that held the model is gone",
                remedy="restore a saved state, or reset the slave",
            )
        return self._active

    def _exchange(
        self, kind: Message, payload: bytes, *, copy_behind: bool = False
    ) -> tuple[Message, bytes]:
        """Answer of the holder; with ``copy_behind`` it then makes a copy.

        Raises:
            SlaveCrashedError: it died of that.
            SlaveKilledError: it died of something else, or nothing tells of what.
        """
        holder = self._holder()
        try:
            try:
                holder.send(kind, payload)
            except OSError:
                raise holder.loss() from None
            try:
                if copy_behind:
                    self._ahead = holder.copy()
                return holder.receive()
            except (EOFError, OSError):
                raise holder.death() from None
        except BaseException:  # also Ctrl-C: its answer would have no reader
            self._drop_active()
            raise

    def _ask(self, kind: Message, payload: bytes) -> tuple[Message, bytes]:
        """Let the holder do something, and prepare what is likely to come after it.

        Raises:
            SlaveCrashedError: as `_exchange`.
            SlaveError: a state that was to be saved before could not be.
        """
        self._drop_ahead()
        self._habits.note(Event.STEP if kind is Message.STEP else Event.RUN, len(self._saved))
        expected = self._habits.expected
        if expected is Event.RESTORE or self._is_latest_for_restores():
            self._prepare_latest()
        copy_behind = expected is Event.SAVE and self._needs_copy()
        trail, self._trail = self._trail, None
        answer_kind, answer = self._exchange(kind, payload, copy_behind=copy_behind)
        self._confirm()
        if answer_kind is Message.DONE:
            (duration,) = DURATION.unpack_from(answer)
            answer = answer[DURATION.size :]
            if trail is not None:
                part = self._family.repeating.of(kind, payload, answer)
                self._trail = trail.after(Task(kind, payload, part), duration)
        return answer_kind, answer

    def _drop_active(self) -> None:
        """Let the process that is the slave end, unless it has already."""
        self._drop_ahead()
        if self._active is not None:
            self._active.close()
            self._active = None

    def _drop_ahead(self) -> None:
        """The slave does not stand any more where its copy was made."""
        if self._ahead is not None:
            self._ahead.close()
            self._ahead = None

    def _confirm(self) -> None:
        """After an answer: copies that were asked for before would have been refused by now.

        Raises:
            SlaveError: one was.
        """
        copies, self._unconfirmed = self._unconfirmed, []
        for copy in copies:
            if copy.wait(0.0):
                with suppress(SlaveCrashedError):  # that matters if it is ever restored
                    copy.meet()

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

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        self._family.repeating.bind(experiment.outputs, experiment.discrete_outputs)
        self._run(replace(experiment, recorded=self._recorded_names))

    def record(self, names: Sequence[str]) -> None:
        """See `Slave`; the holder hears of it with `initialize`."""
        self._recorded_names = tuple(names)

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

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """See `Slave`; what the model says to them comes at once."""
        self._run(SetValues(dict(values)))

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`. A model that dies, or says fmi2Fatal, took only its process with it.

        Raises:
            StepRejectedError: also then, if there is a saved state to go back to.
            FatalSlaveError: if there is none.
            SlaveKilledError: its process died, and not known to be by the step.
        """
        step = DoStep(communication_point, step_size, no_set_state_prior)
        try:
            return self._step(step)
        except SlaveKilledError:
            self._drop_active()
            raise
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
            raise refusal(answer)
        result, self._outputs = decode_stepped(answer, order)
        return result

    def _fallen(self, error: SlaveError) -> SlaveError:
        """Error for the caller of a step that ended the model."""
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

    def get_recorded_variables(self) -> RecordedValues:
        """See `Slave`."""
        values, *_ = self._run(GetRecordedVariables())
        assert isinstance(values, RecordedValues)
        return values

    def take_warnings(self) -> ModelWarnings:
        """See `Slave`."""
        return self._warnings.take()

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
            with suppress(OSError, SlaveError):  # it died of that, or never was there
                self._active.send(Message.CLOSE)
                if self._active.wait(_CLOSE_TIME):
                    self._active.meet()
                    self._active.wait(_CLOSE_TIME)
        self._end()

    def _end(self) -> None:
        self._free_all()
        self._drop_active()
        self._family.close()
        self._warnings.close()

    # ---- Saved states -------------------------------------------------------------------------

    def get_state(self) -> object:
        """See `Slave`.

        Raises:
            SlaveError: the process cannot be forked, with the reason. If it could before, that
                comes with the next call.
        """
        if self._pending:
            self._run()
        holder = self._holder()
        situation, needs_copy = self._habits.situation, self._needs_copy()
        self._habits.note(Event.SAVE, len(self._saved))
        copy = self._copy_of_active(holder) if needs_copy else None
        if self._origin is None or self._trail is None:
            assert copy is not None
            self._origin, self._trail, copy = copy, START, None
        state = _State(situation, self._origin, self._trail, copy)
        self._saved.add(state)
        self._latest = state
        return state

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        saved = self._state(state)
        self._habits.note(Event.RESTORE, len(self._saved))
        self._note_use(saved, Event.RESTORE)
        copy = self._take_copy(saved)
        self._latest = saved
        self._go_on_with(copy, saved)

    def set_state_and_free(self, state: object) -> None:
        """See `Slave`. Needs no fork where no other state has this one for its origin."""
        saved = self._state(state)
        self._habits.note(Event.GIVE_UP, len(self._saved))
        is_last = self._is_last_of_origin(saved)
        self._note_use(saved, Event.GIVE_UP)
        if is_last and not saved.trail.tasks:
            self._saved.discard(saved)
            self._go_on_with(saved.origin, None)
            if saved.copy is not None:
                self._end_process(saved.copy)
        else:
            self._go_on_with(self._take_copy(saved), saved)
            self._free(saved)

    def free_state(self, state: object) -> None:
        """See `Slave`."""
        self._free(self._state(state))

    def serialize_state(self, state: object) -> bytes:  # noqa: ARG002
        """See `Slave`: a process cannot be put into bytes."""
        raise SlaveError(f"a saved state of {self.description.model} is a process, not bytes")

    def deserialize_state(self, data: bytes) -> object:  # noqa: ARG002
        """See `serialize_state`."""
        raise SlaveError(f"a saved state of {self.description.model} is a process, not bytes")

    def _state(self, state: object) -> _State:
        if not isinstance(state, _State) or state not in self._saved:
            raise SlaveError("no such state is saved")
        return state

    # ---- Copies -------------------------------------------------------------------------------

    def _needs_copy(self) -> bool:
        """True if a state that is saved here needs a process of its own."""
        return self._trail is None or self._habits.use(self._habits.situation) is not None

    def _copy_of_active(self, holder: HeldProcess) -> HeldProcess:
        """The one that was made ahead, or a new one; waited for only if there was none before."""
        copy, self._ahead = self._ahead, None
        try:
            copy = copy or holder.copy()
        except OSError:
            try:
                raise holder.loss() from None
            finally:
                self._drop_active()
        if self._has_forked:
            self._unconfirmed.append(copy)
        else:
            _meet(copy)
            self._has_forked = True
        return copy

    def _prepare_latest(self) -> None:
        """A copy of the state that was saved or restored last is likely to be needed."""
        state = self._latest
        if state in self._saved and state is not None and state.copy is None:
            with suppress(OSError):  # it is dead: whoever restores the state will see
                state.copy = _copy_from_origin(state)

    def _take_copy(self, state: _State) -> HeldProcess:
        """A process that stands at the state, or is on its way there if it was made ahead.

        Raises:
            SlaveError: there is none, as `HeldProcess.meet` says.
        """
        copy, state.copy = state.copy, None
        if copy is not None:  # whether it is there will be seen when it is asked
            return copy
        try:
            copy = _copy_from_origin(state)
        except OSError:
            raise state.origin.loss() from None
        _meet(copy)
        return copy

    def _note_use(self, state: _State, use: Event | None) -> None:
        """The first use counts."""
        if not state.is_used:
            state.is_used = True
            self._habits.note_use(state.situation, use)

    def _is_latest_for_restores(self) -> bool:
        """True if the state saved last, and not yet used, is likely to be restored and kept."""
        state = self._latest
        return (
            state is not None
            and not state.is_used
            and self._habits.use(state.situation) is Event.RESTORE
        )

    def _go_on_with(self, holder: HeldProcess, state: _State | None) -> None:
        """``state``: at which it stands, if there is still such a state."""
        self._drop_active()
        if holder in self._unconfirmed:
            self._unconfirmed.remove(holder)
        self._active = holder
        self._origin = state.origin if state is not None else None
        self._trail = state.trail if state is not None else None
        self._pending = []
        self._outputs = self._discrete_outputs = None

    def _free(self, state: _State) -> None:
        self._saved.discard(state)
        self._note_use(state, None)
        if state.copy is not None:
            self._end_process(state.copy)
        if self._is_last_of_origin(state):
            self._end_process(state.origin)
            if self._origin is state.origin:
                self._origin = self._trail = None

    def _is_last_of_origin(self, state: _State) -> bool:
        """True if no other saved state has the origin of this one."""
        return not any(o is not state and o.origin is state.origin for o in self._saved)

    def _end_process(self, holder: HeldProcess) -> None:
        if holder in self._unconfirmed:
            self._unconfirmed.remove(holder)
        holder.close()

    def _free_all(self) -> None:
        for state in tuple(self._saved):
            self._free(state)


def _copy_from_origin(state: _State) -> HeldProcess:
    """A process on its way to the state.

    Raises:
        OSError: its origin is gone.
    """
    copy = state.origin.copy()
    with suppress(OSError):  # `meet` will say so
        copy.follow(state.trail)
    return copy


def _meet(copy: HeldProcess) -> None:
    """`HeldProcess.meet`, for one that no other process knows."""
    try:
        copy.meet()
    except BaseException:
        copy.close()
        raise
