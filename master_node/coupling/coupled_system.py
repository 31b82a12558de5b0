"""Slaves and connections -> index arrays: the coupled system as the algorithm sees it.

u = c(y) of the paper, equation (1b), is here ``factor * y[source] + offset``: each connected input
takes the value of one output, in its own unit. What is not continuous goes beside it, as values
that are held in each step (``discrete.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from master_node.coupling.connections import (
    ScalarConnection,
    VariableFinder,
    read_variables,
    resolve_connections,
)
from master_node.coupling.discrete import DiscreteCoupling, couple_discrete
from master_node.coupling.external import (
    Signals,
    SlaveExternals,
    max_order,
    resolve_external,
)
from master_node.coupling.feed_through import FeedThroughOrder, Key, feed_through_order
from master_node.coupling.overrides import OverriddenInputs
from master_node.coupling.recorded_variables import RecordedVariables, wanted_variables
from master_node.inputs.continuous import ExternalInputs, Jump
from master_node.inputs.loading import load_signals
from master_node.system.start_values import start_values
from master_node.system.system import System
from master_node.system.tolerances import tolerance
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError
from protocol.signals import FloatArray
from protocol.text.names import nearest
from protocol.variables import Causality, StartValue, Variable


@dataclass(frozen=True)
class SlavePart:
    """One slave's part of the whole.

    Attributes:
        inputs: names of its continuous inputs that are driven: first the connected ones, then the
            external ones; these are the columns of what it is given.
        outputs: names of its continuous real outputs, and of such variables that feed inputs.
        discrete_inputs, discrete_outputs: names of its other inputs, first the connected ones, then
            inputs and tunable parameters that change from outside, and of its other outputs.
        locals: those among its outputs that are none to the model, and feed inputs all the same.
        start_values: of its variables, with constants for its other external inputs, by name.
        input_slice, output_slice: where its connected inputs and its outputs are in u and y.
        external_slice: where its external inputs are among those of the system.
        external_rows: how many rows of derivatives these need at most.
        input_starts: start values of the connected inputs.
        description: as the slave gave it.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    discrete_inputs: tuple[str, ...]
    discrete_outputs: tuple[str, ...]
    locals: tuple[str, ...]
    start_values: dict[str, StartValue]
    input_slice: slice
    output_slice: slice
    external_slice: slice
    external_rows: int
    input_starts: FloatArray
    description: SlaveDescription

    @property
    def connected(self) -> tuple[str, ...]:
        """Names of its connected continuous inputs."""
        return self.inputs[: self.input_slice.stop - self.input_slice.start]

    @property
    def external(self) -> tuple[str, ...]:
        """Names of its external inputs."""
        return self.inputs[len(self.connected) :]

    @property
    def max_output_derivative_order(self) -> int:
        """Highest order of derivatives of all its outputs; 0 with locals: FMI has none for them."""
        return 0 if self.locals else self.description.capabilities.max_output_derivative_order

    @property
    def max_order(self) -> int:
        """The highest degree of input polynomial that it follows."""
        return max_order(self.description)

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
class CoupledSystem:
    """r slaves, m outputs, n connected inputs.

    Attributes:
        parts: the slaves in the order of the system file.
        source: for each connected input the index of its output, shape (n,).
        factor, offset: from the unit of that output to that of the input, shape (n,).
        output_names, output_units: ``slave.variable`` and units of the m outputs.
        output_slave: for each output the index of its slave, shape (m,).
        feed_through: whether an output depends directly on a connected input, shape (m,).
        absolute_tolerance: ATOL_j, scaled by the nominal values, shape (m,), unit [y].
        relative_tolerance: RTOL_j, shape (m,).
        is_controlled: whether an output counts in ERR, shape (m,).
        initialization, at_point: the order in which values propagate through the slaves in
            initialization mode and at a communication point.
        discrete: all connections and outputs that are not continuous.
        recorded: variables that are read for results only.
        external: the external inputs.
        held_feed_through: whether an output depends directly on an external input that changes
            and is held in each step, shape (m,).
        overrides: connected inputs that are cut from their sources now.
    """

    parts: tuple[SlavePart, ...]
    source: NDArray[np.intp]
    factor: FloatArray
    offset: FloatArray
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    output_slave: NDArray[np.intp]
    feed_through: NDArray[np.bool_]
    absolute_tolerance: FloatArray
    relative_tolerance: FloatArray
    is_controlled: NDArray[np.bool_]
    initialization: FeedThroughOrder
    at_point: FeedThroughOrder
    discrete: DiscreteCoupling
    recorded: RecordedVariables
    external: ExternalInputs
    held_feed_through: NDArray[np.bool_]
    overrides: OverriddenInputs

    @property
    def jumps(self) -> list[Jump]:
        """Jumps of all that drives inputs from outside, in order of time."""
        return sorted((*self.external.jumps, *self.discrete.jumps))

    @cached_property
    def _transforms(self) -> bool:
        return bool((self.factor != 1.0).any() or (self.offset != 0.0).any())

    def inputs_of(self, y: FloatArray) -> FloatArray:
        """The connected inputs that belong to outputs.

        Args:
            y: outputs, shape (m,), or with the derivatives in further rows, shape (rows, m).

        Returns:
            u, shape (n,) or (rows, n), in the units of the inputs.
        """
        u: FloatArray = y.take(self.source, axis=-1)
        if self._transforms:
            u *= self.factor
            u[0 if u.ndim > 1 else ...] += self.offset
        self.overrides.put_into(u)
        return u

    def controlled_scale(self, scale: FloatArray) -> FloatArray:
        """Tolerances of outputs, shape (m,), infinite for those that do not count in ERR."""
        return np.where(self.is_controlled, scale, np.inf)

    def changes_of_inputs(self, changes: FloatArray) -> FloatArray:
        """Changes of inputs, shape (..., n), that belong to those of outputs, shape (..., m)."""
        u: FloatArray = changes.take(self.source, axis=-1)
        return self.overrides.without_changes(u * self.factor if self._transforms else u)

    def scale_of_inputs(self, scale: FloatArray) -> FloatArray:
        """Tolerances of inputs, shape (n,), unit [u], from those of outputs, (m,), unit [y]."""
        taken: FloatArray = scale.take(self.source)
        return taken * np.abs(self.factor) if self._transforms else taken


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
    finder = VariableFinder(descriptions)
    connections = resolve_connections(system, finder)
    read = read_variables(descriptions, connections)
    _check_slave_tables(system, finder, read)
    outputs = {
        name: tuple(v for v in variables if v.is_continuous_real)
        for name, variables in read.items()
    }
    everything = [(slave, variable) for slave in outputs for variable in outputs[slave]]
    output_index = {(slave, variable.name): i for i, (slave, variable) in enumerate(everything)}
    is_controlled = np.array(
        [v.name not in system.slaves[slave].uncontrolled for slave, v in everything], dtype=np.bool_
    )
    if output_index and not is_controlled.any() and system.simulation.estimator != "none":
        raise ConfigurationError(
            f"{system.source}: all outputs are uncontrolled: there is nothing to control",
            remedy="use --estimator none with a fixed --step-size",
        )
    feeding: dict[str, dict[str, ScalarConnection]] = {name: {} for name in descriptions}
    for connection in connections:
        feeding[connection.target.slave][connection.target.variable.name] = connection
    overrides = OverriddenInputs()
    external = resolve_external(
        system, finder, connections, load_signals(system) if signals is None else signals
    )
    parts = _parts(system, descriptions, feeding, read, external)
    feeds = [feeding[part.name][variable] for part in parts for variable in part.connected]
    tolerances = [tolerance(system, slave, v) for slave, v in everything]
    initial, direct = (
        {
            (slave, variable.name): descriptions[slave].direct_inputs(variable, initially=initially)
            for slave, variables in read.items()
            for variable in variables
        }
        for initially in (True, False)
    )
    slave_index = {name: i for i, name in enumerate(descriptions)}
    discrete = couple_discrete(
        read,
        [
            [
                feeding[part.name][name]
                for name in part.discrete_inputs
                if name in feeding[part.name]
            ]
            for part in parts
        ],
        output_index,
        [external[part.name].driven for part in parts],
        overrides,
    )
    wanted = system.results
    recorded = RecordedVariables(
        wanted_variables(
            system.source,
            descriptions,
            {*output_index, *discrete.keys},
            wanted.locals,
            wanted.variables,
        ),
        len(discrete.keys),
        partial(tolerance, system),
    )
    return CoupledSystem(
        parts=parts,
        source=np.array([output_index[feed.source.key] for feed in feeds], dtype=np.intp),
        factor=np.array([feed.transformation.factor for feed in feeds], dtype=np.float64),
        offset=np.array([feed.transformation.offset for feed in feeds], dtype=np.float64),
        output_names=tuple(f"{slave}.{v.name}" for slave, v in everything),
        output_units=tuple(v.unit for _, v in everything),
        output_slave=np.array([slave_index[slave] for slave, _ in everything], dtype=np.intp),
        feed_through=_depends(parts, direct, {part.name: part.connected for part in parts}),
        absolute_tolerance=np.array([absolute for absolute, _ in tolerances]),
        relative_tolerance=np.array([relative for _, relative in tolerances]),
        is_controlled=is_controlled,
        initialization=feed_through_order(output_index, discrete, initial, feeding),
        at_point=feed_through_order(output_index, discrete, direct, feeding),
        discrete=discrete,
        recorded=recorded,
        external=ExternalInputs([one for each in external.values() for one in each.continuous]),
        held_feed_through=_depends(
            parts,
            direct,
            {
                name: [
                    one.variable
                    for one in each.continuous
                    if not one.is_constant and not one.degree
                ]
                for name, each in external.items()
            },
        ),
        overrides=overrides,
    )


def _depends(
    parts: Sequence[SlavePart],
    direct: Mapping[Key, tuple[str, ...]],
    inputs: Mapping[str, Sequence[str]],
) -> NDArray[np.bool_]:
    """True if each output depends directly on one of these inputs of its slave, shape (m,)."""
    names = [frozenset(inputs[part.name]) for part in parts]
    return np.array(
        [
            not own.isdisjoint(direct[part.name, output])
            for part, own in zip(parts, names, strict=True)
            for output in part.outputs
        ],
        dtype=np.bool_,
    )


def _parts(
    system: System,
    descriptions: Mapping[str, SlaveDescription],
    feeding: Mapping[str, Mapping[str, ScalarConnection]],
    read: Mapping[str, tuple[Variable, ...]],
    external: Mapping[str, SlaveExternals],
) -> tuple[SlavePart, ...]:
    parts = []
    n = m = n_e = 0
    for name, description in descriptions.items():
        settings = system.slaves[name]
        outputs = [v for v in read[name] if v.is_continuous_real]
        connected = [v for v in description.of(Causality.INPUT) if v.name in feeding[name]]
        inputs = [v for v in connected if feeding[name][v.name].is_continuous]
        parts.append(
            SlavePart(
                name=name,
                inputs=(
                    *(v.name for v in inputs),
                    *(one.variable for one in external[name].continuous),
                ),
                outputs=tuple(v.name for v in outputs),
                discrete_inputs=(
                    *(v.name for v in connected if not feeding[name][v.name].is_continuous),
                    *(one.variable for one in external[name].driven),
                ),
                discrete_outputs=tuple(v.name for v in read[name] if v.is_discrete),
                locals=tuple(v.name for v in read[name] if v.causality is not Causality.OUTPUT),
                start_values=external[name].held
                | start_values(
                    description,
                    settings.parameters,
                    partial(system.places.parameter, name),
                    ignores_bounds=settings.ignore_bounds,
                ),
                input_slice=slice(n, n + len(inputs)),
                output_slice=slice(m, m + len(outputs)),
                external_slice=slice(n_e, n_e + len(external[name].continuous)),
                external_rows=max((1 + one.degree for one in external[name].continuous), default=0),
                input_starts=np.array([float(v.start or 0.0) for v in inputs]),
                description=description,
            )
        )
        n += len(inputs)
        m += len(outputs)
        n_e += len(external[name].continuous)
    return tuple(parts)


def _check_slave_tables(
    system: System, finder: VariableFinder, read: Mapping[str, tuple[Variable, ...]]
) -> None:
    for slave, settings in system.slaves.items():
        outputs = [v.name for v in read[slave]]
        tables: list[tuple[Callable[[str, str], str], Mapping[str, object], Sequence[str]]] = [
            (system.places.parameter, settings.parameters, finder.names(slave)),
            (system.places.tolerance, settings.tolerances, outputs),
        ]
        lists = {
            "output_derivatives": settings.output_derivatives or (),
            "uncontrolled": settings.uncontrolled,
        }
        for key, listed in lists.items():
            for name in listed:
                if name not in outputs:
                    raise ConfigurationError(
                        f"{system.source}: [slaves.{slave}] {key}: no output {name!r}"
                        f"{nearest(name, outputs)}"
                    )
        for place, given, known in tables:
            names = frozenset(known)
            for name in given:
                if name not in names:
                    raise ConfigurationError(
                        f"{place(slave, name)}: no such variable{nearest(name, known)}"
                    )
