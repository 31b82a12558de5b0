"""Settings of a run as plain data, for ``summary.json``."""

from __future__ import annotations

from collections.abc import Mapping

from master_node.system.system import System
from master_node.system.tables import InputSettings
from protocol.description import SlaveDescription


def settings_of(system: System, descriptions: Mapping[str, SlaveDescription]) -> dict[str, object]:
    """All settings of a run as plain data, with the hashes of the models, for ``summary.json``."""
    settings = system.checked().model_dump(mode="json", by_alias=True)
    simulation = system.simulation
    settings["simulation"] |= {
        "initial_step_size": simulation.given_step_size,
        "derivative_points": simulation.polynomial.derivative_points,
        "initial_history": "rest" if simulation.rests_before_start else "none",
        "smallest_step_size": simulation.smallest,
        "largest_step_size": simulation.largest,
        "slave_tolerance": simulation.slave_relative_tolerance,
    }
    settings["inputs"] = {
        name: value.model_dump(mode="json", exclude_unset=True)
        if isinstance(value, InputSettings)
        else value
        for name, value in system.inputs.items()
    }
    settings["system_file"] = system.source
    settings["models"] = {
        name: {
            "model": description.model,
            "kind": description.kind,
            "sha256": description.sha256,
            "state_kind": description.state_kind,
        }
        for name, description in descriptions.items()
    }
    return settings
