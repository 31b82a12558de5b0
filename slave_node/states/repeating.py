"""Parts of a holder's answer that repeat when the same is done again from the same state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.calls import GetDiscreteOutputs, GetOutputs, Reply
from protocol.wire.programs import decode_program
from protocol.wire.replies import decode_reply, encode_reply
from slave_node.states.channel import Message
from slave_node.states.step_message import with_outputs


class RepeatingPart:
    """All of it, but for outputs that are known not to repeat.

    Args:
        not_repeating: their names.
    """

    def __init__(self, not_repeating: Sequence[str]) -> None:
        self._names = frozenset(not_repeating)
        self.bind((), ())

    def bind(self, outputs: Sequence[str], discrete_outputs: Sequence[str]) -> None:
        """Let answers have these outputs from here on."""
        self._columns = [i for i, name in enumerate(outputs) if name in self._names]
        self._others = {i for i, name in enumerate(discrete_outputs) if name in self._names}
        self._number = len(outputs)

    def of(self, kind: Message, payload: bytes, answer: bytes) -> bytes:
        """The part that repeats of the ``answer`` to a message."""
        if not self._columns and not self._others:
            return answer
        if kind is Message.STEP:
            return with_outputs(answer, self._number, self._without)
        calls = decode_program(payload)
        reply = decode_reply(calls, answer)
        results: list[object] = []
        for call, result in zip(calls, reply.results, strict=False):
            if isinstance(call, GetOutputs):
                assert isinstance(result, np.ndarray)
                results.append(self._without(result))
            elif isinstance(call, GetDiscreteOutputs):
                assert isinstance(result, tuple)
                results.append(
                    tuple(0 if i in self._others else value for i, value in enumerate(result))
                )
            else:
                results.append(result)
        return encode_reply(Reply(results, reply.error, 0.0))

    def _without(self, outputs: np.ndarray) -> np.ndarray:
        """Outputs, shape (rows, n), with zeros in the columns that do not repeat."""
        kept = outputs.copy()
        kept[:, self._columns] = 0.0
        return kept
