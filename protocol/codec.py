"""Calls and replies <-> MessagePack bytes. The only file that knows `msgpack`.

::

    request  [version, epoch, sequence, program]      program: the bytes of [call, call, ...]
    call     [verb, field, field, ...]                in the order of the dataclass's fields
    reply    [version, [result, ...], error, compute_time]      error: nil or a map

    float64 array, shape (n,) or (rows, n)    [rows, bytes], little-endian, row by row
    step result                               [status, time]
    slave description, mapping                a map by field name

A single verb travels as a map of the call's fields, and its answer as a map with ``result``, so
that any Zenoh client with a MessagePack library can drive a slave by hand (``docs/protocol.md``).

Lengths and depths are limited before anything is built, no type is chosen by the sender, and
every value is checked against the type that the call declares: what comes out of this module is
well-formed or a `MalformedMessageError`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, Final

import msgpack
import numpy as np

from protocol.calls import (
    CALLS,
    Call,
    Describe,
    DeserializeState,
    DoStep,
    FreeState,
    GetOutputs,
    GetState,
    Initialize,
    Reply,
    SerializeState,
    SetInputs,
    SetState,
    StepResult,
)
from protocol.errors import DoublestepError, MalformedMessageError, VersionError
from protocol.signals import MAX_ORDER, FloatArray
from protocol.slave import (
    Capabilities,
    Causality,
    SlaveDescription,
    StartValue,
    StepStatus,
    Variable,
    VariableType,
)

PROTOCOL_VERSION: Final = 1
MAX_MESSAGE_BYTES: Final = 64 * 2**20
MAX_CALLS: Final = 64
MAX_COLUMNS: Final = 200_000
_MAX_CONTAINERS: Final = 500_000
_SMALL_MESSAGE: Final = 2**10

_LITTLE_ENDIAN = np.dtype("<f8")


def _unpack(data: bytes, what: str) -> Any:
    """MessagePack data as plain objects, within the limits."""
    size = len(data)
    if size > MAX_MESSAGE_BYTES:
        raise MalformedMessageError(f"{what} of {size} bytes; the limit is {MAX_MESSAGE_BYTES}")
    try:
        hooks = {} if size <= _SMALL_MESSAGE else _prepared(data, what)
        return msgpack.unpackb(data, raw=False, strict_map_key=True, max_ext_len=0, **hooks)
    except (ValueError, msgpack.UnpackException) as error:
        raise MalformedMessageError(
            f"{what} is not valid MessagePack: {str(error) or type(error).__name__}"
        ) from error


def _prepared(data: bytes, what: str) -> dict[str, Callable[[Any], Any]]:
    """Bound the memory that a large message can ask for.

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

    return {"object_hook": count, "list_hook": count}


def _shown(value: Any) -> str:
    """A received value for an error message: never long, never deep."""
    if type(value) in (list, dict):
        return f"a {type(value).__name__}"
    return repr(value[:60] if type(value) in (str, bytes) else value)


def _pack(value: Any) -> bytes:
    return msgpack.packb(value, use_bin_type=True)  # type: ignore[no-any-return]


# --- values -------------------------------------------------------------------------------------


def _pack_array(array: FloatArray) -> list[Any]:
    return [len(array), array.astype(_LITTLE_ENDIAN, copy=False).tobytes()]


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


def _text(value: Any, what: str) -> str:
    if type(value) is str:
        return value
    raise MalformedMessageError(f"{what} must be a string, not {_shown(value)}")


def _binary(value: Any, what: str) -> bytes:
    if type(value) is bytes:
        return value
    raise MalformedMessageError(f"{what} must be bytes, not {_shown(value)}")


def _texts(value: Any, what: str) -> tuple[str, ...]:
    if type(value) is list and len(value) <= MAX_COLUMNS:
        return tuple(_text(item, what) for item in value)
    raise MalformedMessageError(f"{what} must be a list of strings, not {_shown(value)}")


def _start_value(value: Any, what: str) -> StartValue:
    if type(value) in (float, int, bool, str):
        return value  # type: ignore[no-any-return]
    raise MalformedMessageError(f"{what} must be a number, boolean or string, not {_shown(value)}")


def _mapping(value: Any, what: str) -> dict[str, Any]:
    if type(value) is dict and all(type(key) is str for key in value):
        return value
    raise MalformedMessageError(f"{what} must be a map by name, not {_shown(value)}")


def _start_values(value: Any, what: str) -> dict[str, StartValue]:
    return {name: _start_value(item, what) for name, item in _mapping(value, what).items()}


def _dependencies(value: Any, what: str) -> dict[str, tuple[str, ...]]:
    return {name: _texts(item, what) for name, item in _mapping(value, what).items()}


# --- calls --------------------------------------------------------------------------------------

_Check = Callable[[Any, str], Any]

_FIELDS: Mapping[type[Call], Mapping[str, _Check]] = {
    Initialize: {
        "start_time": _number,
        "stop_time": _optional_number,
        "relative_tolerance": _optional_number,
        "start_values": _start_values,
        "inputs": _texts,
        "outputs": _texts,
    },
    SetInputs: {"derivatives": _array},
    DoStep: {
        "communication_point": _number,
        "step_size": _number,
        "no_set_state_prior": _boolean,
    },
    GetOutputs: {"order": _integer},
    GetState: {"state": _integer},
    SetState: {"state": _integer},
    FreeState: {"state": _integer},
    SerializeState: {"state": _integer},
    DeserializeState: {"state": _integer, "data": _binary},
}
_CALL_BY_VERB: Mapping[str, type[Call]] = {cls.verb: cls for cls in CALLS}


def _pack_call(call: Call) -> list[Any]:
    if type(call) is SetInputs:
        return [call.verb, _pack_array(call.derivatives)]
    if type(call) is DoStep:
        return [call.verb, call.communication_point, call.step_size, call.no_set_state_prior]
    return [call.verb, *(getattr(call, field.name) for field in fields(call))]


def _call(value: Any) -> Call:
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


def encode_program(calls: Sequence[Call]) -> bytes:
    """A list of calls as the ``program`` of a request."""
    return _pack([_pack_call(call) for call in calls])


def decode_program(data: bytes) -> list[Call]:
    """The calls of a program.

    Raises:
        MalformedMessageError: not a list of at most ``MAX_CALLS`` well-formed calls.
    """
    program = _unpack(data, "a program")
    if type(program) is not list or len(program) > MAX_CALLS:
        raise MalformedMessageError(f"a program must be a list of at most {MAX_CALLS} calls")
    return [_call(item) for item in program]


def encode_request(epoch: int, sequence: int, program: bytes) -> bytes:
    """A request: whose it is, which one it is, and what to do."""
    return _pack([PROTOCOL_VERSION, epoch, sequence, program])


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


def _pack_result(result: object) -> Any:
    if isinstance(result, np.ndarray):
        return _pack_array(result)
    if isinstance(result, StepResult):
        return [result.status.value, result.time]
    if isinstance(result, SlaveDescription):
        return asdict(result)
    return result


def encode_reply(reply: Reply) -> bytes:
    """A reply as bytes."""
    error = None if reply.error is None else reply.error.to_reply()
    results = [_pack_result(result) for result in reply.results]
    return _pack([PROTOCOL_VERSION, results, error, reply.compute_time])


def encode_error(error: DoublestepError) -> bytes:
    """The reply to a request of which nothing was executed."""
    return encode_reply(Reply([], error, 0.0))


def encode_single_reply(reply: Reply) -> bytes:
    """The reply to a single verb: a map with ``result``, and with ``error`` if there is one."""
    answer: dict[str, Any] = {"result": _pack_result(reply.results[-1]) if reply.results else None}
    if reply.error is not None:
        answer["error"] = reply.error.to_reply()
    return _pack(answer)


def decode_reply(calls: Sequence[Call], data: bytes) -> Reply:
    """The reply to ``calls``, each result checked against the call that it answers.

    Raises:
        VersionError, MalformedMessageError: the bytes are no reply to these calls.
    """
    reply = _unpack(data, "a reply")
    if type(reply) is not list or not reply:
        raise MalformedMessageError("a reply must be [version, results, error, compute_time]")
    _check_version(reply[0])
    if len(reply) != 4 or type(reply[1]) is not list or len(reply[1]) > len(calls):
        raise MalformedMessageError("a reply must be [version, results, error, compute_time]")
    _, results, error, compute_time = reply
    return Reply(
        [_result(call, result) for call, result in zip(calls, results, strict=False)],
        None if error is None else DoublestepError.from_reply(_mapping(error, "an error")),
        _number(compute_time, "compute_time"),
    )


def _result(call: Call, value: Any) -> object:
    match call:
        case GetOutputs():
            return _array(value, "outputs")
        case DoStep():
            if type(value) is not list or len(value) != 2:
                raise MalformedMessageError("a step result must be [status, time]")
            return StepResult(_member(StepStatus, value[0]), _number(value[1], "time"))
        case SerializeState():
            return _binary(value, "a serialized state")
        case Describe():
            return _description(value)
        case _:
            if value is not None:
                raise MalformedMessageError("unexpected result", phase=call.verb)
            return None


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


def _variable(value: Any, _what: str = "") -> Variable:
    return _record(Variable, value, _VARIABLE_FIELDS)  # type: ignore[no-any-return]


def _variables(value: Any, what: str) -> tuple[Variable, ...]:
    if type(value) is not list:
        raise MalformedMessageError(f"{what} must be a list")
    return tuple(_variable(item) for item in value)


def _capabilities(value: Any, _what: str) -> Capabilities:
    return _record(Capabilities, value, _CAPABILITY_FIELDS)  # type: ignore[no-any-return]


def _description(value: Any) -> SlaveDescription:
    return _record(SlaveDescription, value, _DESCRIPTION_FIELDS)  # type: ignore[no-any-return]


_VARIABLE_FIELDS: Mapping[str, _Check] = {
    "name": _text,
    "causality": lambda value, _: _member(Causality, value),
    "type": lambda value, _: _member(VariableType, value),
    "variability": _text,
    "unit": _text,
    "start": lambda value, what: None if value is None else _start_value(value, what),
    "nominal": _number,
    "description": _text,
}
_CAPABILITY_FIELDS: Mapping[str, _Check] = {
    "can_get_and_set_state": _boolean,
    "can_serialize_state": _boolean,
    "can_interpolate_inputs": _boolean,
    "max_output_derivative_order": _integer,
    "can_handle_variable_step_size": _boolean,
}
_DESCRIPTION_FIELDS: Mapping[str, _Check] = {
    "model": _text,
    "kind": _text,
    "variables": _variables,
    "capabilities": _capabilities,
    "feed_through": _dependencies,
    "initial_feed_through": _dependencies,
    "state_kind": _text,
    "sha256": _text,
    "guid": _text,
    "generation_tool": _text,
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
    values = _mapping(_unpack(data, "a message"), "a message")
    _check_version(values.pop("version", None))
    if "error" in values:
        raise DoublestepError.from_reply(values)
    return {name: _start_value(v, name) for name, v in values.items() if v is not None}


def encode_error_map(error: DoublestepError) -> bytes:
    """An error where a flat map was asked for; ``decode_map`` raises it."""
    return encode_map(error.to_reply())
