"""Calls as bytes: programs of requests, and single verbs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from struct import Struct
from typing import Any, Final

from protocol.calls import (
    CALLS,
    Call,
    Configure,
    DeserializeState,
    DoStep,
    Examine,
    FreeState,
    GetDiscreteOutputs,
    GetOutputs,
    GetRecordedVariables,
    GetState,
    Initialize,
    Reset,
    SerializeState,
    SetDiscreteInputs,
    SetInputs,
    SetState,
    SetValues,
)
from protocol.errors import MalformedMessageError
from protocol.signals import FloatArray
from protocol.wire import checks
from protocol.wire.packing import (
    PROTOCOL_VERSION,
    Part,
    float_buffer,
    pack,
    packed_with_block,
    unpack,
)
from protocol.wire.shapes import (
    CACHED_SHAPES,
    Maker,
    Plan,
    PlanBuilder,
    is_cached,
    matrix_size,
    shape_and_numbers,
)

MAX_CALLS: Final = 64
_TWO = Struct("<dd")


CALL_FIELDS: Mapping[type[Call], Mapping[str, checks.Check]] = {
    Configure: {
        "state_kind": checks.name,
        "structural_parameters": checks.start_values,
        "largest_substep": checks.optional(checks.number),
        "input_substeps": checks.integer,
        "max_input_order": checks.integer,
        "not_repeating": checks.names,
        "log_categories": checks.names,
    },
    Initialize: {
        "start_time": checks.number,
        "stop_time": checks.optional(checks.number),
        "relative_tolerance": checks.optional(checks.number),
        "start_values": checks.start_values,
        "inputs": checks.names,
        "outputs": checks.names,
        "discrete_inputs": checks.names,
        "discrete_outputs": checks.names,
        "early_return": checks.boolean,
        "recorded": checks.names,
    },
    Examine: {
        "communication_point": checks.number,
        "step_size": checks.number,
        "relative_tolerance": checks.number,
        "absolute_tolerance": checks.number,
        "largest_step": checks.optional(checks.number),
        "smallest_step": checks.number,
        "inputs": checks.numbers,
        "input_changes": checks.numbers,
        "input_order": checks.integer,
        "output_derivatives": checks.boolean,
        "connected": checks.names,
        "not_repeating": checks.names,
    },
    SetInputs: {"derivatives": checks.array},
    SetDiscreteInputs: {"values": checks.values},
    SetValues: {"values": checks.start_values},
    DoStep: {
        "communication_point": checks.number,
        "step_size": checks.number,
        "no_set_state_prior": checks.boolean,
    },
    GetOutputs: {"order": checks.integer},
    GetState: {"state": checks.integer},
    SetState: {"state": checks.integer, "free": checks.boolean},
    FreeState: {"state": checks.integer},
    SerializeState: {"state": checks.integer},
    DeserializeState: {"state": checks.integer, "data": checks.binary},
    Reset: {"loads": checks.boolean},
}


_CALL_BY_VERB: Mapping[str, type[Call]] = {cls.verb: cls for cls in CALLS}


def _call(value: Any) -> Call:
    """A call of whose fields none is left out."""
    if type(value) is not list or not value or type(value[0]) is not str:
        raise MalformedMessageError(f"a call must be [verb, field, ...], not {checks.shown(value)}")
    verb, *arguments = value
    cls = _CALL_BY_VERB.get(verb)
    if cls is None:
        raise MalformedMessageError(f"no call is named {checks.shown(verb)}")
    fields = CALL_FIELDS.get(cls, {})
    if len(arguments) != len(fields):
        raise MalformedMessageError(f"takes {len(fields)} fields, not {len(arguments)}", phase=verb)
    return cls(
        *[check(a, name) for (name, check), a in zip(fields.items(), arguments, strict=True)]
    )


def _program_plan(shape: bytes) -> Plan:
    program = unpack(shape, "a program")
    if type(program) is not list or len(program) > MAX_CALLS:
        raise MalformedMessageError(f"a program must be a list of at most {MAX_CALLS} calls")
    builder = PlanBuilder()
    for item in program:
        match item:
            case [SetInputs.verb, rows, columns]:
                size = matrix_size(rows, columns, "inputs")
                builder.add_made(_set_inputs_maker(size), size[0] * size[1])
            case [DoStep.verb, no_set_state_prior]:
                prior = checks.boolean(no_set_state_prior, "no_set_state_prior")
                builder.add_made(_do_step_maker(prior), 2)
            case [(SetInputs.verb | DoStep.verb) as verb, *_]:
                raise MalformedMessageError("has another form in a program", phase=verb)
            case _:
                builder.add(_call(item))
    return builder.plan()


_cached_program_plan = lru_cache(CACHED_SHAPES)(_program_plan)


def _set_inputs_maker(size: tuple[int, int]) -> Maker:
    return lambda numbers: SetInputs(numbers.reshape(size))


def _do_step_maker(no_set_state_prior: bool) -> Maker:
    def make(numbers: FloatArray) -> DoStep:
        communication_point, step_size = numbers.tolist()
        return DoStep(communication_point, step_size, no_set_state_prior)

    return make


def encode_program(calls: Sequence[Call]) -> bytes:
    """A list of calls as the ``program`` of a request."""
    shape: list[_Shape] = []
    numbers: list[Part] = []
    is_repeated = True
    for call in calls:
        kind = type(call)
        if kind is SetInputs:
            shape.append(call.derivatives.shape)  # type: ignore[union-attr]
            numbers.append(float_buffer(call.derivatives))  # type: ignore[union-attr]
        elif kind is DoStep:
            shape.append(call.no_set_state_prior)  # type: ignore[union-attr]
            numbers.append(_TWO.pack(call.communication_point, call.step_size))  # type: ignore[union-attr]
        else:
            shape.append(call)
            is_repeated = is_repeated and kind in _REPEATED
    packed = _cached_program_shape(tuple(shape)) if is_repeated else _program_shape(shape)
    return packed_with_block((packed,), numbers)


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
    return pack(shape)


_cached_program_shape = lru_cache(CACHED_SHAPES)(_program_shape)


def _fields(call: Call) -> list[Any]:
    return [call.verb, *(getattr(call, name) for name in CALL_FIELDS.get(type(call), ()))]


def decode_program(data: bytes) -> list[Call]:
    """The calls of a program.

    Raises:
        MalformedMessageError: not a list of at most ``MAX_CALLS`` well-formed calls.
    """
    shape, numbers = shape_and_numbers(unpack(data, "a program"), "a program")
    plan = _cached_program_plan(shape) if is_cached(shape) else _program_plan(shape)
    return plan.build(numbers, "a program")


def encode_request(epoch: int, sequence: int, program: bytes) -> bytes:
    """A request: whose it is, which one it is, and what to do."""
    return packed_with_block((PROTOCOL_VERSION, epoch, sequence), (program,))


def decode_request(data: bytes) -> tuple[int, int, bytes]:
    """Epoch, sequence number and program of a request; the program is not looked into.

    Raises:
        VersionError: another protocol version.
        MalformedMessageError: anything else.
    """
    request = unpack(data, "a request")
    if type(request) is not list or not request:
        raise MalformedMessageError("a request must be [version, epoch, sequence, program]")
    checks.check_version(request[0])
    if len(request) != 4:
        raise MalformedMessageError("a request must be [version, epoch, sequence, program]")
    return (
        checks.integer(request[1], "epoch"),
        checks.integer(request[2], "sequence"),
        checks.binary(request[3], "program"),
    )


def decode_single(cls: type[Call], data: bytes) -> Call:
    """The call of one verb from the map of its fields; fields with a default may be left out.

    Raises:
        MalformedMessageError: unknown, missing or ill-typed fields.
    """
    values = checks.mapping(unpack(data, "a call") if data else {}, "a call")
    fields = CALL_FIELDS.get(cls, {})
    for name in values:
        if name not in fields:
            raise MalformedMessageError(
                f"has no field {checks.shown(name)}; its fields are {', '.join(fields) or 'none'}",
                phase=cls.verb,
            )
    try:
        return cls(**{name: fields[name](value, name) for name, value in values.items()})
    except TypeError as error:
        raise MalformedMessageError(
            f"a field is missing; it takes {', '.join(fields)}", phase=cls.verb
        ) from error
