"""Initialization in FMI's order, with values propagated along the connections.

Outputs that depend on no connected input in initialization mode are right at once; those that
depend on them only after these were handed on, and so on, level by level (feed-through order).
External inputs have their values at T_0 from the beginning.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from master_node.configuration import System
from master_node.numerics.fixed_point import NoFixedPointError, fixed_point
from master_node.slave_group import Program, SlaveGroup
from master_node.system import CoupledSystem, SlavePart
from protocol.calls import ExitInitializationMode, GetOutputs, Initialize, Reply, SetInputs
from protocol.errors import SlaveError
from protocol.signals import FloatArray

_LOOP_ROUNDS = 100
_LOOP_TOLERANCE = 1e-12


def initialize(
    group: SlaveGroup,
    coupled: CoupledSystem,
    system: System,
    get_outputs: Sequence[GetOutputs] | None = None,
) -> FloatArray:
    """Bring all slaves from instantiated to their first communication point T_0.

    Args:
        group: the slaves, instantiated.
        coupled: their connections.
        system: the settings.
        get_outputs: for each slave how to read its outputs at T_0; None: values only.

    Returns:
        Outputs at T_0, consistent with the connections: values, shape (1, m), or with a second
        row of derivatives when one of ``get_outputs`` asks for them (0 where it does not).

    Raises:
        SlaveError: a slave refused, an output is not finite, or an algebraic loop across slaves
            did not converge.
    """
    simulation = system.simulation
    start = float(simulation.start_time)
    group.execute_all([_initialize(part.name, coupled, system) for part in coupled.parts], start)
    y = _propagate(group, coupled, start)
    get_outputs = get_outputs or [GetOutputs()] * len(coupled.parts)
    programs = [(ExitInitializationMode(), get) for get in get_outputs]
    replies = group.execute_all(programs, start)
    y = gather(coupled, replies, -1, 1 + max(get.order for get in get_outputs))
    finite = np.isfinite(y).all(axis=0)
    if not finite.all():
        name = coupled.output_names[int(np.argmin(finite))]
        raise SlaveError(f"{name} is not finite", phase="initialization", time=start)
    return y


def gather(
    coupled: CoupledSystem, replies: Sequence[Reply], position: int, rows: int = 1
) -> FloatArray:
    """The outputs at one position of each reply, shape (rows, m); rows not read are 0."""
    y = np.zeros((rows, len(coupled.output_names)))
    for part, reply in zip(coupled.parts, replies, strict=True):
        values = reply.results[position]
        assert isinstance(values, np.ndarray)
        y[: len(values), part.output_slice] = values
    return y


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
    external = coupled.external.at(start)[np.newaxis]
    replies = group.execute_all(
        [_first_outputs(part, starts, external) for part in coupled.parts], start
    )
    y: FloatArray = gather(coupled, replies, -1)[0]
    if coupled.initialization.loop:
        return _iterate(group, coupled, external, start, y)
    for level in range(int(coupled.initialization.levels.max()) + 1):
        known = coupled.initialization.levels[coupled.source] <= level
        u = np.where(known, y[coupled.source], starts)
        y = _round(group, coupled, u, external, start)
    return y


def _first_outputs(part: SlavePart, starts: FloatArray, external: FloatArray) -> Program:
    """What a slave is asked for before any output is known: external inputs are."""
    if not part.external:
        return (GetOutputs(),)
    return (SetInputs(part.columns(starts[np.newaxis], external)), GetOutputs())


def _round(
    group: SlaveGroup, coupled: CoupledSystem, u: FloatArray, external: FloatArray, start: float
) -> FloatArray:
    programs = [
        (SetInputs(part.columns(u[np.newaxis], external)), GetOutputs()) for part in coupled.parts
    ]
    y: FloatArray = gather(coupled, group.execute_all(programs, start), -1)[0]
    return y


def _iterate(
    group: SlaveGroup, coupled: CoupledSystem, external: FloatArray, start: float, y: FloatArray
) -> FloatArray:
    """Fixed-point iteration for an algebraic loop across slaves."""
    try:
        return fixed_point(
            lambda y: _round(group, coupled, y[coupled.source], external, start),
            y,
            tolerance=_LOOP_TOLERANCE,
            evaluations=_LOOP_ROUNDS,
        )
    except NoFixedPointError as error:
        raise SlaveError(
            f"the algebraic loop {' -> '.join(coupled.initialization.loop)} did not converge in "
            f"{_LOOP_ROUNDS} rounds; residual {np.abs(error.residual).max():.3g}",
            phase="initialization",
            time=start,
            remedy="break the loop, or give start values nearer to its solution",
        ) from None
