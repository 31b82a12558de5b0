"""Laws of the codec: what goes in comes out, to the bit, and what is no message is refused."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from protocol import errors as errors_module
from protocol.calls import (
    CALLS,
    NO_WARNINGS,
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
    ModelWarnings,
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
from protocol.description import (
    Capabilities,
    Examination,
    InputDerivatives,
    SlaveDescription,
    StateKind,
    StateVerdict,
)
from protocol.errors import (
    DoublestepError,
    MalformedMessageError,
    ProtocolError,
    SlaveError,
    StepRejectedError,
    VersionError,
)
from protocol.variables import Causality, Unit, Variable, VariableType
from protocol.wire.packing import MAX_COLUMNS, MAX_MESSAGE_BYTES, PROTOCOL_VERSION
from protocol.wire.programs import (
    MAX_CALLS,
    decode_program,
    decode_request,
    decode_single,
    encode_program,
    encode_request,
)
from protocol.wire.records import decode_map, encode_error_map, encode_map
from protocol.wire.replies import decode_reply, encode_error, encode_reply, encode_single_reply

# ---- What can be said --------------------------------------------------------------------------

# Every 64 bits are a float: signalling and quiet NaN with payloads, subnormals, both zeros.
any_float = st.one_of(
    st.floats(),
    st.sampled_from([0x7FF8000000000001, 0xFFF123456789ABCD, 1, 0x8000000000000000]).map(
        lambda pattern: struct.unpack("<d", struct.pack("<Q", pattern))[0]
    ),
    st.binary(min_size=8, max_size=8).map(lambda pattern: struct.unpack("<d", pattern)[0]),
)
texts = st.text(st.characters(codec="utf-8"), max_size=20)
numbers = st.integers(0, 2**63 - 1)
NAMES: list[Any] = [[], [], [], [], False, []]
"""The fields of `Initialize` from ``inputs`` on."""

start_values = st.one_of(
    any_float, st.integers(-(2**63), 2**64 - 1), st.booleans(), texts, st.binary(max_size=20)
)


def arrays() -> st.SearchStrategy[np.ndarray]:
    """Float64 of shape (1 to 4, 0 to 5), every bit pattern."""
    return st.tuples(st.integers(1, 4), st.integers(0, 5)).flatmap(
        lambda shape: st.binary(
            min_size=8 * shape[0] * shape[1], max_size=8 * shape[0] * shape[1]
        ).map(lambda data: np.frombuffer(data, "<f8").reshape(shape))
    )


calls = st.one_of(
    st.sampled_from(
        [
            Describe(),
            ExitInitializationMode(),
            GetDiscreteOutputs(),
            GetRecordedVariables(),
            Terminate(),
        ]
    ),
    st.builds(
        Initialize,
        any_float,
        st.none() | any_float,
        st.none() | any_float,
        st.dictionaries(texts, start_values, max_size=3),
        *[st.lists(texts, max_size=3).map(tuple)] * 4,
        st.booleans(),
        st.lists(texts, max_size=3).map(tuple),
    ),
    st.builds(
        Configure,
        texts,
        st.dictionaries(texts, start_values, max_size=3),
        st.none() | any_float,
        numbers,
        numbers,
        st.lists(texts, max_size=3).map(tuple),
        st.lists(texts, max_size=3).map(tuple),
    ),
    st.builds(Reset, st.booleans()),
    st.builds(
        Examine,
        any_float,
        any_float,
        any_float,
        any_float,
        st.none() | any_float,
        any_float,
        st.lists(any_float, max_size=3).map(tuple),
        st.lists(any_float, max_size=3).map(tuple),
        st.integers(0, 3),
        st.booleans(),
        st.lists(texts, max_size=3).map(tuple),
        st.lists(texts, max_size=3).map(tuple),
    ),
    st.builds(SetDiscreteInputs, st.lists(start_values, max_size=5).map(tuple)),
    st.builds(SetValues, st.dictionaries(texts, start_values, max_size=3)),
    st.builds(SetInputs, arrays()),
    st.builds(DoStep, any_float, any_float, st.booleans()),
    *(st.builds(cls, numbers) for cls in (GetOutputs, GetState, FreeState)),
    st.builds(SetState, numbers, st.booleans()),
    st.builds(SerializeState, numbers),
    st.builds(DeserializeState, numbers, st.binary(max_size=50)),
)

names = st.dictionaries(texts, st.lists(texts, max_size=3).map(tuple), max_size=3)
descriptions = st.builds(
    SlaveDescription,
    model=texts,
    kind=texts,
    variables=st.lists(
        st.builds(
            Variable,
            texts,
            st.sampled_from(Causality),
            st.sampled_from(VariableType),
            texts,
            texts,
            st.none() | start_values,
            any_float,
            texts,
            *[st.none() | any_float | st.integers(-(2**63), 2**64 - 1)] * 2,
            st.dictionaries(texts, st.integers(-(2**63), 2**63 - 1), max_size=3),
        ),
        max_size=3,
    ).map(tuple),
    capabilities=st.builds(
        Capabilities, st.booleans(), st.booleans(), st.booleans(), numbers, st.booleans()
    ),
    feed_through=names,
    initial_feed_through=names,
    state_kind=st.sampled_from(StateKind),
    state_reason=texts,
    input_derivatives=st.sampled_from(InputDerivatives),
    fixed_step_size=st.none() | any_float,
    default_step_size=st.none() | any_float,
    units=st.dictionaries(
        texts,
        st.builds(Unit, st.tuples(*[st.integers(-9, 9)] * 8), factor=any_float, offset=any_float),
        max_size=3,
    ),
    remarks=st.lists(texts, max_size=3).map(tuple),
    sha256=texts,
    guid=texts,
    generation_tool=texts,
)

examinations = st.builds(
    Examination,
    st.sampled_from(StateVerdict),
    texts,
    st.booleans(),
    any_float,
    st.none() | any_float,
    any_float,
    st.none() | any_float,
    st.none() | st.integers(0, 3),
    texts,
    st.lists(texts, max_size=3).map(tuple),
    st.dictionaries(texts, texts, max_size=3),
    texts,
)

ERRORS = [DoublestepError]
for error_class in ERRORS:
    ERRORS += [c for c in error_class.__subclasses__() if c.__module__ == errors_module.__name__]

any_text = st.text(max_size=20)  # lone surrogates included: a file name may hold them
errors = st.builds(
    lambda cls, cause, **place: cls(cause, **place),
    st.sampled_from(ERRORS),
    any_text,
    slave=any_text,
    phase=any_text,
    remedy=any_text,
    time=st.none() | any_float,
    step_size=st.none() | any_float,
    last_successful_time=st.none() | any_float,
)


def results_of(call: Call) -> st.SearchStrategy[object]:  # noqa: PLR0911
    """Results that a slave can give to ``call``."""
    match call:
        case GetOutputs():
            return arrays()
        case DoStep():
            return st.builds(StepResult, st.sampled_from(StepStatus), any_float)
        case SerializeState():
            return st.binary(max_size=50)
        case GetDiscreteOutputs():
            return st.lists(start_values, max_size=5).map(tuple)
        case GetRecordedVariables():
            others = st.lists(start_values, max_size=5).map(tuple)
            return st.builds(RecordedValues, arrays().map(lambda array: array[:1]), others)
        case Describe() | Configure():
            return descriptions
        case Examine():
            return examinations
        case _:
            return st.none()


@st.composite
def conversations(draw: st.DrawFn) -> tuple[list[Call], Reply]:
    """A program, and a reply to all of it or to its beginning."""
    program = draw(st.lists(calls, min_size=1, max_size=4))
    done = draw(st.integers(0, len(program)))
    results = [draw(results_of(call)) for call in program[:done]]
    warnings = st.just(NO_WARNINGS) | st.builds(ModelWarnings, st.integers(1, 9), texts)
    return program, Reply(results, draw(st.none() | errors), draw(any_float), draw(warnings))


def canonical(value: Any) -> Any:
    """A value in a form in which == means: the same type and the same bits."""
    if isinstance(value, float):
        return "float", struct.pack("<d", value)
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: canonical(item) for key, item in value.items()}
    if isinstance(value, DoublestepError):
        return type(value), canonical(value.to_reply())
    if hasattr(value, "__dataclass_fields__"):
        value = type(value), *(getattr(value, field.name) for field in fields(value))
    if isinstance(value, tuple | list):
        return type(value), [canonical(item) for item in value]
    return type(value), value


# ---- Round trips -------------------------------------------------------------------------------


@given(program=st.lists(calls, max_size=5), epoch=numbers, sequence=numbers)
def test_every_call_comes_out_as_it_went_in(program: list[Call], epoch: int, sequence: int) -> None:
    """A request says the same calls, to the last bit of every number, on the other side."""
    data = encode_request(epoch, sequence, encode_program(program))
    assert decode_request(data) == (epoch, sequence, encode_program(program))
    assert canonical(decode_program(decode_request(data)[2])) == canonical(program)


@given(conversation=conversations())
def test_every_reply_comes_out_as_it_went_in(conversation: tuple[list[Call], Reply]) -> None:
    """Results, an error wherever it happened, and the time: the same bits on the other side."""
    program, reply = conversation
    assert canonical(decode_reply(program, encode_reply(reply))) == canonical(reply)


def test_the_examples_cover_every_call() -> None:
    """No call was added without the round trips above learning of it."""
    assert set(CALLS) == {
        Describe,
        Configure,
        Examine,
        SetDiscreteInputs,
        SetValues,
        GetDiscreteOutputs,
        GetRecordedVariables,
        Initialize,
        ExitInitializationMode,
        SetInputs,
        DoStep,
        GetOutputs,
        GetState,
        SetState,
        FreeState,
        SerializeState,
        DeserializeState,
        Terminate,
        Reset,
    }


def test_arrays_of_any_layout_travel_row_by_row() -> None:
    """Transposed, strided and big-endian arrays arrive as the numbers that they show."""
    array = np.arange(12.0).reshape(3, 4)
    for shown in (array.T[:, :2], array[:, ::2], array.astype(">f8"), array[::-1]):
        (call,) = decode_program(encode_program([SetInputs(shown)]))
        assert isinstance(call, SetInputs)
        np.testing.assert_array_equal(call.derivatives, shown)


@given(
    values=st.dictionaries(
        texts.filter(lambda name: name not in ("version", "error")), st.none() | start_values
    )
)
def test_maps_come_out_without_what_is_none(values: dict[str, Any]) -> None:
    """Claims and status: the same plain values, None left out."""
    kept = {name: value for name, value in values.items() if value is not None}
    assert canonical(decode_map(encode_map(values))) == canonical(kept)


@given(call=calls)
def test_a_single_verb_says_the_same_as_the_call(call: Call) -> None:
    """A map of the fields, as a Zenoh client writes it by hand, is the call itself."""
    by_name = {field.name: getattr(call, field.name) for field in fields(call)}
    if isinstance(call, SetInputs):
        array = call.derivatives
        by_name["derivatives"] = [len(array), array.astype("<f8").tobytes()]
    assert canonical(decode_single(type(call), msgpack.packb(by_name))) == canonical(call)


def test_fields_with_a_default_may_be_left_out() -> None:
    """By hand, an empty message is enough where nothing must be said."""
    assert decode_single(Reset, b"") == Reset()
    assert decode_single(Initialize, b"") == Initialize()
    assert decode_single(GetOutputs, b"") == GetOutputs()
    data = msgpack.packb({"communication_point": 1, "step_size": 0.5})
    assert decode_single(DoStep, data) == DoStep(1.0, 0.5)
    for wrong, message in (
        (b"", "missing"),
        (msgpack.packb({"step_size": 0.5}), "missing"),
        (msgpack.packb({"stepsize": 0.5}), "no field 'stepsize'"),
        (msgpack.packb({"step_size": "0.5", "communication_point": 0.0}), "must be a number"),
    ):
        with pytest.raises(MalformedMessageError, match=message):
            decode_single(DoStep, wrong)


def test_a_single_reply_is_a_map() -> None:
    """Any MessagePack library reads the answer: the last result, and the error if there is one."""
    step = Reply([None, StepResult(StepStatus.OK, 0.5)], None, 0.0)
    assert msgpack.unpackb(encode_single_reply(step)) == {"result": ["ok", 0.5]}
    failed = msgpack.unpackb(encode_single_reply(Reply([], SlaveError("no"), 0.0)))
    assert failed == {"result": None, "error": {"error": "SlaveError", "cause": "no"}}


# ---- Errors ------------------------------------------------------------------------------------


@given(error=errors)
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_every_error_survives_the_way(error: DoublestepError) -> None:
    """Class, place and numbers of every error of the tree arrive; texts as far as UTF-8 goes."""
    for sent in (
        decode_reply([], encode_error(error)).error,
        DoublestepError.from_reply(error.to_reply()),
    ):
        assert sent is not None
        assert canonical(sent) == canonical(error)
        assert sent.exit_code == error.exit_code
    with pytest.raises(type(error)) as caught:
        decode_map(encode_error_map(error))
    assert canonical(caught.value) == canonical(error)


@pytest.mark.parametrize("cls", ERRORS)
def test_every_class_of_the_tree_is_its_own(cls: type[DoublestepError]) -> None:
    """An integer is as good as a float for a place, and an empty error says nothing more."""
    error = cls("why", slave="wheel", phase="do_step", time=1, step_size=2, remedy="how")
    sent = DoublestepError.from_reply(error.to_reply())
    assert type(sent) is cls
    assert str(sent) == "wheel: do_step at t=1.0 s, H=2.0 s: why; how"
    assert cls("why").to_reply() == {"error": cls.__name__, "cause": "why"}


def test_names_of_errors_differ() -> None:
    """The name is all that travels of a class, so no two may share one."""
    assert len({cls.__name__ for cls in ERRORS}) == len(ERRORS)


def test_an_error_of_another_version_is_a_protocol_error() -> None:
    """A class that this side does not know keeps its words."""
    sent = DoublestepError.from_reply({"error": "NewError", "cause": "why", "slave": "wheel"})
    assert type(sent) is ProtocolError
    assert str(sent) == "wheel: why"


@given(
    reply=st.dictionaries(
        st.sampled_from(["error", "cause", "slave", "phase", "time", "step_size", "remedy"]),
        st.one_of(start_values, st.none(), st.lists(texts), st.dictionaries(texts, texts)),
    )
)
def test_an_error_reply_of_any_shape_is_an_error(reply: dict[str, Any]) -> None:
    """Wrong fields of a stranger's error are left out; the rest can be shown."""
    error = DoublestepError.from_reply(reply)
    assert isinstance(str(error), str)
    assert decode_reply([], encode_error(error)).error is not None


# ---- What is no message ------------------------------------------------------------------------

Decoder = Callable[[bytes], object]

DECODERS: dict[str, Decoder] = {
    "request": decode_request,
    "program": decode_program,
    "map": decode_map,
    **{f"single {c.verb}": lambda data, c=c: decode_single(c, data) for c in CALLS},
    **{
        f"reply to {c.verb}": lambda data, c=c: decode_reply([object.__new__(c)] * 3, data)
        for c in CALLS
    },
}

EXAMPLES = [
    encode_request(3, 4, encode_program([Describe()])),
    encode_program(
        [
            Initialize(0.0, 1.0, None, {"m": 1.0, "on": True, "s": "x"}, ("u",), ("y",)),
            ExitInitializationMode(),
            GetState(1),
            SetInputs(np.ones((2, 3))),
            DoStep(0.0, 0.1, True),
            GetOutputs(1),
            DeserializeState(2, b"state"),
        ]
    ),
    encode_reply(
        Reply([np.ones((1, 2)), StepResult(StepStatus.DISCARD, 0.1)], StepRejectedError("no"), 0.1)
    ),
    encode_reply(
        Reply(
            [
                SlaveDescription(
                    "Wheel", "Python model", (Variable("x"), Variable("y", start=1.0)), sha256="0"
                )
            ],
            None,
            0.1,
        )
    ),
    encode_map({"run": "r", "host": "h", "pid": 3}),
]


def refuses_or_accepts(decode: Decoder, data: bytes) -> None:
    """Nothing but a `DoublestepError` may come out of a decoder."""
    with suppress(DoublestepError):
        decode(data)


@given(data=st.binary(max_size=200))
@settings(max_examples=300)
def test_random_bytes_raise_nothing_strange(data: bytes) -> None:
    """Whatever arrives, every decoder accepts it or raises an error of the tree."""
    for decode in DECODERS.values():
        refuses_or_accepts(decode, data)


@given(
    data=st.sampled_from(EXAMPLES),
    changes=st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=3), st.integers(0, 9))),
)
@settings(max_examples=500)
def test_damaged_messages_raise_nothing_strange(
    data: bytes, changes: list[tuple[float, bytes, int]]
) -> None:
    """Messages with bytes put in, taken out and replaced are taken or refused."""
    for place, inserted, removed in changes:
        at = int(place * len(data))
        data = data[:at] + inserted + data[at + removed :]
    for decode in DECODERS.values():
        refuses_or_accepts(decode, data)


any_value = st.recursive(
    st.one_of(st.none(), start_values, st.binary(max_size=20)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=10,
)


@given(
    value=any_value,
    verb=st.sampled_from([c.verb for c in CALLS]),
    rest=st.lists(any_value, max_size=6),
    status=st.sampled_from(["ok", "discard", "lost", "", None, []]),
)
@settings(max_examples=300)
def test_well_formed_nonsense_raises_nothing_strange(
    value: Any, verb: str, rest: list[Any], status: Any
) -> None:
    """Valid MessagePack of the wrong types and in the wrong places is refused with its place."""
    for message in (
        value,
        [PROTOCOL_VERSION, *rest],
        [PROTOCOL_VERSION, msgpack.packb([status, value]), bytes(16), value, 0.0],
        [PROTOCOL_VERSION, msgpack.packb([[2, 1]]), bytes(16), {"error": value}, value],
        [PROTOCOL_VERSION, msgpack.packb([value]), value, {"cause": value}, 0.0],
        [msgpack.packb([[verb, *rest]]), bytes(16)],
        [msgpack.packb(rest), value],
        {"version": PROTOCOL_VERSION, "run": value, "error": value},
        dict.fromkeys(("order", "state", "data", "derivatives", "step_size"), value),
    ):
        data = msgpack.packb(message)
        for decode in DECODERS.values():
            refuses_or_accepts(decode, data)


def program(shape: Any, numbers: bytes = b"") -> bytes:
    """A program as somebody else might write it."""
    return bytes(msgpack.packb([msgpack.packb(shape), numbers]))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (program(["reset"]), "a call must be"),
        (program([[]]), "a call must be"),
        (program([[3]]), "a call must be"),
        (program([["explode"]]), "no call is named 'explode'"),
        (program([["terminate", 1]]), "takes 0 fields, not 1"),
        (program([["get_state"]]), "takes 1 fields, not 0"),
        (program([["get_state", -1]]), "integer from 0"),
        (program([["get_state", 2**63]]), "integer from 0"),
        (program([["get_state", 1.0]]), "integer from 0"),
        (program([["get_state", True]]), "integer from 0"),
        (program([["do_step", 0.0, 0.1, False]]), "has another form in a program"),
        (program([["do_step", 1]], bytes(16)), "no_set_state_prior must be true or false"),
        (program([["do_step", True]]), "has 0 bytes of numbers where its shape wants 16"),
        (program([["deserialize_state", 1, "text"]]), "must be bytes"),
        (program([["set_inputs", [1, b""]]]), "has another form in a program"),
        (program([["set_inputs", 0, 0]]), "1 to 4 rows"),
        (program([["set_inputs", 5, 1]], bytes(40)), "1 to 4 rows"),
        (program([["set_inputs", True, 1]], bytes(8)), "1 to 4 rows"),
        (program([["set_inputs", 1, -1]]), "0 to 200000 columns"),
        (program([["set_inputs", 1, 200_001]], bytes(8 * 200_001)), "0 to 200000 columns"),
        (program([["set_inputs", 2, 3]], bytes(40)), "where its shape wants 48"),
        (program([["set_inputs", 2, 3]], bytes(56)), "where its shape wants 48"),
        (program([["set_inputs", 4, 200_000]]), "where its shape wants 6400000"),
        (program([], bytes(8)), "where its shape wants 0"),
        (
            program([["initialize", "0", None, None, {}, *NAMES]]),
            "start_time must be a number",
        ),
        (
            program([["initialize", True, None, None, {}, *NAMES]]),
            "must be a number, not True",
        ),
        (
            program([["initialize", 0, None, None, {"m": [1]}, *NAMES]]),
            "string or bytes, not a list",
        ),
        (
            program([["initialize", 0, None, None, [], *NAMES]]),
            "must be a map by name",
        ),
        (
            program([["initialize", 0, None, None, {}, [3], *NAMES[1:]]]),
            "inputs must be a string",
        ),
        (
            program([["initialize", 0, None, None, {}, "xy", *NAMES[1:]]]),
            "must be a list of strings",
        ),
        (program([["reset"]] * (MAX_CALLS + 1)), f"at most {MAX_CALLS} calls"),
        (program({"reset": 1}), "a program must be a list"),
        (program([msgpack.ExtType(4, b"")]), "a call must be"),
        (msgpack.packb([[["reset"]], b""]), "must be [shape, numbers]"),
        (msgpack.packb([b"\x90"]), "must be [shape, numbers]"),
        (msgpack.packb([b"", b""]), "not valid MessagePack"),
    ],
    ids=lambda value: value if isinstance(value, str) else "program",
)
def test_ill_typed_calls_are_refused_with_the_reason(data: bytes, message: str) -> None:
    """The error names the field, what it must be and what it is, the second time too."""
    for _ in range(2):
        with pytest.raises(MalformedMessageError) as caught:
            decode_program(data)
        assert message in str(caught.value)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        ([0, b""], "1 to 4 rows"),
        ([5, bytes(40)], "1 to 4 rows"),
        ([True, bytes(8)], "1 to 4 rows"),
        ([2, bytes(24)], "24 bytes are not 2 rows of float64"),
        ([1, bytes(9)], "9 bytes are not 1 rows of float64"),
        ([1, bytes(8 * 200_001)], "are not 1 rows of float64"),
        ([1, [1.0]], "1 to 4 rows"),
        ([[1.0]], "must be [rows, bytes]"),
        ("", "must be [rows, bytes]"),
    ],
    ids=lambda value: value if isinstance(value, str) else "array",
)
def test_ill_formed_arrays_are_refused_with_the_reason(array: Any, message: str) -> None:
    """By hand an array is its number of rows and their bytes."""
    with pytest.raises(MalformedMessageError) as caught:
        decode_single(SetInputs, msgpack.packb({"derivatives": array}))
    assert message in str(caught.value)


def test_equal_shapes_share_nothing_that_can_change() -> None:
    """Remembered shapes are not handed to callers: each message has its own numbers."""
    first, second = (
        decode_program(encode_program([SetInputs(np.full((1, 2), x)), DoStep(x, 1.0), GetState(1)]))
        for x in (1.0, 2.0)
    )
    assert canonical(first) != canonical(second)
    first.append(Reset())
    first[0] = Reset()
    three = decode_program(
        encode_program([SetInputs(np.full((1, 2), 2.0)), DoStep(2.0, 1.0), GetState(1)])
    )
    assert canonical(three) == canonical(second)
    assert isinstance(three[0], SetInputs)
    assert not three[0].derivatives.flags.writeable


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x91",
        msgpack.packb([]) + b"\0",
        msgpack.packb(msgpack.ExtType(1, b"x")),
        b"\xd6\xff\0\0\0\0",  # a time stamp
        b"\xa2\xff\xfe",  # a string that is not UTF-8
        b"\x81\x01\x02",  # a map by number
        b"\x81\xc4\x01a\x02",  # a map by bytes
        b"\x81\x90\x02",  # a map by list
        b"\x81\xa1a" * 5000 + b"\0",
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
    ],
    ids=len,
)
def test_what_is_not_messagepack_is_malformed(data: bytes) -> None:
    """Truncated, nested beyond any sense, with types that are not ours: malformed, and short."""
    for name, decode in DECODERS.items():
        if data == b"" and name.startswith("single"):
            continue  # an empty message stands for no fields
        with pytest.raises(MalformedMessageError) as caught:
            decode(data)
        assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("depth", [900, 100_000])
def test_deep_nesting_is_refused_in_few_words(depth: int) -> None:
    """Depth is no way to the recursion limit, neither of the decoder nor of the message."""
    for decode in DECODERS.values():
        with pytest.raises(ProtocolError) as caught:
            decode(b"\x91" * depth + b"\0")
        assert len(str(caught.value)) < 1000


# ---- Limits ------------------------------------------------------------------------------------


@contextmanager
def memory_below(limit: float) -> Iterator[None]:
    """Fails when more than ``limit`` bytes are allocated at any time."""
    tracemalloc.start()
    try:
        yield
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < limit, f"{peak / 1e6:.0f} MB"


def announced(n: int) -> bytes:
    """Lists in lists that each announce as many items as there are bytes, and hold none."""
    return (b"\xdd" + struct.pack(">I", n)) * 500 + bytes(n)


def large(million: int) -> dict[str, bytes]:
    """Messages of about 3 MB, or of less where a ``million`` is less."""
    three, half = 3 * million, million // 2
    return {
        "empty maps": b"\xdd" + struct.pack(">I", three) + b"\x80" * three,
        "empty lists": b"\xdd" + struct.pack(">I", million) + b"\x90" * million,
        "lists of one empty map": b"\xdd" + struct.pack(">I", half) + b"\x91\x80" * half,
        "announced lists": announced(three),
        "announced lists, small": announced(three // 300),
        "announced lists, smaller": announced(three // 6000),
        "short strings": b"\xdd" + struct.pack(">I", million) + b"\xa2ab" * million,
        "one long string": b"\xdb" + struct.pack(">I", three) + b"a" * three,
        "long bytes for a verb": b"\x91\x91\xc6" + struct.pack(">I", three) + bytes(three),
        "long text for a verb": b"\x91\x91\xdb" + struct.pack(">I", three) + b"a" * three,
        "not UTF-8": b"\xdb" + struct.pack(">I", three) + b"\xff" * three,
    }


@pytest.mark.parametrize("million", [10**5, pytest.param(10**6, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", large(1))
def test_a_few_megabytes_never_ask_for_hundreds(kind: str, million: int) -> None:
    """Memory stays in proportion to the message, whatever it announces; so does its error."""
    data = large(million)[kind]
    for sent in (data, msgpack.packb([data, b""])):  # as a program, and as the shape of one
        bound = max(1e6, min(100.0 * len(sent), 100e6))
        with memory_below(bound), pytest.raises(MalformedMessageError) as caught:
            decode_program(sent)
        assert len(str(caught.value)) < 1000


def test_too_long_a_message_is_refused_unread() -> None:
    """Beyond the limit nothing is decoded; at the limit a large state still passes."""
    too_long = bytes(MAX_MESSAGE_BYTES + 1)
    for decode in DECODERS.values():
        with memory_below(1e6), pytest.raises(MalformedMessageError, match="the limit is"):
            decode(too_long)
    state = bytes(MAX_MESSAGE_BYTES - 1000)
    (call,) = decode_program(encode_program([DeserializeState(1, state)]))
    assert isinstance(call, DeserializeState)
    assert len(call.data) == len(state)


def test_a_large_description_passes() -> None:
    """A model of thirty thousand variables is no attack."""
    description = SlaveDescription(
        "Plant", "Python model", tuple(Variable(f"variable[{i}]") for i in range(30_000))
    )
    reply = decode_reply([Describe()], encode_reply(Reply([description], None, 0.0)))
    assert reply.results == [description]


# ---- Versions ----------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [0, PROTOCOL_VERSION + 1, None, "1", float(PROTOCOL_VERSION)])
def test_another_version_is_named_before_anything_else(version: Any) -> None:
    """Both versions and the remedy, even when the rest has another form in that version."""
    for decode, message in (
        (decode_request, [version]),
        (decode_request, [version, {}, "", "", 5]),
        (lambda data: decode_reply([], data), [version, "in another form"]),
        (decode_map, {"version": version, "run": []}),
        (decode_map, {"run": "r"} if version is None else {"version": version}),
    ):
        with pytest.raises(VersionError) as caught:
            decode(msgpack.packb(message))
        text = str(caught.value)
        assert f"{version!r}" in text
        assert f"this side has {PROTOCOL_VERSION}" in text
        assert "same version" in text


def test_a_reply_longer_than_its_program_is_refused() -> None:
    """A result without a call cannot be checked, so it is not taken."""
    data = encode_reply(Reply([None, None], None, 0.0))
    with pytest.raises(MalformedMessageError):
        decode_reply([Reset()], data)
    with pytest.raises(MalformedMessageError, match="unexpected result"):
        decode_reply([Reset()], encode_reply(Reply([b"state"], None, 0.0)))


def test_the_limits_are_those_of_the_documentation() -> None:
    """64 MB a message, 64 calls a program."""
    assert MAX_MESSAGE_BYTES == 64 * 2**20
    assert MAX_CALLS == 64
    assert MAX_COLUMNS == 200_000
