"""The co-simulation master: `System` describes, `simulate` runs, `Result` holds what came out."""

from master_node.configuration import (
    BusSettings,
    Connection,
    InputSettings,
    ResultsSettings,
    SimulationSettings,
    SlaveSettings,
    System,
    load_system,
)
from master_node.results import Result
from master_node.simulation import resume, simulate
from master_node.system_files import open_system

__all__ = [
    "BusSettings",
    "Connection",
    "InputSettings",
    "Result",
    "ResultsSettings",
    "SimulationSettings",
    "SlaveSettings",
    "System",
    "load_system",
    "open_system",
    "resume",
    "simulate",
]
