"""Calls and replies <-> MessagePack bytes. The only file that knows `msgpack`.

::

    request  [version, epoch, sequence, program]      program: the bytes of [shape, numbers]
    reply    [version, shape, numbers, error, compute_time]     error: nil or a map

    shape    the bytes of [call, call, ...] or [result, result, ...] with their numbers left out
    numbers  all those numbers, float64, little-endian, in order
    call     ["set_inputs", rows, columns]            numbers: rows x columns
             ["do_step", no_set_state_prior]          numbers: communication point, step size
             [verb, field, field, ...]                all others, no numbers left out
    result   [rows, columns] for outputs              numbers: rows x columns
             status for a step                        numbers: time
             [n, other, other, ...] for recorded      numbers: n of floating-point types
             what it is, for all others               a description is a map by field name

From one double step to the next only the numbers change, so a shape is parsed and checked once and
then looked up: the hot path is one copy of a block of numbers.

A single verb travels as a map of the call's fields, and its answer as a map with ``result``, so
that any Zenoh client with a MessagePack library can drive a slave by hand (``docs/protocol.md``).

Lengths and depths are limited before anything is built, no type is chosen by the sender, and
every value is checked against the type that the call declares: what comes out of this module is
well-formed or a `MalformedMessageError`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from struct import Struct
from typing import Any, Final, NamedTuple, TypeVar

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
    StepResult,
    StepStatus,
)
from protocol.description import (
    Capabilities,
    Examination,
    InputDerivatives,
    SlaveDescription,
    StateKind,
    StateVerdict,
)
from protocol.errors import DoublestepError, MalformedMessageError, ModelError, VersionError
from protocol.signals import MAX_ORDER, FloatArray
from protocol.text.limits import MAX_HOST, MAX_NAME, MAX_SENTENCE, cut
from protocol.variables import Causality, StartValue, Unit, Variable, VariableType
from protocol.wire.agents import (
    AgentModel,
    AgentSlave,
    AgentStatus,
    Done,
    Licence,
    ModelList,
    OutputRequest,
    Record,
    SlaveOutput,
    SlaveStarted,
    StartSlave,
    StopRun,
    Upload,
    UploadState,
)
from protocol.wire.keys import is_name

PROTOCOL_VERSION: Final = 1
MAX_MESSAGE_BYTES: Final = 64 * 2**20
MAX_CALLS: Final = 64
MAX_COLUMNS: Final = 200_000
MAX_FIELDS: Final = 64
_MAX_CONTAINERS: Final = 500_000
_SMALL_MESSAGE: Final = 2**10

_LITTLE_ENDIAN = np.dtype("<f8")
_ONE = Struct("<d")
_TWO = Struct("<dd")


def check_length(data: bytes, what: str) -> None:
    """Refuse a message beyond the limit; also before it is sent.

    Raises:
        MalformedMessageError: it is too long.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise MalformedMessageError(
            f"{what} of {len(data)} bytes; the limit is {MAX_MESSAGE_BYTES}"
        )


def _unpack(data: bytes, what: str) -> Any:
    """MessagePack data as plain objects, within the limits."""
    check_length(data, what)
    size = len(data)
    try:
        hook = None if size <= _SMALL_MESSAGE else _counter(data, what)
        return msgpack.unpackb(
            data, raw=False, strict_map_key=True, max_ext_len=0, object_hook=hook, list_hook=hook
        )
    except (ValueError, msgpack.UnpackException) as error:
        raise MalformedMessageError(
            f"{what} is not valid MessagePack: {str(error) or type(error).__name__}"
        ) from error


def _counter(data: bytes, what: str) -> Callable[[Any], Any]:
    """Bound the memory that a large message can ask for; returns what is to see each container.

    Five bytes can announce a million items, and room would be made for them, so go through the
    message once without building anything. Then a byte can still ask for a container: count them
    while they are made.
    """
    walk = msgpack.Unpacker(max_buffer_size=len(data))
    walk.feed(data)
    walk.skip()
    left = _MAX_CONTAINERS

    def count(value: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise MalformedMessageError(f"{what} holds more than {_MAX_CONTAINERS} containers")
        return value

    return count


def _shown(value: Any) -> str:
    """A received value for an error message: never long, never deep."""
    if type(value) in (list, dict):
        return f"a {type(value).__name__}"
    return repr(value[:60] if type(value) in (str, bytes) else value)


def _pack(value: Any) -> bytes:
    return msgpack.packb(value, use_bin_type=True)  # type: ignore[no-any-return]


_Part = bytes | memoryview


def _packed_with_block(
    before: tuple[Any, ...], parts: Sequence[_Part], after: tuple[Any, ...] = ()
) -> bytes:
    """An array of values with one byte string among them, which is made of ``parts``.

    The same bytes as those of `_pack`, which would copy a large byte string several times.
    """
    size = sum(map(len, parts))
    if size <= _SMALL_MESSAGE:
        return _pack((*before, b"".join(parts), *after))
    head = bytes((_ARRAY | (len(before) + 1 + len(after)),)) + _pack(before)[1:]
    long = _BIN_32.pack(0xC6, size) if size >= 2**16 else _BIN_16.pack(0xC5, size)
    return b"".join((head, long, *parts, _pack(after)[1:]))


_ARRAY: Final = 0x90  # of up to 15 items, in MessagePack
_BIN_16: Final = Struct(">BH")
_BIN_32: Final = Struct(">BI")


# --- values -------------------------------------------------------------------------------------


def _array(value: Any, what: str) -> FloatArray:
    if not isinstance(value, list) or len(value) != 2:
        raise MalformedMessageError(f"{what} must be [rows, bytes]")
    rows, data = value
    if type(rows) is not int or not 1 <= rows <= MAX_ORDER + 1 or not isinstance(data, bytes):
        raise MalformedMessageError(f"{what} must be 1 to {MAX_ORDER + 1} rows and their bytes")
    if len(data) % (8 * rows) or len(data) > 8 * rows * MAX_COLUMNS:
        raise MalformedMessageError(f"{what}: {len(data)} bytes are not {rows} rows of float64")
    return np.frombuffer(data, _LITTLE_ENDIAN).reshape(rows, -1)


def _number(value: Any, what: str) -> float:
    if type(value) is float:
        return value
    if type(value) is int:
        try:
            return float(value)
        except OverflowError:
            pass
    raise MalformedMessageError(f"{what} must be a number, not {_shown(value)}")


def _optional_number(value: Any, what: str) -> float | None:
    return None if value is None else _number(value, what)


def _integer(value: Any, what: str) -> int:
    if type(value) is int and 0 <= value < 2**63:
        return value
    raise MalformedMessageError(f"{what} must be an integer from 0, not {_shown(value)}")


def _boolean(value: Any, what: str) -> bool:
    if type(value) is bool:
        return value
    raise MalformedMessageError(f"{what} must be true or false, not {_shown(value)}")


def _string(value: Any, what: str) -> str:
    if type(value) is str:
        return value
    raise MalformedMessageError(f"{what} must be a string, not {_shown(value)}")


def _text_up_to(limit: int) -> Callable[[Any, str], str]:
    """Checks a text of at most ``limit`` characters."""

    def check(value: Any, what: str) -> str:
        text = _string(value, what)
        if len(text) > limit:
            raise MalformedMessageError(f"{what} has {len(text)} characters; the limit is {limit}")
        return text

    return check


_host = _text_up_to(MAX_HOST)
_name = _text_up_to(MAX_NAME)
_sentence = _text_up_to(MAX_SENTENCE)


def _key_part(value: Any, what: str) -> str:
    """The name of a participant, which becomes a part of keys."""
    text = _string(value, what)
    if not is_name(text):
        raise MalformedMessageError(f"{_shown(text)} is not a valid {what}")
    return text


def _binary(value: Any, what: str) -> bytes:
    if type(value) is bytes:
        return value
    raise MalformedMessageError(f"{what} must be bytes, not {_shown(value)}")


def _sentences(value: Any, what: str) -> tuple[str, ...]:
    if type(value) is list and len(value) <= MAX_COLUMNS:
        return tuple(_sentence(item, what) for item in value)
    raise MalformedMessageError(f"{what} must be a list of strings, not {_shown(value)}")


def _names(value: Any, what: str) -> tuple[str, ...]:
    if type(value) is list and len(value) <= MAX_COLUMNS:
        return tuple(_name(item, what) for item in value)
    raise MalformedMessageError(f"{what} must be a list of strings, not {_shown(value)}")


def _numbers(value: Any, what: str) -> tuple[float, ...]:
    if type(value) is list and len(value) <= MAX_COLUMNS:
        return tuple(_number(item, what) for item in value)
    raise MalformedMessageError(f"{what} must be a list of numbers, not {_shown(value)}")


def _start_value(value: Any, what: str) -> StartValue:
    if type(value) in _VALUE_TYPES:
        return value  # type: ignore[no-any-return]
    raise MalformedMessageError(
        f"{what} must be a number, boolean, string or bytes, not {_shown(value)}"
    )


_VALUE_TYPES: Final = frozenset({float, int, bool, str, bytes})


def _values(value: Any, what: str) -> tuple[StartValue, ...]:
    if type(value) is list and len(value) <= MAX_COLUMNS:
        return tuple(_start_value(item, what) for item in value)
    raise MalformedMessageError(f"{what} must be a list of values, not {_shown(value)}")


def _mapping(value: Any, what: str) -> dict[str, Any]:
    if type(value) is dict and all(type(key) is str and len(key) <= MAX_NAME for key in value):
        return value
    raise MalformedMessageError(f"{what} must be a map by name, not {_shown(value)}")


def _start_values(value: Any, what: str) -> dict[str, StartValue]:
    return {name: _start_value(item, what) for name, item in _mapping(value, what).items()}


def _sentences_by_name(value: Any, what: str) -> dict[str, str]:
    return {name: _sentence(item, what) for name, item in _mapping(value, what).items()}


def _dependencies(value: Any, what: str) -> dict[str, tuple[str, ...]]:
    return {name: _names(item, what) for name, item in _mapping(value, what).items()}


# --- calls --------------------------------------------------------------------------------------

_Check = Callable[[Any, str], Any]

_FIELDS: Mapping[type[Call], Mapping[str, _Check]] = {
    Configure: {
        "state_kind": _name,
        "structural_parameters": _start_values,
        "largest_substep": _optional_number,
        "input_substeps": _integer,
        "max_input_order": _integer,
        "not_repeating": _names,
    },
    Initialize: {
        "start_time": _number,
        "stop_time": _optional_number,
        "relative_tolerance": _optional_number,
        "start_values": _start_values,
        "inputs": _names,
        "outputs": _names,
        "discrete_inputs": _names,
        "discrete_outputs": _names,
        "early_return": _boolean,
        "recorded": _names,
    },
    Examine: {
        "communication_point": _number,
        "step_size": _number,
        "relative_tolerance": _number,
        "absolute_tolerance": _number,
        "largest_step": _optional_number,
        "inputs": _numbers,
        "input_changes": _numbers,
        "input_order": _integer,
        "output_derivatives": _boolean,
        "connected": _names,
        "not_repeating": _names,
    },
    SetInputs: {"derivatives": _array},
    SetDiscreteInputs: {"values": _values},
    DoStep: {
        "communication_point": _number,
        "step_size": _number,
        "no_set_state_prior": _boolean,
    },
    GetOutputs: {"order": _integer},
    GetState: {"state": _integer},
    SetState: {"state": _integer, "free": _boolean},
    FreeState: {"state": _integer},
    SerializeState: {"state": _integer},
    DeserializeState: {"state": _integer, "data": _binary},
    Reset: {"loads": _boolean},
}
_CALL_BY_VERB: Mapping[str, type[Call]] = {cls.verb: cls for cls in CALLS}


def _call(value: Any) -> Call:
    """A call of whose fields none is left out."""
    if type(value) is not list or not value or type(value[0]) is not str:
        raise MalformedMessageError(f"a call must be [verb, field, ...], not {_shown(value)}")
    verb, *arguments = value
    cls = _CALL_BY_VERB.get(verb)
    if cls is None:
        raise MalformedMessageError(f"no call is named {_shown(verb)}")
    checks = _FIELDS.get(cls, {})
    if len(arguments) != len(checks):
        raise MalformedMessageError(f"takes {len(checks)} fields, not {len(arguments)}", phase=verb)
    return cls(
        *[check(a, name) for (name, check), a in zip(checks.items(), arguments, strict=True)]
    )


_Maker = Callable[[FloatArray], Any]


class _Plan(NamedTuple):
    """How to make the items of a message of one shape from its numbers.

    Attributes:
        items: those that need no numbers, None where one does.
        made: index, maker and place in the numbers of those that do.
        size: how many numbers there are.
    """

    items: list[Any]
    made: list[tuple[int, _Maker, int, int]]
    size: int

    def build(self, numbers: bytes, what: str) -> list[Any]:
        """The items; the arrays among them are read-only views of ``numbers``."""
        if len(numbers) != 8 * self.size:
            raise MalformedMessageError(
                f"{what} has {len(numbers)} bytes of numbers where its shape wants {8 * self.size}"
            )
        block = np.frombuffer(numbers, _LITTLE_ENDIAN)
        items = self.items.copy()
        for index, make, begin, end in self.made:
            items[index] = make(block[begin:end])
        return items


class _PlanBuilder:
    """Collects the items of a shape in order."""

    def __init__(self) -> None:
        self._items: list[Any] = []
        self._made: list[tuple[int, _Maker, int, int]] = []
        self._size = 0

    def add(self, item: Any) -> None:
        """An item that needs no numbers."""
        self._items.append(item)

    def add_made(self, make: _Maker, size: int) -> None:
        """An item that is made of the next ``size`` numbers."""
        self._made.append((len(self._items), make, self._size, self._size + size))
        self._items.append(None)
        self._size += size

    def plan(self) -> _Plan:
        """What was collected."""
        return _Plan(self._items, self._made, self._size)


def _matrix(rows: Any, columns: Any, what: str) -> tuple[int, int]:
    """The size of an array in a shape."""
    if type(rows) is not int or not 1 <= rows <= MAX_ORDER + 1:
        raise MalformedMessageError(f"{what} must have 1 to {MAX_ORDER + 1} rows")
    if type(columns) is not int or not 0 <= columns <= MAX_COLUMNS:
        raise MalformedMessageError(f"{what} must have 0 to {MAX_COLUMNS} columns")
    return rows, columns


def _cached(shape: bytes) -> bool:
    """Whether a shape is worth keeping; those with long lists of names come once."""
    return len(shape) <= _SMALL_MESSAGE


_CACHED_SHAPES: Final = 256


def _program_plan(shape: bytes) -> _Plan:
    program = _unpack(shape, "a program")
    if type(program) is not list or len(program) > MAX_CALLS:
        raise MalformedMessageError(f"a program must be a list of at most {MAX_CALLS} calls")
    builder = _PlanBuilder()
    for item in program:
        match item:
            case [SetInputs.verb, rows, columns]:
                size = _matrix(rows, columns, "inputs")
                builder.add_made(_set_inputs_maker(size), size[0] * size[1])
            case [DoStep.verb, no_set_state_prior]:
                prior = _boolean(no_set_state_prior, "no_set_state_prior")
                builder.add_made(_do_step_maker(prior), 2)
            case [(SetInputs.verb | DoStep.verb) as verb, *_]:
                raise MalformedMessageError("has another form in a program", phase=verb)
            case _:
                builder.add(_call(item))
    return builder.plan()


_cached_program_plan = lru_cache(_CACHED_SHAPES)(_program_plan)


def _set_inputs_maker(size: tuple[int, int]) -> _Maker:
    return lambda numbers: SetInputs(numbers.reshape(size))


def _do_step_maker(no_set_state_prior: bool) -> _Maker:
    def make(numbers: FloatArray) -> DoStep:
        communication_point, step_size = numbers.tolist()
        return DoStep(communication_point, step_size, no_set_state_prior)

    return make


def encode_program(calls: Sequence[Call]) -> bytes:
    """A list of calls as the ``program`` of a request."""
    shape: list[_Shape] = []
    numbers: list[_Part] = []
    is_repeated = True
    for call in calls:
        kind = type(call)
        if kind is SetInputs:
            shape.append(call.derivatives.shape)  # type: ignore[union-attr]
            numbers.append(_float_buffer(call.derivatives))  # type: ignore[union-attr]
        elif kind is DoStep:
            shape.append(call.no_set_state_prior)  # type: ignore[union-attr]
            numbers.append(_TWO.pack(call.communication_point, call.step_size))  # type: ignore[union-attr]
        else:
            shape.append(call)
            is_repeated = is_repeated and kind in _REPEATED
    packed = _cached_program_shape(tuple(shape)) if is_repeated else _program_shape(shape)
    return _packed_with_block((packed,), numbers)


_Shape = Call | tuple[int, ...] | bool
"""A call without its numbers: those of inputs and steps are left out."""

_REPEATED: Final = frozenset(
    {GetOutputs, GetDiscreteOutputs, GetRecordedVariables, GetState, SetState, FreeState}
)
"""Calls that come again in every step, apart from inputs and steps."""


def _program_shape(items: Sequence[_Shape]) -> bytes:
    shape: list[Any] = []
    for item in items:
        if type(item) is tuple:
            shape.append((SetInputs.verb, *item))
        elif type(item) is bool:
            shape.append((DoStep.verb, item))
        else:
            shape.append(_fields(item))  # type: ignore[arg-type]
    return _pack(shape)


_cached_program_shape = lru_cache(_CACHED_SHAPES)(_program_shape)


def _fields(call: Call) -> list[Any]:
    return [call.verb, *(getattr(call, name) for name in _FIELDS.get(type(call), ()))]


def _float_buffer(array: FloatArray) -> _Part:
    """The bytes of an array, without a copy where it is large."""
    array = np.ascontiguousarray(array, _LITTLE_ENDIAN)
    if array.nbytes <= _SMALL_MESSAGE:
        return array.tobytes()
    return array.reshape(-1).view(np.uint8).data


def decode_program(data: bytes) -> list[Call]:
    """The calls of a program.

    Raises:
        MalformedMessageError: not a list of at most ``MAX_CALLS`` well-formed calls.
    """
    shape, numbers = _shape_and_numbers(_unpack(data, "a program"), "a program")
    plan = _cached_program_plan(shape) if _cached(shape) else _program_plan(shape)
    return plan.build(numbers, "a program")


def _shape_and_numbers(value: Any, what: str) -> tuple[bytes, bytes]:
    if type(value) is list and len(value) == 2:
        shape, numbers = value
        if type(shape) is bytes and type(numbers) is bytes:
            return shape, numbers
    raise MalformedMessageError(f"{what} must be [shape, numbers], both bytes")


def encode_request(epoch: int, sequence: int, program: bytes) -> bytes:
    """A request: whose it is, which one it is, and what to do."""
    return _packed_with_block((PROTOCOL_VERSION, epoch, sequence), (program,))


def decode_request(data: bytes) -> tuple[int, int, bytes]:
    """Epoch, sequence number and program of a request; the program is not looked into.

    Raises:
        VersionError: another protocol version.
        MalformedMessageError: anything else.
    """
    request = _unpack(data, "a request")
    if type(request) is not list or not request:
        raise MalformedMessageError("a request must be [version, epoch, sequence, program]")
    _check_version(request[0])
    if len(request) != 4:
        raise MalformedMessageError("a request must be [version, epoch, sequence, program]")
    return (
        _integer(request[1], "epoch"),
        _integer(request[2], "sequence"),
        _binary(request[3], "program"),
    )


def _check_version(version: Any) -> None:
    if version != PROTOCOL_VERSION or type(version) is not int:
        raise VersionError(
            f"the message has protocol version {_shown(version)}, this side has {PROTOCOL_VERSION}",
            remedy="install the same version of doublestep on both sides",
        )


def decode_single(cls: type[Call], data: bytes) -> Call:
    """The call of one verb from the map of its fields; fields with a default may be left out.

    Raises:
        MalformedMessageError: unknown, missing or ill-typed fields.
    """
    values = _mapping(_unpack(data, "a call") if data else {}, "a call")
    checks = _FIELDS.get(cls, {})
    for name in values:
        if name not in checks:
            raise MalformedMessageError(
                f"has no field {_shown(name)}; its fields are {', '.join(checks) or 'none'}",
                phase=cls.verb,
            )
    try:
        return cls(**{name: checks[name](value, name) for name, value in values.items()})
    except TypeError as error:
        raise MalformedMessageError(
            f"a field is missing; it takes {', '.join(checks)}", phase=cls.verb
        ) from error


# --- replies ------------------------------------------------------------------------------------


def encode_reply(reply: Reply) -> bytes:
    """A reply as bytes; where it is beyond the limits, an error that says why, without results."""
    try:
        data = _encoded(reply)
        check_length(data, "a reply")
    except (ModelError, MalformedMessageError) as error:
        return encode_error(error)
    return data


def _encoded(reply: Reply) -> bytes:
    """Raises `ModelError` where a name in a description is too long."""
    error = None if reply.error is None else reply.error.to_reply()
    shape: list[Any] = []
    numbers: list[_Part] = []
    for result in reply.results:
        if result is None:
            shape.append(None)
        elif type(result) is np.ndarray:
            shape.append(result.shape)
            numbers.append(_float_buffer(result))
        elif type(result) is StepResult:
            shape.append(result.status.value)
            numbers.append(_ONE.pack(result.time))
        elif type(result) is RecordedValues:
            shape.append((result.numbers.size, *result.others))
            numbers.append(_float_buffer(result.numbers))
        else:
            shape.append(_plain(result))
    return _packed_with_block(
        (PROTOCOL_VERSION, _pack(shape)), numbers, (error, reply.compute_time)
    )


def _plain(result: object) -> Any:
    """A result by hand: with its numbers in it."""
    if isinstance(result, np.ndarray):
        return [len(result), result.astype(_LITTLE_ENDIAN, copy=False).tobytes()]
    if isinstance(result, StepResult):
        return [result.status.value, result.time]
    if isinstance(result, RecordedValues):
        return [*result.numbers.ravel().tolist(), *result.others]
    if isinstance(result, SlaveDescription):
        return asdict(_within_limits(result))
    if isinstance(result, Examination):
        return asdict(_with_short_sentences(result))
    return result


def _with_short_sentences(examination: Examination) -> Examination:
    """An examination with its sentences cut."""
    return replace(
        examination,
        state_reason=cut(examination.state_reason),
        input_refusal=cut(examination.input_refusal),
        not_tried=cut(examination.not_tried),
        poor_derivatives={n: cut(why) for n, why in examination.poor_derivatives.items()},
    )


def _within_limits(description: SlaveDescription) -> SlaveDescription:
    """A description with its sentences cut; names must travel whole.

    Raises:
        ModelError: a name is too long.
    """
    names = [description.model, description.guid, *description.units]
    for variable in description.variables:
        names += (variable.name, variable.unit, *variable.items)
    if longest := max(names, key=len)[MAX_NAME:]:
        raise ModelError(
            f"a name in its description has {MAX_NAME + len(longest)} characters; the limit is "
            f"{MAX_NAME}"
        )
    return replace(
        description,
        variables=tuple(
            v if len(v.description) <= MAX_SENTENCE else replace(v, description=cut(v.description))
            for v in description.variables
        ),
        state_reason=cut(description.state_reason),
        remarks=tuple(map(cut, description.remarks)),
        generation_tool=cut(description.generation_tool, MAX_NAME),
    )


def encode_error(error: DoublestepError) -> bytes:
    """The reply to a request of which nothing was executed."""
    return encode_reply(Reply([], error, 0.0))


def encode_single_reply(reply: Reply) -> bytes:
    """The reply to a single verb: a map with ``result``, and with ``error`` if there is one."""
    answer: dict[str, Any] = {"result": _plain(reply.results[-1]) if reply.results else None}
    if reply.error is not None:
        answer["error"] = reply.error.to_reply()
    data = _pack(answer)
    try:
        check_length(data, "a reply")
    except MalformedMessageError as error:
        return _pack({"result": None, "error": error.to_reply()})
    return data


def decode_reply(calls: Sequence[Call], data: bytes) -> Reply:
    """The reply to ``calls``, each result checked against the call that it answers.

    Raises:
        VersionError, MalformedMessageError: the bytes are no reply to these calls.
    """
    reply = _unpack(data, "a reply")
    if type(reply) is not list or not reply:
        raise MalformedMessageError(_REPLY_FORM)
    _check_version(reply[0])
    if len(reply) != 5:
        raise MalformedMessageError(_REPLY_FORM)
    _, shape, numbers, error, compute_time = reply
    shape, numbers = _shape_and_numbers([shape, numbers], "a reply")
    kinds = tuple(map(type, calls))
    plan = _cached_reply_plan(shape, kinds) if _cached(shape) else _reply_plan(shape, kinds)
    return Reply(
        plan.build(numbers, "a reply"),
        None if error is None else DoublestepError.from_reply(_mapping(error, "an error")),
        _number(compute_time, "compute_time"),
    )


_REPLY_FORM: Final = "a reply must be [version, shape, numbers, error, compute_time]"


def _reply_plan(shape: bytes, kinds: tuple[type[Call], ...]) -> _Plan:
    results = _unpack(shape, "a reply")
    if type(results) is not list or len(results) > len(kinds):
        raise MalformedMessageError(f"a reply must be a list of at most {len(kinds)} results")
    builder = _PlanBuilder()
    for kind, item in zip(kinds, results, strict=False):
        if kind is GetOutputs:
            if type(item) is not list or len(item) != 2:
                raise MalformedMessageError("outputs must be [rows, columns]")
            size = _matrix(item[0], item[1], "outputs")
            builder.add_made(_array_maker(size), size[0] * size[1])
        elif kind is DoStep:
            builder.add_made(_step_result_maker(_member(StepStatus, item)), 1)
        elif kind is Describe or kind is Configure:
            builder.add(_description(item))
        elif kind is Examine:
            builder.add(_record(Examination, item, _EXAMINATION_FIELDS))
        elif kind is GetDiscreteOutputs:
            builder.add(_values(item, "discrete outputs"))
        elif kind is GetRecordedVariables:
            number, *others = _values(item, "recorded variables") or (None,)
            _, columns = _matrix(1, number, "recorded variables")
            builder.add_made(_recorded_maker(tuple(others)), columns)
        elif kind is SerializeState:
            builder.add(_binary(item, "a serialized state"))
        elif item is None:
            builder.add(None)
        else:
            raise MalformedMessageError("unexpected result", phase=kind.verb)
    return builder.plan()


_cached_reply_plan = lru_cache(_CACHED_SHAPES)(_reply_plan)


def _array_maker(size: tuple[int, int]) -> _Maker:
    return lambda numbers: numbers.reshape(size)


def _recorded_maker(others: tuple[StartValue, ...]) -> _Maker:
    return lambda numbers: RecordedValues(numbers.reshape(1, -1), others)


def _step_result_maker(status: StepStatus) -> _Maker:
    return lambda numbers: StepResult(status, float(numbers[0]))


def _member(enum: Any, value: Any) -> Any:
    for member in enum:
        if member.value == value:
            return member
    raise MalformedMessageError(f"{_shown(value)} is no {enum.__name__}")


def _record(cls: Any, value: Any, checks: Mapping[str, _Check]) -> Any:
    values = _mapping(value, cls.__name__)
    if values.keys() != checks.keys():
        raise MalformedMessageError(f"{cls.__name__} must have the fields {', '.join(checks)}")
    return cls(**{name: check(values[name], name) for name, check in checks.items()})


def _bound(value: Any, what: str) -> float | int | None:
    if value is None or type(value) in (float, int):
        return value  # type: ignore[no-any-return]
    raise MalformedMessageError(f"{what} must be a number, not {_shown(value)}")


def _items(value: Any, what: str) -> dict[str, int]:
    items = _mapping(value, what)
    if all(type(number) is int for number in items.values()):
        return items
    raise MalformedMessageError(f"{what} must be a map of names to integers")


def _variable(value: Any, _what: str = "") -> Variable:
    return _record(Variable, value, _VARIABLE_FIELDS)  # type: ignore[no-any-return]


def _variables(value: Any, what: str) -> tuple[Variable, ...]:
    if type(value) is not list:
        raise MalformedMessageError(f"{what} must be a list")
    return tuple(_variable(item) for item in value)


def _unit(value: Any, _what: str) -> Unit:
    return _record(Unit, value, _UNIT_FIELDS)  # type: ignore[no-any-return]


def _exponents(value: Any, what: str) -> tuple[int, ...]:
    if type(value) is list and len(value) == 8 and all(type(item) is int for item in value):
        return tuple(value)
    raise MalformedMessageError(f"{what} must be eight integers, not {_shown(value)}")


_UNIT_FIELDS: Mapping[str, _Check] = {
    "exponents": _exponents,
    "factor": _number,
    "offset": _number,
}


def _capabilities(value: Any, _what: str) -> Capabilities:
    return _record(Capabilities, value, _CAPABILITY_FIELDS)  # type: ignore[no-any-return]


def _description(value: Any) -> SlaveDescription:
    return _record(SlaveDescription, value, _DESCRIPTION_FIELDS)  # type: ignore[no-any-return]


_VARIABLE_FIELDS: Mapping[str, _Check] = {
    "name": _name,
    "causality": lambda value, _: _member(Causality, value),
    "type": lambda value, _: _member(VariableType, value),
    "variability": _name,
    "unit": _name,
    "start": lambda value, what: None if value is None else _start_value(value, what),
    "nominal": _number,
    "description": _sentence,
    "minimum": _bound,
    "maximum": _bound,
    "items": _items,
}
_CAPABILITY_FIELDS: Mapping[str, _Check] = {
    "can_get_and_set_state": _boolean,
    "can_serialize_state": _boolean,
    "can_interpolate_inputs": _boolean,
    "max_output_derivative_order": _integer,
    "can_handle_variable_step_size": _boolean,
    "outputs_follow_inputs": _boolean,
}
_DESCRIPTION_FIELDS: Mapping[str, _Check] = {
    "model": _name,
    "kind": _name,
    "variables": _variables,
    "capabilities": _capabilities,
    "feed_through": _dependencies,
    "initial_feed_through": _dependencies,
    "state_kind": lambda value, _: _member(StateKind, value),
    "state_reason": _sentence,
    "input_derivatives": lambda value, _: _member(InputDerivatives, value),
    "fixed_step_size": _optional_number,
    "default_step_size": _optional_number,
    "units": lambda value, what: {
        name: _unit(item, what) for name, item in _mapping(value, what).items()
    },
    "remarks": _sentences,
    "sha256": _name,
    "guid": _name,
    "generation_tool": _name,
}


_EXAMINATION_FIELDS: Mapping[str, _Check] = {
    "state_verdict": lambda value, _: _member(StateVerdict, value),
    "state_reason": _sentence,
    "has_moved": _boolean,
    "difference": _number,
    "internal_clock": _optional_number,
    "step_dependence": _number,
    "largest_substep": _optional_number,
    "input_order": lambda value, what: None if value is None else _integer(value, what),
    "input_refusal": _sentence,
    "not_repeating": _names,
    "poor_derivatives": _sentences_by_name,
    "not_tried": _sentence,
}


# --- plain maps: claims and status --------------------------------------------------------------


def encode_map(values: Mapping[str, StartValue | None]) -> bytes:
    """A flat map of names to plain values."""
    return _pack({"version": PROTOCOL_VERSION, **values})


def decode_map(data: bytes) -> dict[str, StartValue]:
    """The map that ``encode_map`` made, without values that are None.

    Raises:
        VersionError: another protocol version.
        MalformedMessageError: not a flat map.
        DoublestepError: what the map reports, if it is an error reply.
    """
    values = _message(data)
    if len(values) > MAX_FIELDS:
        raise MalformedMessageError(f"a message of {len(values)} fields; the limit is {MAX_FIELDS}")
    return {name: _plain_value(v, name) for name, v in values.items() if v is not None}


def _plain_value(value: Any, what: str) -> StartValue:
    """A value of a flat map, whose texts are for people."""
    return _sentence(value, what) if type(value) is str else _start_value(value, what)


def _message(data: bytes) -> dict[str, Any]:
    """The values of a map with a version; raises the error that it reports."""
    values = _mapping(_unpack(data, "a message"), "a message")
    _check_version(values.pop("version", None))
    if "error" in values:
        raise DoublestepError.from_reply(values)
    return values


def encode_error_map(error: DoublestepError) -> bytes:
    """An error where a flat map was asked for; ``decode_map`` raises it."""
    return encode_map(error.to_reply())


# --- records: agents ----------------------------------------------------------------------------


def _names_by_name(value: Any, what: str) -> dict[str, str]:
    return {name: _name(item, what) for name, item in _mapping(value, what).items()}


def _records(cls: Any, checks: Mapping[str, _Check]) -> _Check:
    """Checks a list of records of one class."""

    def check(value: Any, what: str) -> tuple[Any, ...]:
        if type(value) is list and len(value) <= MAX_COLUMNS:
            return tuple(_record(cls, item, checks) for item in value)
        raise MalformedMessageError(f"{what} must be a list, not {_shown(value)}")

    return check


def _exit_code(value: Any, what: str) -> int | None:
    if value is None or (type(value) is int and -(2**31) <= value < 2**32):
        return value
    raise MalformedMessageError(f"{what} must be a 32-bit integer, not {_shown(value)}")


_RECORD_FIELDS: Mapping[type, Mapping[str, _Check]] = {
    AgentStatus: {
        "name": _key_part,
        "instance": _key_part,
        "host": _host,
        "pid": _integer,
        "labels": _names_by_name,
        "licences": _records(Licence, {"name": _name, "total": _integer, "holders": _sentences}),
        "models": _integer,
        "upload_limit": _integer,
        "python": _boolean,
        "slaves": _records(
            AgentSlave,
            {
                "name": _key_part,
                "instance": _key_part,
                "pid": _integer,
                "run": _key_part,
                "model": _name,
            },
        ),
        "since": _number,
        "time": _number,
    },
    ModelList: {"models": _records(AgentModel, {"name": _name, "sha256": _name, "size": _integer})},
    Upload: {"sha256": _name, "size": _integer, "offset": _integer, "data": _binary},
    UploadState: {"received": _integer, "complete": _boolean},
    StartSlave: {
        "run": _name,
        "host": _host,
        "pid": _integer,
        "orphan_time": _number,
        "slave": _name,
        "model": _name,
        "requires": _names_by_name,
        "restart": _integer,
        "load_timeout": _number,
    },
    SlaveStarted: {"instance": _key_part, "pid": _integer},
    StopRun: {"run": _name},
    OutputRequest: {"run": _name, "slave": _name},
    SlaveOutput: {"exit_code": _exit_code, "lines": _sentences, "log": _name},
    Done: {},
}
_R = TypeVar("_R", bound=Record)


def encode_record(record: Record) -> bytes:
    """A record as a map of its fields."""
    return _pack({"version": PROTOCOL_VERSION, **asdict(record)})


def decode_record(cls: type[_R], data: bytes) -> _R:
    """The record that ``encode_record`` made.

    Raises:
        VersionError: another protocol version.
        MalformedMessageError: no such record: a field is missing, unknown or ill-typed.
        DoublestepError: what the message reports, if it is an error reply; or what the record
            does not allow.
    """
    return _record(cls, _message(data), _RECORD_FIELDS[cls])  # type: ignore[no-any-return]
