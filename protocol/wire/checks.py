"""Checks of received values, one per type of field.

A check takes a value as MessagePack has it and the name of its field, and returns the value in the
type that our records and calls have. It raises `MalformedMessageError`, which shows no more than
the beginning of a value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar

import numpy as np

from protocol.errors import MalformedMessageError, VersionError
from protocol.signals import MAX_ORDER, FloatArray
from protocol.text.limits import MAX_HOST, MAX_NAME, MAX_SENTENCE
from protocol.variables import StartValue
from protocol.wire.keys import is_name
from protocol.wire.packing import LITTLE_ENDIAN, MAX_COLUMNS, PROTOCOL_VERSION

Check = Callable[[Any, str], Any]

_VALUE_TYPES: Final = frozenset({float, int, bool, str, bytes})
_T = TypeVar("_T")


def shown(value: Any) -> str:
    """A received value for an error message: never long, never deep."""
    if type(value) in (list, dict):
        return f"a {type(value).__name__}"
    return repr(value[:60] if type(value) in (str, bytes) else value)


def check_version(version: Any) -> None:
    """Refuse a message of another protocol version.

    Raises:
        VersionError: it is not `PROTOCOL_VERSION`.
    """
    if version != PROTOCOL_VERSION or type(version) is not int:
        raise VersionError(
            f"the message has protocol version {shown(version)}, this side has {PROTOCOL_VERSION}",
            remedy="install the same version of doublestep on both sides",
        )


def array(value: Any, what: str) -> FloatArray:
    """Matrix of float64 from ``[rows, bytes]``: a read-only view of the bytes."""
    if not isinstance(value, list) or len(value) != 2:
        raise MalformedMessageError(f"{what} must be [rows, bytes]")
    rows, data = value
    if type(rows) is not int or not 1 <= rows <= MAX_ORDER + 1 or not isinstance(data, bytes):
        raise MalformedMessageError(f"{what} must be 1 to {MAX_ORDER + 1} rows and their bytes")
    if len(data) % (8 * rows) or len(data) > 8 * rows * MAX_COLUMNS:
        raise MalformedMessageError(f"{what}: {len(data)} bytes are not {rows} rows of float64")
    return np.frombuffer(data, LITTLE_ENDIAN).reshape(rows, -1)


def number(value: Any, what: str) -> float:
    """Number as float; an integer is one where a float can hold it."""
    if type(value) is float:
        return value
    if type(value) is int:
        try:
            return float(value)
        except OverflowError:
            pass
    raise MalformedMessageError(f"{what} must be a number, not {shown(value)}")


def optional(check: Callable[[Any, str], _T]) -> Callable[[Any, str], _T | None]:
    """Check of a field that may be nil."""
    return lambda value, what: None if value is None else check(value, what)


def integer(value: Any, what: str) -> int:
    """Integer from 0 to 2^63 - 1."""
    if type(value) is int and 0 <= value < 2**63:
        return value
    raise MalformedMessageError(f"{what} must be an integer from 0, not {shown(value)}")


def boolean(value: Any, what: str) -> bool:
    """Boolean; 0 and 1 are none."""
    if type(value) is bool:
        return value
    raise MalformedMessageError(f"{what} must be true or false, not {shown(value)}")


def binary(value: Any, what: str) -> bytes:
    """Byte string."""
    if type(value) is bytes:
        return value
    raise MalformedMessageError(f"{what} must be bytes, not {shown(value)}")


def start_value(value: Any, what: str) -> StartValue:
    """Value of a variable: number, boolean, string or bytes, of any length."""
    if type(value) in _VALUE_TYPES:
        return value  # type: ignore[no-any-return]
    raise MalformedMessageError(
        f"{what} must be a number, boolean, string or bytes, not {shown(value)}"
    )


def _string(value: Any, what: str) -> str:
    if type(value) is str:
        return value
    raise MalformedMessageError(f"{what} must be a string, not {shown(value)}")


def _text_up_to(limit: int) -> Callable[[Any, str], str]:
    def check(value: Any, what: str) -> str:
        text = _string(value, what)
        if len(text) > limit:
            raise MalformedMessageError(f"{what} has {len(text)} characters; the limit is {limit}")
        return text

    return check


host = _text_up_to(MAX_HOST)
name = _text_up_to(MAX_NAME)
sentence = _text_up_to(MAX_SENTENCE)


def key_part(value: Any, what: str) -> str:
    """Name of a participant, which becomes a part of keys."""
    text = _string(value, what)
    if not is_name(text):
        raise MalformedMessageError(f"{shown(text)} is not a valid {what}")
    return text


def member(enum: Any) -> Check:
    """Check of a member of ``enum``, which travels as its value."""

    def check(value: Any, what: str) -> Any:  # noqa: ARG001  a check has two arguments
        for item in enum:
            if item.value == value:
                return item
        raise MalformedMessageError(f"{shown(value)} is no {enum.__name__}")

    return check


def list_of(check: Callable[[Any, str], _T], items: str) -> Callable[[Any, str], tuple[_T, ...]]:
    """Check of a list whose items, named ``items`` in errors, pass ``check``."""

    def check_list(value: Any, what: str) -> tuple[_T, ...]:
        if type(value) is list and len(value) <= MAX_COLUMNS:
            return tuple(check(item, what) for item in value)
        raise MalformedMessageError(f"{what} must be a list of {items}, not {shown(value)}")

    return check_list


names = list_of(name, "strings")
sentences = list_of(sentence, "strings")
numbers = list_of(number, "numbers")
values = list_of(start_value, "values")


def mapping(value: Any, what: str) -> dict[str, Any]:
    """Map by name, its values unchecked."""
    if type(value) is dict and all(type(key) is str and len(key) <= MAX_NAME for key in value):
        return value
    raise MalformedMessageError(f"{what} must be a map by name, not {shown(value)}")


def map_of(check: Callable[[Any, str], _T]) -> Callable[[Any, str], dict[str, _T]]:
    """Check of a map by name whose values pass ``check``."""
    return lambda value, what: {
        key: check(item, what) for key, item in mapping(value, what).items()
    }


start_values = map_of(start_value)
names_by_name = map_of(name)


def record(cls: Callable[..., _T], fields: Mapping[str, Check]) -> Callable[[Any, str], _T]:
    """Check of a map that has exactly ``fields``; the values make a ``cls``."""

    def check(value: Any, what: str) -> _T:  # noqa: ARG001  a check has two arguments
        kind = getattr(cls, "__name__", "")
        given = mapping(value, kind)
        if given.keys() != fields.keys():
            raise MalformedMessageError(f"{kind} must have the fields {', '.join(fields)}")
        return cls(**{key: check(given[key], key) for key, check in fields.items()})

    return check
