"""Initialization in FMI's order, with values propagated along the connections.

Outputs that depend on no connected input in initialization mode are right at once; those that
depend on them only after these were handed on, and so on, level by level (feed-through order).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from master_node.configuration import System
from master_node.slave_group import Program, SlaveGroup
from master_node.system import CoupledSystem
from protocol.calls import ExitInitializationMode, GetOutputs, Initialize, Reply, SetInputs
from protocol.errors import SlaveError
from protocol.signals import FloatArray

_LOOP_ROUNDS = 100
_LOOP_TOLERANCE = 1e-12


def initialize(group: SlaveGroup, coupled: CoupledSystem, system: System) -> FloatArray:
    """Bring all slaves from instantiated to their first communication point T_0.

    Returns:
        y(T_0), shape (m,), consistent with the connections.

    Raises:
        SlaveError: a slave refused, an output is not finite, or an algebraic loop across slaves
            did not converge.
    """
    simulation = system.simulation
    start = float(simulation.start_time)
    group.execute_all([_initialize(part.name, coupled, system) for part in coupled.parts], start)
    y = _propagate(group, coupled, start)
    programs = [(ExitInitializationMode(), GetOutputs()) for _ in coupled.parts]
    y = gather(group.execute_all(programs, start), -1)
    finite = np.isfinite(y)
    if not finite.all():
        name = coupled.output_names[int(np.argmin(finite))]
        raise SlaveError(f"{name} is not finite", phase="initialization", time=start)
    return y


def gather(replies: Sequence[Reply], position: int) -> FloatArray:
    """The outputs at one position of each reply, one after the other, shape (m,)."""
    return np.concatenate([reply.results[position][0] for reply in replies])  # type: ignore[index]


def _initialize(slave: str, coupled: CoupledSystem, system: System) -> Program:
    part = next(part for part in coupled.parts if part.name == slave)
    simulation = system.simulation
    return (
        Initialize(
            start_time=float(simulation.start_time),
            stop_time=simulation.end,
            relative_tolerance=simulation.slave_relative_tolerance,
            start_values=dict(system.slaves[slave].parameters),
            inputs=part.inputs,
            outputs=part.outputs,
        ),
    )


def _propagate(group: SlaveGroup, coupled: CoupledSystem, start: float) -> FloatArray:
    """Y in initialization mode after enough rounds for every level to have settled."""
    starts = np.concatenate([part.input_starts for part in coupled.parts])
    replies = group.execute_all([(GetOutputs(),) for _ in coupled.parts], start)
    y = gather(replies, -1)
    if coupled.loop:
        return _iterate(group, coupled, start, y)
    for level in range(int(coupled.initial_levels.max()) + 1):
        known = coupled.initial_levels[coupled.source] <= level
        y = _round(group, coupled, np.where(known, y[coupled.source], starts), start)
    return y


def _round(group: SlaveGroup, coupled: CoupledSystem, u: FloatArray, start: float) -> FloatArray:
    programs = [
        (SetInputs(u[np.newaxis, part.input_slice]), GetOutputs()) for part in coupled.parts
    ]
    return gather(group.execute_all(programs, start), -1)


def _iterate(group: SlaveGroup, coupled: CoupledSystem, start: float, y: FloatArray) -> FloatArray:
    """Fixed-point iteration for an algebraic loop across slaves."""
    for _ in range(_LOOP_ROUNDS):
        following = _round(group, coupled, y[coupled.source], start)
        change = np.abs(following - y)
        y = following
        if not np.isfinite(y).all():
            break
        if (change <= _LOOP_TOLERANCE * np.maximum(1.0, np.abs(y))).all():
            return y
    raise SlaveError(
        f"the algebraic loop {' -> '.join(coupled.loop)} did not converge in {_LOOP_ROUNDS} rounds",
        phase="initialization",
        time=start,
        remedy="break the loop, or give start values nearer to its solution",
    )
