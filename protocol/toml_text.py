"""TOML out of texts that others wrote."""

from __future__ import annotations

import tomllib
from typing import Any


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
