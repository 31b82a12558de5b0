"""A case: the values of the parameters of one run, and the file that hands them to it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import tomli_w

from master_node.system.fields import Scalar
from master_node.system.system import System
from master_node.system.toml_files import read_tables
from protocol.errors import ConfigurationError

Case = Mapping[str, Scalar]
"""Values by ``slave.variable`` or ``simulation.key``."""

_SIMULATION = "simulation."
_TABLE = "parameters"


def apply_case(system: System, case: Case) -> System:
    """The system with the values of a case.

    Raises:
        ConfigurationError: no such slave or key, or a value that a key cannot have.
    """
    parameters = {name: value for name, value in case.items() if not name.startswith(_SIMULATION)}
    simulation = {
        name.removeprefix(_SIMULATION): value
        for name, value in case.items()
        if name.startswith(_SIMULATION)
    }
    return system.with_parameters(parameters).with_simulation(**simulation)


def write_case(path: Path, case: Case) -> None:
    """Write a case as a TOML file; raises OSError."""
    path.write_text(tomli_w.dumps({_TABLE: dict(case)}), encoding="utf-8")


def read_case(path: Path) -> Case:
    """Read a case from a TOML file.

    Raises:
        ConfigurationError: it is missing, or is not a case.
    """
    tables = read_tables(path)
    case = tables.pop(_TABLE, None)
    if tables or not isinstance(case, dict):
        raise ConfigurationError(f"{path}: not a case: it needs a table [{_TABLE}] and no other")
    for name, value in case.items():
        if not isinstance(value, bool | int | float | str):
            raise ConfigurationError(f"{path}: {name!r} must be a number, a boolean or a string")
    return case
