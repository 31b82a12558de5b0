"""Claims, status and records of agents as bytes: maps with the protocol version."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final, TypeVar

from protocol.errors import DoublestepError, MalformedMessageError
from protocol.variables import StartValue
from protocol.wire import checks
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
from protocol.wire.packing import PROTOCOL_VERSION, pack, unpack

MAX_FIELDS: Final = 64


def encode_map(values: Mapping[str, StartValue | None]) -> bytes:
    """A flat map of names to plain values."""
    return pack({"version": PROTOCOL_VERSION, **values})


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
    return checks.sentence(value, what) if type(value) is str else checks.start_value(value, what)


def _message(data: bytes) -> dict[str, Any]:
    """The values of a map with a version; raises the error that it reports."""
    values = checks.mapping(unpack(data, "a message"), "a message")
    checks.check_version(values.pop("version", None))
    if "error" in values:
        raise DoublestepError.from_reply(values)
    return values


def encode_error_map(error: DoublestepError) -> bytes:
    """An error where a flat map was asked for; ``decode_map`` raises it."""
    return encode_map(error.to_reply())


def _exit_code(value: Any, what: str) -> int | None:
    if value is None or (type(value) is int and -(2**31) <= value < 2**32):
        return value
    raise MalformedMessageError(f"{what} must be a 32-bit integer, not {checks.shown(value)}")


RECORD_FIELDS: Mapping[type, Mapping[str, checks.Check]] = {
    AgentStatus: {
        "name": checks.key_part,
        "instance": checks.key_part,
        "host": checks.host,
        "pid": checks.integer,
        "labels": checks.names_by_name,
        "licences": checks.list_of(
            checks.record(
                Licence, {"name": checks.name, "total": checks.integer, "holders": checks.sentences}
            ),
            "records",
        ),
        "models": checks.integer,
        "upload_limit": checks.integer,
        "python": checks.boolean,
        "slaves": checks.list_of(
            checks.record(
                AgentSlave,
                {
                    "name": checks.key_part,
                    "instance": checks.key_part,
                    "pid": checks.integer,
                    "run": checks.key_part,
                    "model": checks.name,
                },
            ),
            "records",
        ),
        "since": checks.number,
        "time": checks.number,
    },
    ModelList: {
        "models": checks.list_of(
            checks.record(
                AgentModel, {"name": checks.name, "sha256": checks.name, "size": checks.integer}
            ),
            "records",
        )
    },
    Upload: {
        "sha256": checks.name,
        "size": checks.integer,
        "offset": checks.integer,
        "data": checks.binary,
    },
    UploadState: {"received": checks.integer, "complete": checks.boolean},
    StartSlave: {
        "run": checks.name,
        "host": checks.host,
        "pid": checks.integer,
        "orphan_time": checks.number,
        "slave": checks.name,
        "model": checks.name,
        "requires": checks.names_by_name,
        "restart": checks.integer,
        "load_timeout": checks.number,
    },
    SlaveStarted: {"instance": checks.key_part, "pid": checks.integer},
    StopRun: {"run": checks.name},
    OutputRequest: {"run": checks.name, "slave": checks.name},
    SlaveOutput: {"exit_code": _exit_code, "lines": checks.sentences, "log": checks.name},
    Done: {},
}


_R = TypeVar("_R", bound=Record)


def encode_record(record: Record) -> bytes:
    """A record as a map of its fields."""
    return pack({"version": PROTOCOL_VERSION, **asdict(record)})


def decode_record(cls: type[_R], data: bytes) -> _R:
    """The record that ``encode_record`` made.

    Raises:
        VersionError: another protocol version.
        MalformedMessageError: no such record: a field is missing, unknown or ill-typed.
        DoublestepError: what the message reports, if it is an error reply; or what the record
            does not allow.
    """
    return checks.record(cls, RECORD_FIELDS[cls])(_message(data), "a message")
