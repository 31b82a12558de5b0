"""Coupling of slaves within a step: their sequence, input polynomials, outputs that are read.

Everything here follows from the connections, the slaves' capabilities and the settings, once,
before the first step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from master_node.coupling.coupled_system import CoupledSystem, SlavePart
from master_node.numerics.extrapolation import Extrapolation, InputKind
from master_node.observing.observers import NOT_CONTROLLED, OutputControl
from master_node.system.system import System
from protocol.calls import GetOutputs


@dataclass(frozen=True)
class CouplingScheme:
    """Facts of a system that the double step and the error estimates need.

    Attributes:
        groups: indices of the slaves that take a step at the same time, group after group: one
            group of all (Jacobi), or one slave in each (Gauss-Seidel).
        late_slaves: indices of the slaves that are in no group: they have no rollback, and take
            their steps when the double step of all others is accepted.
        extrapolation: the inputs' polynomials.
        input_rows: for each slave how many rows of input derivatives it takes at most.
        get_outputs: for each slave the call that reads its outputs, with the derivatives where
            they are of use.
        output_rows: 2 when outputs are read with derivatives, else 1.
        input_has_derivative: for each input whether its polynomial may meet derivatives, (n,).
        has_derivative: for each output whether its derivative is read and used, shape (m,).
        trusts_derivative: for each output whether its derivative, if it is read, says anything,
            shape (m,).
        feed_through: for each output whether it depends directly on extrapolated inputs, shape
            (m,).
        evaluated: indices of the slaves whose outputs are evaluated again at communication points.
        output_kinds: for each output the kinds of its slave's inputs of which a comparison
            solution can tell the error; empty without such inputs.
    """

    groups: tuple[tuple[int, ...], ...]
    late_slaves: tuple[int, ...]
    extrapolation: Extrapolation
    input_rows: tuple[int, ...]
    get_outputs: tuple[GetOutputs, ...]
    output_rows: int
    input_has_derivative: NDArray[np.bool_]
    has_derivative: NDArray[np.bool_]
    trusts_derivative: NDArray[np.bool_]
    feed_through: NDArray[np.bool_]
    evaluated: tuple[int, ...]
    output_kinds: tuple[frozenset[int], ...]

    @property
    def known_ahead(self) -> int:
        """Number of points at the end of a step that some inputs know before it: 0 or 1."""
        return int(len(self.groups) > 1)

    def open_loop(self, coupled: CoupledSystem) -> tuple[str, ...]:
        """An algebraic loop of which not all slaves are evaluated: its inputs are extrapolated.

        Returns:
            ``slave.variable`` along it; empty if there is none.
        """
        slaves = dict(zip(coupled.output_names, coupled.output_slave.tolist(), strict=True))
        loop = coupled.at_point.loop
        is_solved = all(slaves.get(name) in self.evaluated for name in loop)
        return () if is_solved else loop

    @staticmethod
    def of(coupled: CoupledSystem, system: System) -> CouplingScheme:
        """The scheme that ``system`` asks for, as far as the slaves can follow."""
        settings = system.simulation
        wanted = settings.polynomial
        late_slaves = _late_slaves(coupled, system)
        indices = [i for i in range(len(coupled.parts)) if i not in late_slaves]
        groups: tuple[tuple[int, ...], ...] = (tuple(indices),)
        if settings.sequence == "gauss-seidel":
            groups = tuple((i,) for i in indices)
        evaluated = _evaluated(coupled, system) if settings.evaluate_outputs else ()
        feed_through = coupled.feed_through & ~np.isin(
            coupled.output_slave, (*evaluated, *late_slaves)
        )
        used = [_used_derivatives(part, system) for part in coupled.parts]
        derivative_orders = [
            int(any(outputs)) if wanted.derivative_points else 0 for outputs in used
        ]
        reads_derivative = np.array(derivative_orders, dtype=bool)[coupled.output_slave]
        is_used = np.array([one for outputs in used for one in outputs], dtype=bool)
        has_derivative = (
            reads_derivative & is_used & ~coupled.feed_through & ~coupled.held_feed_through
        )
        sequence = (*groups, late_slaves)
        group_of_slave = {slave: i for i, group in enumerate(sequence) for slave in group}
        kinds: list[InputKind] = []
        kind_of_input = []
        for target, part in enumerate(coupled.parts):
            # Interpolated inputs meet values only: with the derivative at the end of the step a
            # polynomial of degree 1 errs as much in the comparison solution as in the other.
            for source in coupled.source[part.input_slice]:
                feeding = int(coupled.output_slave[source])
                ahead = group_of_slave[feeding] < group_of_slave[target]
                kind = InputKind(
                    max_order=min(part.max_order, wanted.order),
                    has_derivative=bool(has_derivative[source]) and not ahead,
                    ahead=ahead,
                    late=feeding in late_slaves and target not in late_slaves,
                )
                if kind not in kinds:
                    kinds.append(kind)
                kind_of_input.append(kinds.index(kind))
        kind_array = np.array(kind_of_input, dtype=np.intp)
        slave_kinds = [
            frozenset(i for i in kind_array[part.input_slice].tolist() if not kinds[i].late)
            if slave not in late_slaves
            else frozenset[int]()
            for slave, part in enumerate(coupled.parts)
        ]
        return CouplingScheme(
            groups=groups,
            late_slaves=late_slaves,
            extrapolation=Extrapolation(kinds or [InputKind(0)], kind_array),
            input_rows=tuple(part.max_order + 1 for part in coupled.parts),
            get_outputs=tuple(GetOutputs(order) for order in derivative_orders),
            output_rows=1 + max(derivative_orders),
            input_has_derivative=np.array(
                [kinds[i].has_derivative for i in kind_of_input], dtype=bool
            ),
            has_derivative=has_derivative,
            trusts_derivative=is_used,
            feed_through=feed_through,
            evaluated=evaluated,
            output_kinds=tuple(slave_kinds[slave] for slave in coupled.output_slave),
        )


def _used_derivatives(part: SlavePart, system: System) -> list[bool]:
    """For each output of a slave whether its derivative may be used."""
    if not part.max_output_derivative_order:
        return [False] * len(part.outputs)
    given = system.slaves[part.name].output_derivatives
    return [given is None or name in given for name in part.outputs]


def slaves_without_rollback(coupled: CoupledSystem) -> tuple[int, ...]:
    """Indices of the slaves whose state cannot be saved in any way."""
    return tuple(i for i, part in enumerate(coupled.parts) if part.description.state_kind == "none")


def output_control(coupled: CoupledSystem, system: System) -> OutputControl:
    """Outputs that are controlled, and how; none without an estimator."""
    if system.simulation.estimator == "none":
        return NOT_CONTROLLED
    without = slaves_without_rollback(coupled)
    with_defects = {
        slave
        for slave, part in enumerate(coupled.parts)
        if slave in without
        or np.isin(coupled.output_slave[coupled.source[part.input_slice]], without).any()
    }
    owners = [
        (name, slave)
        for name, slave, counts in zip(
            coupled.output_names,
            coupled.output_slave.tolist(),
            coupled.is_controlled.tolist(),
            strict=True,
        )
        if counts
    ]
    return OutputControl(
        double_step=tuple(name for name, slave in owners if slave not in without),
        input_defects=tuple(name for name, slave in owners if slave in with_defects),
    )


def _late_slaves(coupled: CoupledSystem, system: System) -> tuple[int, ...]:
    """Those that others take double steps before; none where no slave takes any."""
    slaves = slaves_without_rollback(coupled)
    is_mixed = system.simulation.estimator != "none" and len(slaves) < len(coupled.parts)
    return slaves if is_mixed else ()


def _evaluated(coupled: CoupledSystem, system: System) -> tuple[int, ...]:
    feed_through = coupled.feed_through | coupled.held_feed_through
    slaves: Sequence[int] = np.unique(coupled.output_slave[feed_through]).tolist()
    return tuple(slave for slave in slaves if outputs_follow_inputs(coupled.parts[slave], system))


def outputs_follow_inputs(part: SlavePart, system: System) -> bool:
    """True if a slave's outputs can be read again after its inputs were set, without a step."""
    stated = system.slaves[part.name].outputs_follow_inputs
    return part.description.capabilities.outputs_follow_inputs if stated is None else stated
