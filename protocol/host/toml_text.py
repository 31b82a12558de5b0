"""TOML out of texts that others wrote."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import Any

from protocol.errors import ConfigurationError

Scalar = bool | int | float | str


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a document.

    Raises:
        ValueError: it is not TOML, or beyond what can be read.
    """
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def toml_value(text: str) -> Any:
    """A single value in TOML's notation; what is none is the text itself."""
    try:
        table = parse_toml(f"table = {{ value = {text} }}")["table"]  # no comment, no second line
    except ValueError:
        return text
    return table["value"] if table.keys() == {"value"} else text


def assigned_values(option: str, assignments: Sequence[str]) -> dict[str, Scalar]:
    """Values out of ``name=value`` at the prompt, each in TOML's notation or a bare text.

    Raises:
        ConfigurationError: an assignment has no name or no value; names the option.
    """
    values: dict[str, Scalar] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name.strip():
            raise ConfigurationError(f"{option} {assignment}: write name=value")
        value = toml_value(text)
        if not isinstance(value, Scalar):
            raise ConfigurationError(f"{option} {assignment}: not a number, boolean or string")
        values[name.strip()] = value
    return values
