"""The calls that made a slave what it is: executed again on a fresh one, they make the same.

What a slave went back from has left no trace in it, so it is not kept: of rejected steps and
comparison solutions only the saving and restoring around them is. The rest is cut into steps, one
for each communication point from which the run does not go back any more. From time to time a
saved state takes the place of all steps before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from struct import Struct
from typing import NamedTuple

import numpy as np

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
    GetState,
    Initialize,
    Reset,
    SerializeState,
    SetInputs,
    SetState,
    StepStatus,
)
from protocol.wire.programs import MAX_CALLS, decode_program, encode_program

_DIGEST_SIZE = 8
_LENGTH = Struct("<I")
_WITHOUT_TRACE = frozenset((Describe, Examine, SerializeState, DeserializeState))
_OF_STEPS = frozenset((SetInputs, DoStep, GetOutputs, GetDiscreteOutputs))
_OF_STATES = frozenset((GetState, SetState, FreeState))

KEPT_STEPS = 10_000
"""About 10 MB for each slave."""

Calls = tuple[Call, ...]


class LoggedStep(NamedTuple):
    """Step of a slave from one communication point to the next.

    Attributes:
        calls: in order.
        digest: of the outputs that it gave; empty when it gave none.
    """

    calls: Calls
    digest: bytes

    def to_bytes(self) -> bytes:
        """For files: the digest, then programs of the protocol, each after its length."""
        cuts = range(0, len(self.calls), MAX_CALLS)
        programs = [encode_program(self.calls[cut : cut + MAX_CALLS]) for cut in cuts]
        parts = [bytes([len(self.digest)]), self.digest]
        for program in programs:
            parts += (_LENGTH.pack(len(program)), program)
        return b"".join(parts)

    @staticmethod
    def from_bytes(data: bytes) -> LoggedStep:
        """The step that `to_bytes` described.

        Raises:
            MalformedMessageError, ValueError: it is none.
        """
        at = 1 + data[0]
        digest = data[1:at]
        calls: list[Call] = []
        while at < len(data):
            end = at + _LENGTH.size
            if end > len(data):
                raise ValueError("a step that is cut off")
            (length,) = _LENGTH.unpack(data[at:end])
            calls += decode_program(data[end : end + length])
            at = end + length
        return LoggedStep(tuple(calls), digest)


class SavedState(NamedTuple):
    """A serialised state.

    Attributes:
        data: of ``fmi2SerializeFMUstate``.
        number: of steps before it.
    """

    data: bytes
    number: int


@dataclass(frozen=True)
class _Kept:
    """The steps from number ``first`` on, and a state among them; replaced as a whole.

    Attributes:
        first: number of the step ``steps[0]``.
        steps: grow at the end; as bytes where there is no state that could replace them.
        state: after which at least one step is kept.
    """

    first: int = 0
    steps: list[LoggedStep | bytes] = field(default_factory=list)
    state: SavedState | None = None


class CallLog:
    """Log of the calls of one slave, as far as they still matter.

    Args:
        is_compact: keep steps as bytes, a third of the memory, at the price of encoding each.
        kept_steps: steps before a saved state that are kept until that state has been of use.
    """

    def __init__(self, *, is_compact: bool = False, kept_steps: int = KEPT_STEPS) -> None:
        self._is_compact = is_compact
        self._kept_steps = kept_steps
        self._beginning: list[Call] = []
        self._is_running = False
        self._present: list[Call] = []
        self._outputs: list[object] = []
        self._marks: dict[int, tuple[int, int]] = {}
        self._kept = _Kept()
        self._candidate: SavedState | None = None
        self._not_repeating: frozenset[str] = frozenset()
        self._columns: list[int] = []
        self._others: frozenset[int] = frozenset()

    @property
    def is_running(self) -> bool:
        """True if the slave has left initialization mode."""
        return self._is_running

    @property
    def number(self) -> int:
        """Number of all steps."""
        return self._kept.first + len(self._kept.steps)

    @property
    def is_complete(self) -> bool:
        """True if all steps since T_0 are kept."""
        return self._kept.first == 0

    @property
    def beginning(self) -> Calls:
        """The calls up to T_0."""
        return tuple(self._beginning)

    @property
    def present(self) -> LoggedStep:
        """Calls since the last step that is kept."""
        return LoggedStep(tuple(self._present), self.digest(self._outputs))

    @property
    def state(self) -> SavedState | None:
        """The state to begin with, if there is one."""
        return self._kept.state

    @property
    def first(self) -> int:
        """Number of the first step that is kept."""
        return self._kept.first

    def digest(self, outputs: Sequence[object]) -> bytes:
        """A short hash of outputs, bit for bit; empty without any.

        Those that are known not to repeat do not count.
        """
        if not outputs:
            return b""
        hash_ = blake2b(digest_size=_DIGEST_SIZE)
        for values in outputs:
            if isinstance(values, np.ndarray):
                kept = np.delete(values, self._columns, axis=1) if self._columns else values
                hash_.update(kept.tobytes())
            else:
                assert isinstance(values, tuple)
                others = [value for i, value in enumerate(values) if i not in self._others]
                hash_.update(repr(tuple(others)).encode())
        return hash_.digest()

    def steps(self, begin: int, end: int | None = None) -> Iterator[LoggedStep]:
        """Those with numbers from ``begin`` on, up to ``end``."""
        kept = self._kept
        stop = len(kept.steps) if end is None else end - kept.first
        for index in range(begin - kept.first, stop):
            step = kept.steps[index]
            yield LoggedStep.from_bytes(step) if isinstance(step, bytes) else step

    def note(self, calls: Sequence[Call], results: Sequence[object]) -> None:
        """The slave has executed ``calls``, as far as there are ``results``."""
        for call, result in zip(calls, results, strict=False):
            kind = type(call)
            if self._is_running and kind in _OF_STEPS:
                if kind is DoStep and result.status is not StepStatus.OK:  # type: ignore[attr-defined]
                    return  # it goes back from there, or no further
                self._present.append(call)
                if kind is not SetInputs and kind is not DoStep:
                    self._outputs.append(result)
            elif kind in _OF_STATES:
                self._note_state(call)
            elif kind is Configure or kind is Reset:
                self._begin_anew(call)
                if isinstance(call, Configure):
                    self._not_repeating = frozenset(call.not_repeating)
            elif kind not in _WITHOUT_TRACE:
                (self._present if self._is_running else self._beginning).append(call)
                self._is_running = self._is_running or kind is ExitInitializationMode
                if isinstance(call, Initialize):
                    self._note_outputs(call)

    def _note_outputs(self, call: Initialize) -> None:
        names = self._not_repeating
        self._columns = [i for i, name in enumerate(call.outputs) if name in names]
        others = enumerate(call.discrete_outputs)
        self._others = frozenset(i for i, name in others if name in names)

    def _begin_anew(self, call: Call) -> None:
        is_reset = type(call) is Reset
        self._beginning = [c for c in self._beginning if type(c) is Configure] if is_reset else []
        if not is_reset:
            self._beginning.append(call)
        self._is_running = False
        self._kept, self._candidate = _Kept(), None
        self._forget_present()

    def _forget_present(self) -> None:
        self._present, self._outputs, self._marks = [], [], {}

    def _note_state(self, call: Call) -> None:
        if isinstance(call, SetState):
            self._go_back(call.state)
        if isinstance(call, FreeState) and call.state not in self._marks:
            return  # of an earlier step, which a fresh process need not have taken
        self._present.append(call)
        if isinstance(call, GetState):
            self._marks[call.state] = len(self._present), len(self._outputs)
        elif isinstance(call, FreeState) or (isinstance(call, SetState) and call.free):
            self._marks.pop(call.state, None)

    def _go_back(self, state: int) -> None:
        mark = self._marks.get(state)
        if mark is None:
            return
        calls, outputs = mark
        del self._present[calls:], self._outputs[outputs:]
        self._marks = {n: m for n, m in self._marks.items() if m[0] <= calls}

    def settle(self) -> None:
        """The run does not go back any more behind where the slave stands: a step is complete."""
        step = self.present
        kept = self._kept
        kept.steps.append(step.to_bytes() if self._is_compact else step)
        self._forget_present()
        candidate = self._candidate
        if candidate is not None:
            self._candidate = None
            self._kept = _trimmed(kept, candidate, self._kept_steps)

    def save(self, data: bytes) -> None:
        """A state that was serialised where the slave stands, right behind `settle`.

        It counts as soon as a step behind it can tell whether it was restored to the last bit.
        """
        self._candidate = SavedState(data, self.number)

    def proven(self) -> None:
        """A state was restored in a fresh process, and the steps behind it gave the same bits."""
        self._kept_steps = 0

    def distrust(self) -> None:
        """A state was not restored: keep none any more."""
        self._kept, self._candidate = _Kept(self._kept.first, self._kept.steps), None

    def resume(self, state: SavedState | None, first: int, steps: Sequence[LoggedStep]) -> None:
        """Take over the steps of a run that was interrupted, from number ``first`` on.

        The slave stands where they lead.
        """
        kept = [step.to_bytes() if self._is_compact else step for step in steps]
        self._kept = _Kept(first, kept, state)
        self._forget_present()


def outputs_of(calls: Sequence[Call], results: Sequence[object]) -> list[object]:
    """The results that are outputs."""
    return [
        result
        for call, result in zip(calls, results, strict=False)
        if type(call) in (GetOutputs, GetDiscreteOutputs)
    ]


def steps_taken(calls: Sequence[Call]) -> list[DoStep]:
    """The do_steps among them."""
    return [call for call in calls if isinstance(call, DoStep)]


def _trimmed(kept: _Kept, state: SavedState, keep: int) -> _Kept:
    """With another state; the steps before it go when they are more than ``keep``."""
    before = state.number - kept.first
    if before <= keep:
        return _Kept(kept.first, kept.steps, state)
    return _Kept(state.number, kept.steps[before:], state)
