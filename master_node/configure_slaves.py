"""Tells the slaves how their models are to be run, before anything else is asked of them."""

from __future__ import annotations

from collections.abc import Mapping

from master_node.configuration import System
from master_node.slave_group import SlaveGroup
from master_node.slave_link import SlaveLink
from protocol.calls import Configure
from protocol.slave import SlaveDescription


def configure(links: Mapping[str, SlaveLink], system: System) -> dict[str, SlaveDescription]:
    """Configure all slaves, also those for which the system says nothing.

    A slave may still be as its last master wanted it. One that is as this one wants it has nothing
    to do.

    Args:
        links: to the slaves, instantiated.
        system: the settings.

    Returns:
        What each slave says of itself from now on.

    Raises:
        ModelError: a model cannot be run so.
        DoublestepError: a slave cannot be reached.
    """
    group = SlaveGroup(links)
    programs = [(configuration(name, system),) for name in links]
    descriptions = {}
    for name, reply in zip(links, group.execute(programs), strict=True):
        if reply.error is not None:
            raise reply.error
        (description,) = reply.results
        assert isinstance(description, SlaveDescription)
        descriptions[name] = description
    return descriptions


def configuration(slave: str, system: System) -> Configure:
    """What the system says of how a model is to be run."""
    return Configure(state_kind=system.slaves[slave].state or "")
