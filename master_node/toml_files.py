"""TOML files that users write."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from protocol.errors import ConfigurationError


def read_tables(path: Path) -> dict[str, Any]:
    """The tables of a file.

    Raises:
        ConfigurationError: the file cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: not a TOML file: {error}") from error


def read_located_tables(path: Path) -> dict[str, Any]:
    """The same, and where the file is: ``base``, its folder, and ``source``, as it was named.

    Raises:
        ConfigurationError: see `read_tables`; or the file itself says where it is.
    """
    tables = read_tables(path)
    origin = {"base": path.absolute().parent, "source": str(path)}
    for name in origin:
        if name in tables:
            raise ConfigurationError(f"{path}: {name}: unknown table or key")
    return tables | origin
