"""Tells the slaves how their models are to be run, before anything else is asked of them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from master_node.slaves.group import Program, SlaveGroup
from master_node.slaves.link import SlaveLink
from master_node.system.start_values import structural_values
from master_node.system.system import System
from protocol.calls import Configure
from protocol.description import SlaveDescription


def configure(
    links: Mapping[str, SlaveLink], system: System, descriptions: Mapping[str, SlaveDescription]
) -> dict[str, SlaveDescription]:
    """Configure all slaves, also those for which the system says nothing.

    A slave may still be as its last master wanted it. One that is as this one wants it has nothing
    to do.

    Args:
        links: to the slaves, instantiated.
        system: the settings.
        descriptions: of the slaves as they are now.

    Returns:
        What each slave says of itself from now on.

    Raises:
        ConfigurationError: a value is none of a structural parameter.
        ModelError: a model cannot be run so.
        DoublestepError: a slave cannot be reached.
    """
    wanted = {name: configuration(name, system, descriptions[name]) for name in links}
    return reconfigure(SlaveGroup(links), wanted)


def reconfigure(
    group: SlaveGroup, configurations: Mapping[str, Configure]
) -> dict[str, SlaveDescription]:
    """Configure some slaves, with what is given for each; errors as for `configure`."""
    slaves = [i for i, name in enumerate(group.names) if name in configurations]
    programs: list[Program] = [(configurations[group.names[i]],) for i in slaves]
    descriptions = {}
    for i, reply in zip(slaves, group.execute(programs, slaves=slaves), strict=True):
        if reply.error is not None:
            raise reply.error
        (description,) = reply.results
        assert isinstance(description, SlaveDescription)
        descriptions[group.names[i]] = description
    return descriptions


def configuration(slave: str, system: System, description: SlaveDescription) -> Configure:
    """Configuration of a model in the words of the system.

    Args:
        slave: its name.
        system: the settings.
        description: of the slave, for its structural parameters.

    Raises:
        ConfigurationError: a value is none of a structural parameter.
    """
    settings = system.slaves[slave]
    largest = settings.largest_substep
    return Configure(
        state_kind=settings.state or "",
        structural_parameters=structural_values(
            description,
            settings.parameters,
            partial(system.places.parameter, slave),
            ignores_bounds=settings.ignore_bounds,
        ),
        largest_substep=None if largest is None else float(largest),
        input_substeps=settings.input_substeps,
        log_categories=settings.fmi_logging,
    )
