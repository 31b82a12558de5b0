"""The co-simulation master: `System` describes, `simulate` runs, `Result` holds what came out."""

from master_node.configuration import (
    BusSettings,
    Connection,
    ResultsSettings,
    SimulationSettings,
    SlaveSettings,
    System,
    load_system,
)
from master_node.results import Result
from master_node.simulation import simulate

__all__ = [
    "BusSettings",
    "Connection",
    "Result",
    "ResultsSettings",
    "SimulationSettings",
    "SlaveSettings",
    "System",
    "load_system",
    "simulate",
]
