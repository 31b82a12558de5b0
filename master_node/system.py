"""Slaves and connections -> index arrays: the coupled system as the algorithm sees it.

u = c(y) of the paper, equation (1b), is here ``y[source]``: each connected input takes the value
of one output.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter

import numpy as np
from numpy.typing import NDArray

from master_node.configuration import Connection, SlaveSettings, System
from master_node.external_inputs import ExternalInput, ExternalInputs, SignalFunction
from master_node.input_loading import load_signals
from master_node.numerics.input_tables import Table
from protocol.errors import ConfigurationError
from protocol.names import nearest
from protocol.signals import MAX_ORDER, FloatArray
from protocol.slave import Causality, SlaveDescription, StartValue, Variable, VariableType

Signals = Mapping[str, StartValue | Table | SignalFunction]
"""What drives inputs from outside, by ``slave.variable``, see `load_signals`."""


@dataclass(frozen=True)
class SlavePart:
    """One slave's part of the whole.

    Attributes:
        inputs: names of its inputs that are driven: first the connected ones, then the external
            ones; these are the columns of what it is given.
        outputs: names of its continuous real outputs.
        input_slice, output_slice: where its connected inputs and its outputs are in u and y.
        external_slice: where its external inputs are among those of the system.
        external_rows: how many rows of derivatives these need at most.
        input_starts: start values of the connected inputs.
        description: as the slave gave it.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    input_slice: slice
    output_slice: slice
    external_slice: slice
    external_rows: int
    input_starts: FloatArray
    description: SlaveDescription

    @property
    def connected(self) -> tuple[str, ...]:
        """Names of its connected inputs."""
        return self.inputs[: self.input_slice.stop - self.input_slice.start]

    @property
    def external(self) -> tuple[str, ...]:
        """Names of its external inputs."""
        return self.inputs[self.input_slice.stop - self.input_slice.start :]

    @property
    def max_order(self) -> int:
        """The highest degree of input polynomial that it takes: 0 without canInterpolateInputs."""
        return _max_order(self.description)

    def columns(self, connected: FloatArray, external: FloatArray) -> FloatArray:
        """Its inputs out of those of the system.

        Args:
            connected: derivatives of all connected inputs, shape (rows, n).
            external: of all external inputs, shape (4, n_e).

        Returns:
            Derivatives of ``inputs``, shape (rows, len(inputs)), with more rows where the external
            inputs need them.
        """
        own = connected[:, self.input_slice]
        if not self.external_rows:
            return own
        outside = external[: self.external_rows, self.external_slice]
        number = own.shape[1]
        both = np.zeros((max(len(own), len(outside)), number + outside.shape[1]))
        both[: len(own), :number] = own
        both[: len(outside), number:] = outside
        return both


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
    """r slaves, m outputs, n connected inputs, n_e external ones.

    Attributes:
        parts: the slaves in the order of the system file.
        source: for each connected input the index of its output, shape (n,).
        output_names, output_units: ``slave.variable`` and units of the m outputs.
        output_slave: for each output the index of its slave, shape (m,).
        feed_through: whether an output depends directly on a connected input, shape (m,).
        held_feed_through: whether it depends directly on an external input that changes, and that
            its slave holds constant in each step, shape (m,).
        absolute_tolerance: ATOL_j, scaled by the nominal values, shape (m,), unit [y].
        relative_tolerance: RTOL_j, shape (m,).
        initialization, at_point: the order in which values propagate through the slaves in
            initialization mode and at a communication point.
        external: the external inputs.
    """

    parts: tuple[SlavePart, ...]
    source: NDArray[np.intp]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    output_slave: NDArray[np.intp]
    feed_through: NDArray[np.bool_]
    held_feed_through: NDArray[np.bool_]
    absolute_tolerance: FloatArray
    relative_tolerance: FloatArray
    initialization: FeedThroughOrder
    at_point: FeedThroughOrder
    external: ExternalInputs


def resolve(
    system: System,
    descriptions: Mapping[str, SlaveDescription],
    signals: Signals | None = None,
) -> CoupledSystem:
    """Check all names and types, and give every input and output its index.

    Args:
        system: the settings.
        descriptions: of the slaves.
        signals: what drives the external inputs; None: loaded here.

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
    external = _external_inputs(
        system, descriptions, load_signals(system) if signals is None else signals
    )
    parts = _parts(descriptions, feeding, outputs, external)
    sources = [feeding[part.name][variable] for part in parts for variable in part.connected]
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
        feed_through=_depends(parts, {part.name: part.connected for part in parts}),
        held_feed_through=_depends(
            parts,
            {
                name: [
                    one.variable for one in external[name] if not one.is_constant and not one.degree
                ]
                for name in descriptions
            },
        ),
        absolute_tolerance=np.array([absolute for absolute, _ in tolerances]),
        relative_tolerance=np.array([relative for _, relative in tolerances]),
        initialization=_feed_through_order(output_index, initial, feeding),
        at_point=_feed_through_order(output_index, direct, feeding),
        external=ExternalInputs([one for name in descriptions for one in external[name]]),
    )


def _depends(parts: Sequence[SlavePart], inputs: Mapping[str, Sequence[str]]) -> NDArray[np.bool_]:
    """Whether each output depends directly on one of these inputs of its slave, shape (m,)."""
    return np.array(
        [
            not set(part.description.feed_through.get(output, ())).isdisjoint(inputs[part.name])
            for part in parts
            for output in part.outputs
        ]
    )


def _max_order(description: SlaveDescription) -> int:
    return MAX_ORDER if description.capabilities.can_interpolate_inputs else 0


def _parts(
    descriptions: Mapping[str, SlaveDescription],
    feeding: Mapping[str, Mapping[str, tuple[str, str]]],
    outputs: Mapping[str, tuple[Variable, ...]],
    external: Mapping[str, Sequence[ExternalInput]],
) -> tuple[SlavePart, ...]:
    parts = []
    n = m = n_e = 0
    for name, description in descriptions.items():
        inputs = [v for v in description.of(Causality.INPUT) if v.name in feeding[name]]
        parts.append(
            SlavePart(
                name=name,
                inputs=(*(v.name for v in inputs), *(one.variable for one in external[name])),
                outputs=tuple(v.name for v in outputs[name]),
                input_slice=slice(n, n + len(inputs)),
                output_slice=slice(m, m + len(outputs[name])),
                external_slice=slice(n_e, n_e + len(external[name])),
                external_rows=max((1 + one.degree for one in external[name]), default=0),
                input_starts=np.array([float(v.start or 0.0) for v in inputs]),
                description=description,
            )
        )
        n += len(inputs)
        m += len(outputs[name])
        n_e += len(external[name])
    return tuple(parts)


def _external_inputs(
    system: System, descriptions: Mapping[str, SlaveDescription], signals: Signals
) -> dict[str, list[ExternalInput]]:
    """The external inputs of each slave, in the order of its variables."""
    found: dict[str, dict[str, ExternalInput]] = {name: {} for name in descriptions}
    feeding = {connection.target: connection.source for connection in system.connections}
    for reference, signal in signals.items():
        where = f"{system.source}: [inputs]"
        slave, variable = _variable(where, "key", reference, descriptions)
        if variable.causality is not Causality.INPUT:
            inputs = [v.name for v in descriptions[slave].of(Causality.INPUT)]
            raise ConfigurationError(
                f"{where}: {reference} is not an input but of causality "
                f"{variable.causality}{nearest(variable.name, inputs)}"
            )
        if reference in feeding:
            raise ConfigurationError(
                f"{where}: {reference} is driven twice: by {feeding[reference]} and from here"
            )
        absolute, relative = _tolerance(system, slave, variable)
        found[slave][variable.name] = ExternalInput(
            slave,
            variable.name,
            _driving(where, reference, variable, signal),
            _max_order(descriptions[slave]),
            absolute,
            relative,
        )
    return {
        name: [
            found[name][v.name] for v in description.of(Causality.INPUT) if v.name in found[name]
        ]
        for name, description in descriptions.items()
    }


def _driving(
    where: str, reference: str, variable: Variable, signal: StartValue | Table | SignalFunction
) -> float | Table | SignalFunction:
    """The signal, checked against the type of the variable that it drives."""
    if not variable.is_continuous_real:
        raise ConfigurationError(
            f"{where}: {reference} is a {variable.variability} variable of type {variable.type}; "
            "this version drives continuous variables of type Real"
        )
    if isinstance(signal, Table | SignalFunction):
        return signal
    if isinstance(signal, bool | str):
        raise ConfigurationError(
            f"{where}: {reference} is of type {variable.type} and cannot be {signal!r}"
        )
    return float(signal)


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
