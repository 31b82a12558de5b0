"""Mistakes in system files and studies, in the words of the file that holds them."""

from __future__ import annotations

from collections.abc import Callable

from pydantic import (
    ValidationError,
)
from pydantic_core import ErrorDetails

from protocol.errors import ConfigurationError
from protocol.text.names import nearest


def configuration_error(
    source: str, error: ValidationError, known_keys: Callable[[list[str]], list[str]]
) -> ConfigurationError:
    """The mistakes in a file, a line for each of the first hundred.

    Args:
        source: the file's name.
        error: what pydantic found.
        known_keys: the keys of the table at a place.
    """
    mistakes: dict[tuple[str, ...], ErrorDetails] = {}
    for detail in error.errors():  # one sentence for all branches of a union
        mistakes.setdefault(_place(detail), detail)
    told = list(mistakes.values())[:_SHOWN_MISTAKES]
    sentences = [_sentence(detail, known_keys) for detail in told]
    if len(mistakes) > len(told):
        sentences.append(f"and {len(mistakes) - len(told)} more mistakes")
    return ConfigurationError.of_mistakes([f"{source}: {text}" for text in sentences])


def _place(detail: ErrorDetails) -> tuple[str, ...]:
    return tuple(str(part) for part in detail["loc"] if part not in _UNION_BRANCHES)


def _sentence(detail: ErrorDetails, known_keys: Callable[[list[str]], list[str]]) -> str:
    """One mistake in the words of the file's author."""
    place = list(_place(detail))
    kind = detail["type"]
    if kind == "extra_forbidden":
        *tables, key = place
        return f"{_table(tables)}unknown key {key!r}{nearest(key, known_keys(tables))}"
    if kind == "missing":
        *tables, key = place
        return f"{_table(tables)}key {key!r} is missing"
    message = _WORDS.get(kind, detail["msg"].removeprefix("Value error, "))
    message = message[:1].lower() + message[1:]
    if len(place) > 3 and place[2] == "parameters":
        message = "must be a number, a boolean, a string or an array of them"
    if not place:
        return message
    if kind == "value_error" and len(place) == 2 and place[0] in _ARRAYS:
        return f"{_table(place)}{message}"
    if kind == "value_error" and len(place) == 1:
        return f"[{place[0]}] {message}"
    *tables, key = place
    return f"{_table(tables)}{key} = {detail['input']!r:.60}: {message}"


_WORDS = {
    "model_type": "must be a table",
    "dict_type": "must be a table",
    "mapping_type": "must be a table",
    "tuple_type": "must be an array",
}


_ARRAYS = ("connections", "actions")
"""Arrays of tables."""

_SHOWN_MISTAKES = 100
_UNION_BRANCHES = frozenset(
    {
        *("float", "int", "bool", "str", "constrained-float", "constrained-int"),
        *("input-value", "input-settings", "is-instance[InputRows]", "callable"),
        *("one-value", "values", "range", "same"),
    }
)


def _table(place: list[str]) -> str:
    if not place:
        return ""
    if place[0] in _ARRAYS:
        number = f" number {int(place[1]) + 1}" if len(place) > 1 else ""
        return f"[[{place[0]}]]{number}: "
    return f"[{'.'.join(place)}] "
