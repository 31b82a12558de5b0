"""Results of calls as bytes: replies to programs, and to single verbs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from struct import Struct
from typing import Any, Final

import numpy as np

from protocol.calls import (
    NO_WARNINGS,
    Call,
    Configure,
    Describe,
    DoStep,
    Examine,
    GetDiscreteOutputs,
    GetOutputs,
    GetRecordedVariables,
    ModelWarnings,
    RecordedValues,
    Reply,
    SerializeState,
    StepResult,
    StepStatus,
)
from protocol.description import (
    Examination,
    SlaveDescription,
)
from protocol.errors import DoublestepError, MalformedMessageError, ModelError
from protocol.text.limits import cut
from protocol.variables import StartValue
from protocol.wire import checks
from protocol.wire.descriptions import (
    DESCRIPTION,
    EXAMINATION,
    description_within_limits,
    examination_within_limits,
)
from protocol.wire.packing import (
    LITTLE_ENDIAN,
    PROTOCOL_VERSION,
    Part,
    check_length,
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

_ONE = Struct("<d")
_STATUS = checks.member(StepStatus)


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
    numbers: list[Part] = []
    for result in reply.results:
        if result is None:
            shape.append(None)
        elif type(result) is np.ndarray:
            shape.append(result.shape)
            numbers.append(float_buffer(result))
        elif type(result) is StepResult:
            shape.append(result.status.value)
            numbers.append(_ONE.pack(result.time))
        elif type(result) is RecordedValues:
            shape.append((result.numbers.size, *result.others))
            numbers.append(float_buffer(result.numbers))
        else:
            shape.append(_plain(result))
    rest: tuple[Any, ...] = (error, reply.compute_time)
    if reply.warnings.number:
        rest += ((reply.warnings.number, cut(reply.warnings.first)),)
    return packed_with_block((PROTOCOL_VERSION, pack(shape)), numbers, rest)


def _plain(result: object) -> Any:
    """A result by hand: with its numbers in it."""
    if isinstance(result, np.ndarray):
        return [len(result), result.astype(LITTLE_ENDIAN, copy=False).tobytes()]
    if isinstance(result, StepResult):
        return [result.status.value, result.time]
    if isinstance(result, RecordedValues):
        return [*result.numbers.ravel().tolist(), *result.others]
    if isinstance(result, SlaveDescription):
        return asdict(description_within_limits(result))
    if isinstance(result, Examination):
        return asdict(examination_within_limits(result))
    return result


def encode_error(error: DoublestepError) -> bytes:
    """The reply to a request of which nothing was executed."""
    return encode_reply(Reply([], error, 0.0))


def encode_single_reply(reply: Reply) -> bytes:
    """The reply to a single verb: a map with ``result``, and with ``error`` if there is one."""
    answer: dict[str, Any] = {"result": _plain(reply.results[-1]) if reply.results else None}
    if reply.error is not None:
        answer["error"] = reply.error.to_reply()
    data = pack(answer)
    try:
        check_length(data, "a reply")
    except MalformedMessageError as error:
        return pack({"result": None, "error": error.to_reply()})
    return data


def decode_reply(calls: Sequence[Call], data: bytes) -> Reply:
    """The reply to ``calls``, each result checked against the call that it answers.

    Raises:
        VersionError, MalformedMessageError: the bytes are no reply to these calls.
    """
    reply = unpack(data, "a reply")
    if type(reply) is not list or not reply:
        raise MalformedMessageError(_REPLY_FORM)
    checks.check_version(reply[0])
    if not 5 <= len(reply) <= 6:
        raise MalformedMessageError(_REPLY_FORM)
    _, shape, numbers, error, compute_time, *warnings = reply
    shape, numbers = shape_and_numbers([shape, numbers], "a reply")
    kinds = tuple(map(type, calls))
    plan = _cached_reply_plan(shape, kinds) if is_cached(shape) else _reply_plan(shape, kinds)
    return Reply(
        plan.build(numbers, "a reply"),
        None if error is None else DoublestepError.from_reply(checks.mapping(error, "an error")),
        checks.number(compute_time, "compute_time"),
        _warnings(warnings[0]) if warnings else NO_WARNINGS,
    )


def _warnings(value: Any) -> ModelWarnings:
    if type(value) is not list or len(value) != 2:
        raise MalformedMessageError("warnings must be [number, first]")
    number, first = value
    return ModelWarnings(checks.integer(number, "number"), checks.sentence(first, "first"))


_REPLY_FORM: Final = (
    "a reply must be [version, shape, numbers, error, compute_time], with or without warnings"
)


def _reply_plan(shape: bytes, kinds: tuple[type[Call], ...]) -> Plan:
    results = unpack(shape, "a reply")
    if type(results) is not list or len(results) > len(kinds):
        raise MalformedMessageError(f"a reply must be a list of at most {len(kinds)} results")
    builder = PlanBuilder()
    for kind, item in zip(kinds, results, strict=False):
        if kind is GetOutputs:
            if type(item) is not list or len(item) != 2:
                raise MalformedMessageError("outputs must be [rows, columns]")
            size = matrix_size(item[0], item[1], "outputs")
            builder.add_made(_array_maker(size), size[0] * size[1])
        elif kind is DoStep:
            builder.add_made(_step_result_maker(_STATUS(item, "a status")), 1)
        elif kind is Describe or kind is Configure:
            builder.add(DESCRIPTION(item, "a description"))
        elif kind is Examine:
            builder.add(EXAMINATION(item, "an examination"))
        elif kind is GetDiscreteOutputs:
            builder.add(checks.values(item, "discrete outputs"))
        elif kind is GetRecordedVariables:
            number, *others = checks.values(item, "recorded variables") or (None,)
            _, columns = matrix_size(1, number, "recorded variables")
            builder.add_made(_recorded_maker(tuple(others)), columns)
        elif kind is SerializeState:
            builder.add(checks.binary(item, "a serialized state"))
        elif item is None:
            builder.add(None)
        else:
            raise MalformedMessageError("unexpected result", phase=kind.verb)
    return builder.plan()


_cached_reply_plan = lru_cache(CACHED_SHAPES)(_reply_plan)


def _array_maker(size: tuple[int, int]) -> Maker:
    return lambda numbers: numbers.reshape(size)


def _recorded_maker(others: tuple[StartValue, ...]) -> Maker:
    return lambda numbers: RecordedValues(numbers.reshape(1, -1), others)


def _step_result_maker(status: StepStatus) -> Maker:
    return lambda numbers: StepResult(status, float(numbers[0]))
