"""The co-simulation master: `System` describes, `simulate` runs, `Result` holds what came out."""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as `typing` has it, which takes longer to import than all else here
if TYPE_CHECKING:
    from master_node.checking.checking import check_system
    from master_node.checking.report import SystemReport
    from master_node.results import Result
    from master_node.running.session import Session
    from master_node.simulation import open_run, resume, simulate
    from master_node.system.files import open_system
    from master_node.system.simulation import SimulationSettings
    from master_node.system.system import System, load_system
    from master_node.system.tables import (
        BusSettings,
        Connection,
        InputSettings,
        ResultsSettings,
        SlaveSettings,
    )

__all__ = [
    "BusSettings",
    "Connection",
    "InputSettings",
    "Result",
    "ResultsSettings",
    "Session",
    "SimulationSettings",
    "SlaveSettings",
    "System",
    "SystemReport",
    "check_system",
    "load_system",
    "open_run",
    "open_system",
    "resume",
    "simulate",
]

_ELSEWHERE = {
    "Result": "results",
    "Session": "running.session",
    "SimulationSettings": "system.simulation",
    "System": "system.system",
    "SystemReport": "checking.report",
    "check_system": "checking.checking",
    "load_system": "system.system",
    "open_run": "simulation",
    "open_system": "system.files",
    "resume": "simulation",
    "simulate": "simulation",
}
"""Modules of what is not in ``system.tables``."""


def __getattr__(name: str) -> object:
    """Import public names when they are asked for: commands need but a part of them."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_ELSEWHERE.get(name, 'system.tables')}"), name)
    globals()[name] = value
    return value
