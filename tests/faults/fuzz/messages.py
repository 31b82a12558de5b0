"""Valid messages of every kind, and what becomes of them on a bad day: a mutator that knows them.

Everything follows from a seed and a number: ``Mutator(seed).message(i)`` is the same for ever.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

import msgpack
import numpy as np

from protocol.calls import (
    CALLS,
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
    RecordedValues,
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
from protocol.description import Examination
from protocol.errors import SlaveBusyError, StepRejectedError
from protocol.wire.programs import encode_program, encode_request
from protocol.wire.records import encode_error_map, encode_map
from protocol.wire.replies import encode_error, encode_reply, encode_single_reply
from tests.support.light_slaves import description_of

_INPUT = np.array([[0.5], [1.0]])

PROGRAMS: tuple[tuple[Call, ...], ...] = (
    (Describe(),),
    (Configure("native", {"n": 3}, 0.01, 4),),
    (
        Initialize(0.0, 1.0, 1e-6, {"p": 0.5}, ("u",), ("x",), (), (), False),
        SetInputs(_INPUT),
        ExitInitializationMode(),
        GetOutputs(),
    ),
    (
        GetState(0),
        SetInputs(_INPUT),
        DoStep(0.0, 0.01),
        GetState(1),
        SetInputs(_INPUT),
        DoStep(0.01, 0.01),
        GetOutputs(1),
    ),
    (SetState(1), SetInputs(_INPUT[:1]), DoStep(0.01, 0.01, True), GetOutputs()),
    (SetState(0, True), FreeState(1), SerializeState(0), DeserializeState(2, bytes(24))),
    (SetDiscreteInputs((1, True, "text", b"\0", 0.5)), GetDiscreteOutputs()),
    (SetValues({"p": 0.5, "on": True}), GetOutputs()),
    (DoStep(0.0, 0.01), GetOutputs(), GetRecordedVariables()),
    (Examine(0.0, 0.01, 1e-4, 1e-4),),
    (Terminate(), Reset()),
)
REPLIES: tuple[tuple[tuple[Call, ...], Reply], ...] = (
    ((Describe(),), Reply([description_of("left")], None, 1e-3)),
    (PROGRAMS[2], Reply([None, None, None, np.array([[1.0]])], None, 1e-3)),
    (
        (DoStep(0.0, 0.01), GetOutputs()),
        Reply([StepResult(StepStatus.OK, 0.01), np.array([[1.0], [2.0]])], None, 1e-3),
    ),
    (
        (DoStep(0.0, 0.01), GetOutputs()),
        Reply([], StepRejectedError("no", slave="left", phase="do_step", time=0.0), 1e-3),
    ),
    (
        (SerializeState(0), GetDiscreteOutputs(), Examine(0.0, 0.01)),
        Reply([b"state", (1, "x", True), Examination()], None, 1e-3),
    ),
    (
        (GetRecordedVariables(),),
        Reply([RecordedValues(np.array([[0.5, 1.5]]), (3, "x", True))], None, 1e-3),
    ),
)


@dataclass(frozen=True)
class Kind:
    """One kind of message.

    Attributes:
        name: of the kind.
        examples: valid messages.
    """

    name: str
    examples: tuple[bytes, ...]


KINDS: tuple[Kind, ...] = (
    Kind("request", tuple(encode_request(1, 1, encode_program(p)) for p in PROGRAMS)),
    Kind("program", tuple(map(encode_program, PROGRAMS))),
    Kind("reply", tuple(encode_reply(reply) for _, reply in REPLIES)),
    Kind(
        "single",
        tuple(
            msgpack.packb(fields, use_bin_type=True)
            for fields in (
                {},
                {"inputs": ["u"], "outputs": ["x"], "start_values": {"p": 1.0}},
                {"derivatives": [1, struct.pack("<d", 0.5)]},
                {"communication_point": 0.0, "step_size": 0.01},
                {"state": 0, "data": bytes(24), "free": True, "order": 1},
            )
        )
        + tuple(encode_single_reply(reply) for _, reply in REPLIES[:2]),
    ),
    Kind(
        "map",
        (
            encode_map({"run": "run-1", "host": "host", "pid": 1}),
            encode_map({"epoch": 1}),
            encode_error_map(SlaveBusyError("busy", slave="left", phase="claim")),
            encode_error(SlaveBusyError("busy")),
        ),
    ),
)

_SCALARS: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    1,
    -1,
    2**31,
    2**63 - 1,
    2**63,
    2**64 - 1,
    -(2**63),
    0.0,
    -0.0,
    float("nan"),
    float("inf"),
    -float("inf"),
    5e-324,
    1.7976931348623157e308,
    "",
    "x",
    "a/*/b",
    "../../etc",
    "\0",
    "left" * 100,
    b"",
    b"\0" * 8,
    b"\xff" * 24,
    *(call.verb for call in CALLS),
)
_HEADERS = (
    b"\xdd\xff\xff\xff\xff",  # 4 G of items
    b"\xdf\xff\xff\xff\xff",  # 4 G of pairs
    b"\xdc\xff\xff",
    b"\xde\xff\xff",
    b"\xc6\xff\xff\xff\xff",  # 4 GB of bytes
    b"\xdb\xff\xff\xff\xff",  # 4 GB of text
    b"\xc9\xff\xff\xff\xff\x01",  # an extension
    b"\xc7\x08\xff" + bytes(8),  # a timestamp
    b"\xc1",  # never used
    b"\xdd\x00\x0f\xff\xff",
)
_LARGE = 3_000_000
_ONE_IN = 5_000
"""So rarely comes a message of megabytes."""


class Mutator:
    """Makes messages. Stateless but for the seed.

    Args:
        seed: of everything.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._random = Random()
        self._mutations: tuple[Callable[[bytes], bytes], ...] = (
            self._flip_bits,
            self._set_bytes,
            self._cut,
            self._grow,
            self._splice,
            self._repeat,
            self._insert_header,
            self._restructure,
            self._restructure,
            self._restructure,
        )

    def message(self, number: int) -> tuple[Kind, bytes]:
        """Message ``number``: the kind that it was made of, and its bytes."""
        random = self._random
        random.seed(self._seed << 40 | number)
        kind = random.choice(KINDS)
        if random.randrange(_ONE_IN) == 0:
            return kind, self._large()
        data = random.choice(kind.examples)
        for _ in range(random.choice((0, 1, 1, 1, 2, 2, 4))):
            data = random.choice(self._mutations)(data)
        return kind, data

    def _place(self, data: bytes) -> int:
        return self._random.randrange(len(data) + 1)

    def _flip_bits(self, data: bytes) -> bytes:
        changed = bytearray(data)
        for _ in range(self._random.randint(1, 8)):
            if changed:
                changed[self._random.randrange(len(changed))] ^= 1 << self._random.randrange(8)
        return bytes(changed)

    def _set_bytes(self, data: bytes) -> bytes:
        place, count = self._place(data), self._random.randint(1, 4)
        return data[:place] + self._random.randbytes(count) + data[place + count :]

    def _cut(self, data: bytes) -> bytes:
        begin, end = sorted((self._place(data), self._place(data)))
        return self._random.choice((data[:begin], data[begin:], data[:begin] + data[end:]))

    def _grow(self, data: bytes) -> bytes:
        place = self._place(data)
        return data[:place] + self._random.randbytes(self._random.randint(1, 40)) + data[place:]

    def _splice(self, data: bytes) -> bytes:
        other = self._random.choice(self._random.choice(KINDS).examples)
        return data[: self._place(data)] + other[self._place(other) :]

    def _repeat(self, data: bytes) -> bytes:
        begin, end = sorted((self._place(data), self._place(data)))
        return data[:end] + data[begin:end] * self._random.randint(1, 20) + data[end:]

    def _insert_header(self, data: bytes) -> bytes:
        place, header = self._place(data), self._random.choice(_HEADERS)
        return data[:place] + header + data[place + self._random.choice((0, 1, len(header))) :]

    def _large(self) -> bytes:
        """Millions of the cheapest items that there are, flat or deep."""
        random = self._random
        item = random.choice((b"\x80", b"\x90", b"\xc0", b"\xa0", b"\xc4\x00", b"\x00", b"\xcb"))
        count = _LARGE // len(item)
        head = random.choice(
            (
                b"",
                struct.pack(">BI", 0xDD, count),
                struct.pack(">BI", 0xDF, count // 2),
                struct.pack(">BI", 0xC6, _LARGE),
                b"\x91" * 100_000,
            )
        )
        return head + item * count

    # --- by structure

    def _restructure(self, data: bytes) -> bytes:
        """Change a place in the tree that the message is; one that is none is changed as bytes."""
        try:
            tree = msgpack.unpackb(data, raw=False, strict_map_key=False)
            return msgpack.packb(self._changed(tree), use_bin_type=True)  # type: ignore[no-any-return]
        except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException):
            return self._flip_bits(data)

    def _changed(self, tree: Any) -> Any:
        """The tree with one place changed; bytes may hold a tree themselves."""
        random = self._random
        if isinstance(tree, list) and tree and random.random() < 0.8:
            return self._changed_list(tree)
        if isinstance(tree, dict) and tree and random.random() < 0.8:
            return self._changed_map(tree)
        if isinstance(tree, bytes) and tree and random.random() < 0.8:
            return self._restructure(tree) if random.random() < 0.7 else self._flip_bits(tree)
        return self._replacement(tree)

    def _changed_list(self, items: list[Any]) -> list[Any]:
        place = self._random.randrange(len(items))
        match self._random.randrange(6):
            case 0:
                return [*items[:place], *items[place + 1 :]]
            case 1:
                return [*items, items[place]]
            case 2:
                return [*items[:place], self._replacement(None), *items[place:]]
            case _:
                return [*items[:place], self._changed(items[place]), *items[place + 1 :]]

    def _changed_map(self, pairs: dict[Any, Any]) -> dict[Any, Any]:
        key = self._random.choice(list(pairs))
        others = {k: v for k, v in pairs.items() if k != key}
        match self._random.randrange(6):
            case 0:
                return others
            case 1:
                return {**pairs, self._random.choice(("x", "error", "version", 1, None)): 1}
            case 2:
                return {**others, f"{key}_": pairs[key]}
            case _:
                return {**pairs, key: self._changed(pairs[key])}

    def _replacement(self, value: Any) -> Any:  # noqa: PLR0911
        """Something else in place of ``value``: of another type, at a limit, long, or deep."""
        random = self._random
        match random.randrange(8):
            case 0 if isinstance(value, float):
                return random.choice((value * 2.0, -value, value + 1e-300))
            case 0 if isinstance(value, int) and abs(value) < 2**62:
                return random.choice((value + 1, value - 1, -value, value * 1000))
            case 1:
                return [random.choice(_SCALARS) for _ in range(random.randrange(6))]
            case 2:
                return {str(random.choice(_SCALARS)): random.choice(_SCALARS)}
            case 3:
                deep: Any = random.choice(_SCALARS)
                for _ in range(random.choice((1, 3, 60, 600))):
                    deep = [deep] if random.random() < 0.7 else {"x": deep}
                return deep
            case 4:
                return [random.choice(_SCALARS)] * random.choice((10, 65, 1000))
            case 5:
                return random.randbytes(8 * random.randrange(6))
            case _:
                return random.choice(_SCALARS)


def calls_of_reply(number: int) -> Sequence[Call]:
    """A program whose reply a message may claim to be."""
    return REPLIES[number % len(REPLIES)][0]
