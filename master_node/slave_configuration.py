"""What the system file says of how a slave is to be loaded, and telling the slave."""

from __future__ import annotations

from collections.abc import Mapping

from master_node.configuration import SlaveSettings, System
from master_node.slave_group import SlaveGroup
from protocol.calls import Configure
from protocol.slave import SlaveDescription


def configurations_of(system: System) -> dict[str, Configure]:
    """As what each slave is to be loaded."""
    return {name: _configuration(settings) for name, settings in system.slaves.items()}


def _configuration(settings: SlaveSettings) -> Configure:
    largest = settings.largest_substep
    return Configure(
        largest_substep=None if largest is None else float(largest),
        input_substeps=settings.input_substeps,
    )


def configure(
    group: SlaveGroup, configurations: Mapping[str, Configure]
) -> dict[str, SlaveDescription]:
    """Load slaves as they are to be run, all at once, and give their new descriptions.

    Raises:
        ModelError: one cannot be loaded like that.
        DoublestepError: one was lost.
    """
    slaves = [i for i, name in enumerate(group.names) if name in configurations]
    programs = [(configurations[group.names[i]],) for i in slaves]
    descriptions = {}
    for i, reply in zip(slaves, group.execute(programs, 0.0, None, slaves), strict=True):
        if reply.error is not None:
            raise reply.error
        description = reply.results[0]
        assert isinstance(description, SlaveDescription)
        descriptions[group.names[i]] = description
    return descriptions
