"""Texts in messages: each has a limit where it is decoded, by what it is."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import pytest

from master_node.slaves.remote import RemoteSlave
from master_node.slaves.request_bounds import RequestBounds
from master_node.survey.participants import survey
from protocol.bus.bus import InProcessBus
from protocol.calls import Describe, Examine, Initialize, Reply
from protocol.description import Examination, SlaveDescription
from protocol.errors import (
    ConfigurationError,
    DoublestepError,
    MalformedMessageError,
    ModelError,
    SlaveError,
)
from protocol.text.limits import MAX_HOST, MAX_NAME, MAX_SENTENCE, cut
from protocol.variables import Variable
from protocol.wire import descriptions
from protocol.wire.administration import Claim, Claimed, MasterStatus, RouterStatus
from protocol.wire.keys import CLAIM, STATUS, AgentKey, MasterKey, RouterKey, SlaveKey
from protocol.wire.packing import MAX_MESSAGE_BYTES, pack
from protocol.wire.programs import CALL_FIELDS, decode_single
from protocol.wire.records import MAX_FIELDS, RECORD_FIELDS, decode_map, encode_map
from protocol.wire.replies import decode_reply, encode_reply, encode_single_reply
from slave_node.serving.node import SlaveNode
from tests.master_node.survey.test_survey import slave_status
from tests.support.light_slaves import LightWorker

LONG = "x" * 100_000

Check = Callable[[Any, str], Any]


def every_check() -> list[tuple[str, Check]]:
    """Checks of each field of each message that is decoded, with its name."""
    tables: list[tuple[str, Mapping[str, Check]]] = [
        *((cls.__name__, checks) for cls, checks in RECORD_FIELDS.items()),
        *((cls.__name__, checks) for cls, checks in CALL_FIELDS.items()),
        ("Variable", descriptions.VARIABLE_FIELDS),
        ("SlaveDescription", descriptions.DESCRIPTION_FIELDS),
        ("Capabilities", descriptions.CAPABILITY_FIELDS),
        ("Examination", descriptions.EXAMINATION_FIELDS),
        ("Unit", descriptions.UNIT_FIELDS),
    ]
    return [(f"{cls}.{name}", check) for cls, checks in tables for name, check in checks.items()]


VALUES = {
    *("Configure.structural_parameters", "Initialize.start_values"),
    *("SetDiscreteInputs.values", "SetValues.values"),
    "Variable.start",
}
"""Values of variables, which a model may have as long as a message."""


@pytest.mark.parametrize(
    ("field", "check"), [pytest.param(*one, id=one[0]) for one in every_check()]
)
def test_no_field_takes_a_text_of_any_length(field: str, check: Check) -> None:
    """Law: alone, in a list, as a key and in a map, unless it is the value of a variable."""
    name = field.rpartition(".")[2]
    given: list[Any] = [LONG, [LONG], {LONG: "x"}, {"x": LONG}, {"x": [LONG]}]
    if field in VALUES:
        given = [{LONG: 1.0}] if "meters" in field or "start_values" in field else []
    for value in given:
        with pytest.raises(DoublestepError) as info:
            check(value, name)
        assert len(str(info.value)) < 500


@pytest.mark.parametrize("size", [MAX_NAME, MAX_NAME + 1])
def test_a_name_is_taken_up_to_its_limit(size: int) -> None:
    """At the limit, and no further: of inputs in a call, of variables in a description."""
    name = "x" * size
    message = pack({"inputs": [name]})
    description = SlaveDescription("m", "k", (Variable(name),))
    reply = encode_reply(Reply([description], None, 0.0))
    if size == MAX_NAME:
        call = decode_single(Initialize, message)
        assert isinstance(call, Initialize)
        assert call.inputs == (name,)
        assert decode_reply([Describe()], reply).results == [description]
        return
    with pytest.raises(MalformedMessageError, match=f"inputs has {size} characters"):
        decode_single(Initialize, message)
    error = decode_reply([Describe()], reply).error
    assert isinstance(error, ModelError)
    assert f"has {size} characters; the limit is {MAX_NAME}" in error.cause


def test_sentences_are_cut_by_who_sends_them() -> None:
    """A model with much to say is not refused, and an error is told whatever its length."""
    description = SlaveDescription(
        "m",
        "k",
        (Variable("x", description=LONG),),
        state_reason=LONG,
        remarks=(LONG, "short"),
        generation_tool=LONG,
    )
    (read,) = decode_reply([Describe()], encode_reply(Reply([description], None, 0.0))).results
    assert isinstance(read, SlaveDescription)
    assert read.variables[0].description == cut(LONG)
    assert (read.state_reason, read.remarks) == (cut(LONG), (cut(LONG), "short"))
    assert len(read.generation_tool) == MAX_NAME
    told = ("state_reason", "input_refusal", "not_tried")
    examination = Examination(**dict.fromkeys(told, LONG), poor_derivatives={"y": LONG})
    (again,) = decode_reply(
        [Examine(0.0, 0.1)], encode_reply(Reply([examination], None, 0.0))
    ).results
    assert [getattr(again, name) for name in told] == [cut(LONG)] * 3
    assert again.poor_derivatives == {"y": cut(LONG)}
    for error in (
        SlaveError(LONG, slave=LONG, phase=LONG, remedy=LONG),
        SlaveError("\udc80" * 9999),
    ):
        again = decode_reply([], encode_reply(Reply([], error, 0.0))).error
        assert isinstance(again, SlaveError)
        assert len(again.cause) == MAX_SENTENCE
    assert len(DoublestepError.from_reply({"cause": LONG, "slave": LONG}).slave) == MAX_SENTENCE


def test_a_reply_that_nobody_would_take_is_an_error_at_once() -> None:
    """The sender says so, instead of a wait to the end of the bound."""
    state = bytes(MAX_MESSAGE_BYTES)
    for data in (
        encode_reply(Reply([state], None, 0.0)),
        encode_single_reply(Reply([state], None, 0.0)),
    ):
        assert len(data) < 1000
        assert b"the limit is 67108864" in data


# ---- Claims and status --------------------------------------------------------------------------

STATUSES = [
    slave_status("wheel"),
    MasterStatus("r", "host", 1, "car.toml", "wheel", 0.0, 0.0),
    RouterStatus("0", "host", 1, "tcp/127.0.0.1:1", 0.0, 0.0),
]


@pytest.mark.parametrize("status", STATUSES, ids=lambda status: type(status).__name__)
def test_no_status_takes_a_text_of_any_length(status: Any) -> None:
    """Law: each text of a status is refused when it is long, the host when it is none."""
    for field in fields(status):
        if "str" in str(field.type):
            message = encode_map(replace(status, **{field.name: LONG}).to_message())
            with pytest.raises(MalformedMessageError, match="characters; the limit is"):
                type(status).from_message(decode_map(message))
    message = encode_map(replace(status, host="h" * (MAX_HOST + 1)).to_message())
    with pytest.raises(MalformedMessageError, match="host has 256 characters; the limit is 255"):
        type(status).from_message(decode_map(message))
    with pytest.raises(MalformedMessageError, match="fields; the limit is"):
        decode_map(encode_map({str(number): 1 for number in range(MAX_FIELDS + 1)}))


def test_a_claim_of_any_length_leaves_nothing_behind() -> None:
    """Law: what a master says of itself cannot make the status of a slave too long to be read."""
    bus, key = InProcessBus(), SlaveKey("wheel", "0")
    worker = LightWorker("left")
    node = SlaveNode(bus, worker, key, worker.start())
    for host in ("h" * (MAX_HOST + 1), "h" * 10**6):
        data = node._claim(encode_map(Claim("r", host, 1, 3600.0).to_message()))
        with pytest.raises(MalformedMessageError, match="the limit is"):
            decode_map(data)
    assert decode_map(node._status(b""))["state"] == "free"
    data = node._claim(encode_map(Claim("r", "h" * MAX_HOST, 1, 3600.0).to_message()))
    assert Claimed.from_message(decode_map(data)).epoch
    assert len(node._status(b"")) < 2000


@pytest.mark.parametrize(
    "answer",
    [
        {},
        {"epoch": "1", "host": "h", "pid": 1},
        {"epoch": 1, "host": b"h", "pid": 1},
        {"epoch": 1, "host": "h"},
        {"epoch": 1, "host": "h", "pid": 1.0},
        {"epoch": 1, "host": "h" * 300, "pid": 1},
    ],
)
def test_a_slave_that_answers_a_claim_with_nonsense_is_refused(answer: dict[str, Any]) -> None:
    """A named error, whatever is missing or of another type."""
    bus, key = InProcessBus(), SlaveKey("wheel", "0")
    bus.serve(key.verb(CLAIM), lambda _: encode_map(answer))
    with pytest.raises(MalformedMessageError):
        RemoteSlave(bus, key, run="r", bounds=RequestBounds(1.0, 1.0, 1.0), reconnect_time=1.0)


# ---- Names --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["", "..", "a b", "a\x1b", "ü", "x" * 129, "a\n"])
def test_tokens_with_names_that_are_none_are_not_seen(name: str) -> None:
    """Names in tokens are chosen by peers, and become parts of keys and of lines."""
    for key in (SlaveKey("a", "b"), AgentKey("a", "b"), MasterKey("a"), RouterKey("a")):
        assert type(key).from_alive(key.alive) == key
        assert type(key).from_alive(key.alive.replace("/a/", f"/{name}/")) is None
        assert type(key).from_alive(f"{key.alive}/more") is None
        assert type(key).from_alive(key.alive.replace("doublestep", "other")) is None
    assert SlaveKey.from_alive(f"doublestep/slaves/a/{name}/alive") is None
    assert SlaveKey.from_alive("alive") is None


def test_a_status_of_another_is_not_taken() -> None:
    """A slave cannot appear in a list under the name of another one."""
    bus, key = InProcessBus(), SlaveKey("wheel", "0")
    bus.serve(key.verb(STATUS), lambda _: encode_map(slave_status("engine").to_message()))
    bus.announce(key.alive)
    (participant,) = survey([bus])
    assert participant.status is None
    assert "it says that it is engine/0" in str(participant.failure)


def test_mistakes_of_a_file_are_a_line_each() -> None:
    """And one text where they are part of another error."""
    error = ConfigurationError.of_mistakes(["a: first", "a: second"])
    assert str(error) == "a: first\na: second"
    assert "\n" not in str(SlaveError(f"because of {error.cause}"))
    assert json.dumps(error.to_reply())
