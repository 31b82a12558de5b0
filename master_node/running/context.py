"""What a run is about: the slaves, how they are coupled, and who is told."""

from __future__ import annotations

from dataclasses import dataclass

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.scheme import CouplingScheme
from master_node.observing.observers import Observer, Statistics
from master_node.resuming.checkpoints import Checkpoints, Resumed
from master_node.running.interrupts import Interrupts
from master_node.slaves.group import SlaveGroup
from master_node.system.system import System


@dataclass(frozen=True)
class RunContext:
    """The parts that `FixedRun` and `ControlledRun` work on.

    Attributes:
        group: the slaves, at their first communication point.
        coupled: their connections.
        scheme: how they are coupled within a step.
        system: the settings.
        observer: is told of every step.
        statistics: are counted up.
        interrupts: wait while a step is told and counted.
        checkpoints: are told where the run stands.
        resumed: where it goes on; None: at T_0.
    """

    group: SlaveGroup
    coupled: CoupledSystem
    scheme: CouplingScheme
    system: System
    observer: Observer
    statistics: Statistics
    interrupts: Interrupts
    checkpoints: Checkpoints
    resumed: Resumed | None = None
