"""Initialization in FMI's order, with values propagated along the connections.

Outputs that depend on no connected input in initialization mode are right at once; those that
depend on them only after these were handed on, and so on, level by level (feed-through order).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem, SlavePart
from master_node.coupling.discrete import DiscreteValues, Held, HeldInput
from master_node.coupling.outputs import Outputs, gather, reading_calls
from master_node.coupling.step_sizes import step_size_limits
from master_node.numerics.fixed_point import NoFixedPointError, fixed_point
from master_node.numerics.norms import first_not_finite
from master_node.slaves.group import Program, SlaveGroup
from master_node.system.system import System
from protocol.calls import (
    ExitInitializationMode,
    GetOutputs,
    Initialize,
    SetDiscreteInputs,
    SetInputs,
)
from protocol.description import StateKind
from protocol.errors import SlaveError
from protocol.signals import FloatArray
from protocol.variables import StartValue

_LOOP_ROUNDS = 100
_LOOP_TOLERANCE = 1e-12


def initialize(
    group: SlaveGroup,
    coupled: CoupledSystem,
    system: System,
    get_outputs: Sequence[GetOutputs] | None = None,
) -> Outputs:
    """Bring all slaves from instantiated to their first communication point T_0.

    Args:
        group: the slaves, instantiated.
        coupled: their connections.
        system: the settings.
        get_outputs: for each slave how to read its outputs at T_0; None: values only.

    Returns:
        Outputs at T_0, consistent with the connections: values, shape (1, m), or with a second
        row of derivatives when one of ``get_outputs`` asks for them (0 where it does not); they
        need not be finite.

    Raises:
        SlaveError: a slave refused, a value is not finite, or an algebraic loop across slaves
            did not converge.
    """
    simulation = system.simulation
    start = float(simulation.start_time)
    may_return_early = simulation.estimator != "none" and step_size_limits(system).quantum is None
    group.execute_all(
        [
            (initialize_call(part, names, system, may_return_early=may_return_early),)
            for part, names in zip(coupled.parts, coupled.recorded.names, strict=True)
        ],
        start,
    )
    _InitializationMode(group, coupled, start).propagate()
    get_outputs = get_outputs or [GetOutputs()] * len(coupled.parts)
    programs = [
        (ExitInitializationMode(), *calls)
        for calls in reading_calls(coupled, get_outputs, records=True)
    ]
    replies = group.execute_all(programs, start)
    outputs = gather(coupled, replies, 1 + max(get.order for get in get_outputs))
    bad = first_not_finite(outputs.y[0])
    if bad is not None:
        name = coupled.output_names[bad]
        raise SlaveError(f"{name} is not finite", phase="initialization", time=start)
    return outputs


def initialize_call(
    part: SlavePart,
    recorded: tuple[str, ...],
    system: System,
    *,
    may_return_early: bool = False,
) -> Initialize:
    """Call that initializes a slave, which returns early at events only if it can go back."""
    simulation = system.simulation
    return Initialize(
        start_time=float(simulation.start_time),
        stop_time=simulation.end,
        relative_tolerance=simulation.slave_relative_tolerance,
        start_values=part.start_values,
        inputs=part.inputs,
        outputs=part.outputs,
        discrete_inputs=part.discrete_inputs,
        discrete_outputs=part.discrete_outputs,
        early_return=may_return_early and part.description.state_kind is not StateKind.NONE,
        recorded=recorded,
    )


class _InitializationMode:
    """Hands outputs on to inputs while all slaves are in initialization mode."""

    def __init__(self, group: SlaveGroup, coupled: CoupledSystem, start: float) -> None:
        self._group = group
        self._coupled = coupled
        self._start = start
        self._external = coupled.external.at(start)[np.newaxis]

    def propagate(self) -> None:
        """Set all inputs to what belongs to the outputs, after enough rounds for every level."""
        coupled, order = self._coupled, self._coupled.initialization
        starts = np.concatenate([part.input_starts for part in coupled.parts])
        outputs = self._round([self._external_inputs(part, starts) for part in coupled.parts])
        if order.loop:
            self._iterate(outputs)
            return
        source_levels = order.levels[coupled.source]
        for level in range(order.highest + 1):
            u = np.where(source_levels <= level, coupled.inputs_of(outputs.y[0]), starts)
            outputs = self._round(self._inputs(u, self._known_discrete_inputs(outputs, level)))

    def _iterate(self, outputs: Outputs) -> None:
        """Fixed-point iteration for an algebraic loop across slaves."""
        coupled, discrete = self._coupled, self._coupled.discrete

        def again(y: FloatArray) -> FloatArray:
            nonlocal outputs
            outputs = self._round(
                self._inputs(coupled.inputs_of(y), discrete.held(y, outputs.d, self._start))
            )
            values: FloatArray = outputs.y[0]
            return values

        try:
            fixed_point(again, outputs.y[0], tolerance=_LOOP_TOLERANCE, evaluations=_LOOP_ROUNDS)
        except NoFixedPointError as error:
            raise SlaveError(
                f"the algebraic loop {' -> '.join(coupled.initialization.loop)} did not converge "
                f"in {_LOOP_ROUNDS} rounds; residuals: {self._residuals(error.residual)}",
                phase="initialization",
                time=self._start,
                remedy="break the loop, or give start values nearer to its solution",
            ) from None

    def _residuals(self, residual: FloatArray) -> str:
        """The largest ones, by the names of their outputs."""
        worst = np.argsort(-np.abs(residual))[:3]
        return ", ".join(f"{self._coupled.output_names[i]} {residual[i]:.3g}" for i in worst)

    def _external_inputs(self, part: SlavePart, starts: FloatArray) -> Program:
        """The calls that set what is known before any output is."""
        if not part.external:
            return ()
        return (SetInputs(part.columns(starts[np.newaxis], self._external)),)

    def _inputs(self, u: FloatArray, d: Held) -> list[Program]:
        """The calls that set all inputs of each slave."""
        d = d or ((),) * len(self._coupled.parts)
        return [
            (SetInputs(part.columns(u[np.newaxis], self._external)), *_discrete(values))
            for part, values in zip(self._coupled.parts, d, strict=True)
        ]

    def _known_discrete_inputs(self, outputs: Outputs, level: int) -> Held:
        """The discrete inputs, with start values for those whose outputs are of higher levels."""
        order, discrete = self._coupled.initialization, self._coupled.discrete

        def value(held: HeldInput) -> StartValue:
            if held.output is not None:
                source_level = order.discrete_levels[held.output]
            else:
                source_level = order.levels[held.continuous_output]
            if source_level > level and held.start is not None:
                return held.start
            return held.value(outputs.y[0], outputs.d, self._start)

        return tuple(
            (*map(value, inputs), *outside)
            for inputs, outside in zip(
                discrete.inputs, discrete.from_outside(self._start), strict=True
            )
        )

    def _round(self, programs: Sequence[Program]) -> Outputs:
        """Execute these calls and read all outputs."""
        reading = reading_calls(self._coupled, [GetOutputs()] * len(self._coupled.parts))
        replies = self._group.execute_all(
            [(*program, *calls) for program, calls in zip(programs, reading, strict=True)],
            self._start,
        )
        return gather(self._coupled, replies)


def _discrete(values: DiscreteValues) -> Program:
    return (SetDiscreteInputs(values),) if values else ()
