"""Tolerances of a variable."""

from __future__ import annotations

from master_node.system.system import System
from master_node.system.tables import SlaveSettings
from protocol.variables import Variable


def tolerance(system: System, slave: str, variable: Variable) -> tuple[float, float]:
    """ATOL_j and RTOL_j: of the output, else of its slave, else of the simulation."""
    settings: SlaveSettings = system.slaves[slave]
    own = settings.tolerances.get(variable.name)
    simulation = system.simulation
    absolute = [own.absolute] if own else []
    relative = [own.relative] if own else []
    absolute += [settings.absolute_tolerance, simulation.absolute_tolerance]
    relative += [settings.relative_tolerance, simulation.relative_tolerance]
    atol = next(value for value in absolute if value is not None)
    rtol = next(value for value in relative if value is not None)
    return atol * variable.nominal, rtol
