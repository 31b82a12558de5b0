"""Slaves and connections -> index arrays: the coupled system as the algorithm sees it.

u = c(y) of the paper, equation (1b), is here ``y[source]``: each connected input takes the value
of one output.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter

import numpy as np
from numpy.typing import NDArray

from master_node.configuration import Connection, SlaveSettings, System
from protocol.errors import ConfigurationError
from protocol.names import nearest
from protocol.signals import FloatArray
from protocol.slave import Causality, SlaveDescription, Variable, VariableType


@dataclass(frozen=True)
class SlavePart:
    """One slave's part of the whole.

    Attributes:
        inputs, outputs: names of its connected inputs and of its continuous real outputs.
        input_slice, output_slice: where they are in u and y.
        input_starts: start values of the connected inputs, shape (len(inputs),).
        description: as the slave gave it.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    input_slice: slice
    output_slice: slice
    input_starts: FloatArray
    description: SlaveDescription


@dataclass(frozen=True)
class FeedThroughOrder:
    """In which order outputs follow from inputs that follow from outputs.

    Attributes:
        levels: the outputs of level l depend on connected inputs fed by outputs of lower levels
            only; shape (m,); empty if there is an algebraic loop.
        loop: ``slave.variable`` along an algebraic loop, else empty.
    """

    levels: NDArray[np.intp]
    loop: tuple[str, ...]


@dataclass(frozen=True)
class CoupledSystem:
    """r slaves, m outputs, n connected inputs.

    Attributes:
        parts: the slaves in the order of the system file.
        source: for each connected input the index of its output, shape (n,).
        output_names, output_units: ``slave.variable`` and units of the m outputs.
        output_slave: for each output the index of its slave, shape (m,).
        feed_through: whether an output depends directly on a connected input, shape (m,).
        absolute_tolerance: ATOL_j, scaled by the nominal values, shape (m,), unit [y].
        relative_tolerance: RTOL_j, shape (m,).
        initialization, at_point: the order in which values propagate through the slaves in
            initialization mode and at a communication point.
    """

    parts: tuple[SlavePart, ...]
    source: NDArray[np.intp]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    output_slave: NDArray[np.intp]
    feed_through: NDArray[np.bool_]
    absolute_tolerance: FloatArray
    relative_tolerance: FloatArray
    initialization: FeedThroughOrder
    at_point: FeedThroughOrder


def resolve(system: System, descriptions: Mapping[str, SlaveDescription]) -> CoupledSystem:
    """Check all names and types, and give every input and output its index.

    Raises:
        ConfigurationError: with the system's source, the table, and the nearest names.
    """
    ends = [_ends(system, i, c, descriptions) for i, c in enumerate(system.connections)]
    _check_parameters(system, descriptions)
    outputs = {
        name: tuple(v for v in description.of(Causality.OUTPUT) if v.is_continuous_real)
        for name, description in descriptions.items()
    }
    output_index = {
        (slave, variable.name): i
        for i, (slave, variable) in enumerate((s, v) for s in outputs for v in outputs[s])
    }
    if not output_index:
        raise ConfigurationError(
            f"{system.source}: no slave has a continuous real output: there is nothing to control"
        )
    feeding: dict[str, dict[str, tuple[str, str]]] = {name: {} for name in descriptions}
    for source, (slave, variable) in ends:
        feeding[slave][variable] = source
    parts = _parts(descriptions, feeding, outputs)
    sources = [feeding[part.name][variable] for part in parts for variable in part.inputs]
    everything = [(s, v) for s in outputs for v in outputs[s]]
    tolerances = [_tolerance(system, slave, v) for slave, v in everything]
    initial = {part.name: part.description.initial_feed_through for part in parts}
    direct = {part.name: part.description.feed_through for part in parts}
    slave_index = {name: i for i, name in enumerate(descriptions)}
    return CoupledSystem(
        parts=parts,
        source=np.array([output_index[source] for source in sources], dtype=np.intp),
        output_names=tuple(f"{slave}.{v.name}" for slave, v in everything),
        output_units=tuple(v.unit for _, v in everything),
        output_slave=np.array([slave_index[slave] for slave, _ in everything], dtype=np.intp),
        feed_through=np.array(
            [
                not set(part.description.feed_through.get(output, ())).isdisjoint(part.inputs)
                for part in parts
                for output in part.outputs
            ]
        ),
        absolute_tolerance=np.array([absolute for absolute, _ in tolerances]),
        relative_tolerance=np.array([relative for _, relative in tolerances]),
        initialization=_feed_through_order(output_index, initial, feeding),
        at_point=_feed_through_order(output_index, direct, feeding),
    )


def _parts(
    descriptions: Mapping[str, SlaveDescription],
    feeding: Mapping[str, Mapping[str, tuple[str, str]]],
    outputs: Mapping[str, tuple[Variable, ...]],
) -> tuple[SlavePart, ...]:
    parts = []
    n = m = 0
    for name, description in descriptions.items():
        inputs = [v for v in description.of(Causality.INPUT) if v.name in feeding[name]]
        parts.append(
            SlavePart(
                name=name,
                inputs=tuple(v.name for v in inputs),
                outputs=tuple(v.name for v in outputs[name]),
                input_slice=slice(n, n + len(inputs)),
                output_slice=slice(m, m + len(outputs[name])),
                input_starts=np.array([float(v.start or 0.0) for v in inputs]),
                description=description,
            )
        )
        n += len(inputs)
        m += len(outputs[name])
    return tuple(parts)


_End = tuple[str, str]


def _ends(
    system: System,
    number: int,
    connection: Connection,
    descriptions: Mapping[str, SlaveDescription],
) -> tuple[_End, _End]:
    """(slave, variable) of both ends of a connection, checked."""
    where = f"{system.source}: [[connections]] number {number + 1}"
    source, output = _variable(where, "from", connection.source, descriptions)
    target, input_ = _variable(where, "to", connection.target, descriptions)
    if output.causality is not Causality.OUTPUT:
        outputs = [v.name for v in descriptions[source].of(Causality.OUTPUT)]
        raise ConfigurationError(
            f"{where}: from = {connection.source!r} is not an output but of causality "
            f"{output.causality}{nearest(output.name, outputs)}"
        )
    if input_.causality is not Causality.INPUT:
        inputs = [v.name for v in descriptions[target].of(Causality.INPUT)]
        raise ConfigurationError(
            f"{where}: to = {connection.target!r} is not an input but of causality "
            f"{input_.causality}{nearest(input_.name, inputs)}"
        )
    if output.type is not input_.type:
        raise ConfigurationError(
            f"{where}: {connection.source} is of type {output.type}, "
            f"{connection.target} of type {input_.type}"
        )
    for name, variable in ((connection.source, output), (connection.target, input_)):
        if variable.type is not VariableType.REAL or not output.is_continuous_real:
            raise ConfigurationError(
                f"{where}: {name} is a {variable.variability} variable of type {variable.type}; "
                "this version couples continuous variables of type Real"
            )
    for earlier in system.connections[:number]:
        if earlier.target == connection.target:
            raise ConfigurationError(
                f"{where}: {connection.target} is driven twice: by {earlier.source} and by "
                f"{connection.source}"
            )
    return (source, output.name), (target, input_.name)


def _variable(
    where: str, key: str, reference: str, descriptions: Mapping[str, SlaveDescription]
) -> tuple[str, Variable]:
    """The slave and the variable that ``slave.variable`` means; both names may hold dots."""
    candidates = [name for name in descriptions if reference.startswith(f"{name}.")]
    if not candidates:
        slave = reference.partition(".")[0]
        raise ConfigurationError(
            f"{where}: {key} = {reference!r}: no slave {slave!r}{nearest(slave, descriptions)}"
        )
    for slave in sorted(candidates, key=len, reverse=True):
        name = reference[len(slave) + 1 :]
        try:
            return slave, descriptions[slave].variable(name)
        except KeyError:
            continue
    slave = max(candidates, key=len)
    name = reference[len(slave) + 1 :]
    names = [v.name for v in descriptions[slave].variables]
    raise ConfigurationError(
        f"{where}: {key} = {reference!r}: {slave} has no variable {name!r}{nearest(name, names)}"
    )


def _check_parameters(system: System, descriptions: Mapping[str, SlaveDescription]) -> None:
    for slave, settings in system.slaves.items():
        names = [v.name for v in descriptions[slave].variables]
        outputs = [v.name for v in descriptions[slave].of(Causality.OUTPUT)]
        for table, given, known in (
            ("parameters", settings.parameters, names),
            ("tolerances", settings.tolerances, outputs),
        ):
            for name in given:
                if name not in known:
                    raise ConfigurationError(
                        f"{system.source}: [slaves.{slave}.{table}] {name!r}: "
                        f"no such variable{nearest(name, known)}"
                    )


def _tolerance(system: System, slave: str, variable: Variable) -> tuple[float, float]:
    """ATOL_j and RTOL_j: of the output, else of its slave, else of the simulation."""
    settings: SlaveSettings = system.slaves[slave]
    own = settings.tolerances.get(variable.name)
    simulation = system.simulation
    absolute = [own.absolute] if own else []
    relative = [own.relative] if own else []
    absolute += [settings.absolute_tolerance, simulation.absolute_tolerance]
    relative += [settings.relative_tolerance, simulation.relative_tolerance]
    atol = next(value for value in absolute if value is not None)
    rtol = next(value for value in relative if value is not None)
    return atol * variable.nominal, rtol


def _feed_through_order(
    output_index: Mapping[_End, int],
    feed_through: Mapping[str, Mapping[str, tuple[str, ...]]],
    feeding: Mapping[str, Mapping[str, _End]],
) -> FeedThroughOrder:
    depends = {
        (slave, output): [
            feeding[slave][name]
            for name in feed_through[slave].get(output, ())
            if name in feeding[slave]
        ]
        for slave, output in output_index
    }
    levels = np.zeros(len(output_index), dtype=np.intp)
    try:
        for output in TopologicalSorter(depends).static_order():
            below = [levels[output_index[source]] + 1 for source in depends[output]]
            levels[output_index[output]] = max(below, default=0)
    except CycleError as error:
        loop = tuple(f"{slave}.{variable}" for slave, variable in error.args[1])
        return FeedThroughOrder(np.empty(0, dtype=np.intp), loop)
    return FeedThroughOrder(levels, ())
