"""TOML files that users write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from protocol.errors import ConfigurationError
from protocol.host.toml_text import parse_toml

MAX_BYTES = 16 * 2**20
"""Limits of a file: a thousand times what large systems need."""


def read_tables(path: Path) -> dict[str, Any]:
    """The tables of a file.

    Raises:
        ConfigurationError: the file cannot be read, is too large, or is not TOML.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from error
    if len(data) > MAX_BYTES:
        raise ConfigurationError(f"{path}: more than {MAX_BYTES} bytes, the limit of a system file")
    try:
        return parse_toml(data.decode("utf-8-sig"))
    except ValueError as error:
        raise ConfigurationError(f"{path}: not a TOML file: {error}") from error


def read_located_tables(path: Path) -> dict[str, Any]:
    """Tables of a file, and where it is: ``base``, its folder, and ``source``, as it was named.

    Raises:
        ConfigurationError: see `read_tables`; or the file itself says where it is.
    """
    tables = read_tables(path)
    origin = {"base": path.absolute().parent, "source": str(path)}
    for name in origin:
        if name in tables:
            raise ConfigurationError(f"{path}: {name}: unknown table or key")
    return tables | origin
