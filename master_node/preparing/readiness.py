"""From instantiated slaves to slaves at T_0: names resolved, capabilities checked, trial steps."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from master_node.coupling.coupled_system import CoupledSystem, resolve
from master_node.coupling.external import Signals
from master_node.coupling.step_sizes import check_step_sizes, with_bounded_steps, with_fixed_steps
from master_node.observing.observers import ExchangeListener
from master_node.preparing.capabilities import check_capabilities
from master_node.preparing.configuring import configure
from master_node.preparing.preparation import Prepared, prepare
from master_node.slaves.group import SlaveGroup
from master_node.slaves.link import SlaveLink
from master_node.system.system import System
from protocol.description import SlaveDescription

log = logging.getLogger("master_node")


@dataclass(frozen=True)
class Ready:
    """Slaves with which a run can begin.

    Attributes:
        group: the slaves.
        coupled: their connections.
        prepared: their settings and descriptions, and what their trial steps showed.
    """

    group: SlaveGroup
    coupled: CoupledSystem
    prepared: Prepared


def make_ready(
    links: Mapping[str, SlaveLink],
    system: System,
    descriptions: Mapping[str, SlaveDescription],
    signals: Signals,
    listeners: Sequence[ExchangeListener] = (),
) -> Ready:
    """Configure the slaves, resolve the system, and let them take trial steps; warnings are logged.

    Args:
        links: to the slaves, instantiated.
        system: the settings.
        descriptions: of the slaves.
        signals: what drives the external inputs.
        listeners: are told of every exchange of messages.

    Raises:
        ConfigurationError: the system does not fit its slaves.
        DoublestepError: a slave was lost, or refused.
    """
    descriptions = configure(links, system, descriptions)
    system = with_fixed_steps(system, descriptions)
    coupled = resolve(system, descriptions, signals)
    system = with_bounded_steps(system, coupled)
    check_step_sizes(system)
    warnings = check_capabilities(coupled, system)
    for warning in warnings:
        log.warning("%s", warning)
    group = SlaveGroup(links, listeners)
    prepared = prepare(group, system, descriptions, signals)
    coupled = resolve(prepared.system, prepared.descriptions, signals)
    for warning in check_capabilities(coupled, prepared.system):
        if warning not in warnings:
            log.warning("%s", warning)
    return Ready(group, coupled, prepared)
