"""Check of a system: all that a run does before its first step, and a report of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import isfinite

from master_node.checking.loops import loops_of
from master_node.checking.report import (
    ConnectionReport,
    InputReport,
    SlaveReport,
    StateCosts,
    SystemReport,
)
from master_node.checking.state_costs import state_costs, state_remedy
from master_node.checking.step_bounds import step_bounds
from master_node.checking.warnings import gathered_warnings
from master_node.coupling.connections import ScalarConnection, VariableFinder, resolve_connections
from master_node.coupling.external import Signals
from master_node.coupling.scheme import CouplingScheme
from master_node.coupling.step_sizes import check_step_sizes
from master_node.coupling.type_casts import MappedCast
from master_node.hosts.agent_models import Uploading
from master_node.hosts.model_hashes import check_hashes
from master_node.hosts.opening import Slaves, opened_slaves
from master_node.inputs.continuous import SignalFunction
from master_node.inputs.loading import load_signals
from master_node.preparing.initialization import initialize
from master_node.preparing.readiness import Ready, make_ready
from master_node.slaves.shared_process import SharedProcess, shared_process
from master_node.system.system import System
from protocol.description import StateKind
from protocol.variables import Causality, StartValue, VariableType


def check_system(
    system: System,
    *,
    in_process: bool = False,
    launch: bool = True,
    uploading: Uploading | None = None,
) -> SystemReport:
    """Start the slaves of a system, initialize them, and end them again; no step of a run is taken.

    Slaves take the trial steps that they take before a run (``examine``), and go back.

    Args:
        system: slaves, connections and settings.
        in_process: run the slaves in this process, without a bus.
        launch: start slaves that have a model; False: find all of them on the bus.
        uploading: told of models that are sent to agents.

    Raises:
        DoublestepError: as `master_node.simulate` before its first step.
    """
    system = system.checked()
    check_step_sizes(system)
    with gathered_warnings() as warnings, shared_process() as baseline:
        signals = SharedProcess(baseline).run(load_signals, system)
        with opened_slaves(
            system,
            None,
            in_process=in_process,
            launch=launch,
            uploading=uploading,
            baseline=baseline,
        ) as slaves:
            check_hashes(system, slaves.descriptions)
            ready = make_ready(slaves.links, system, slaves.descriptions, signals)
            report = _report(ready, slaves, signals, in_process=in_process, launch=launch)
    return SystemReport(**vars(report) | {"warnings": tuple(warnings)})


def _report(
    ready: Ready, slaves: Slaves, signals: Signals, *, in_process: bool, launch: bool
) -> SystemReport:
    system, descriptions = ready.prepared.system, ready.prepared.descriptions
    outputs = ready.prepared.outputs
    if outputs is None:
        scheme = CouplingScheme.of(ready.coupled, system)
        outputs = initialize(ready.group, ready.coupled, system, scheme.get_outputs)
    finder = VariableFinder(descriptions)
    connections = resolve_connections(system, finder)
    costs = state_costs(ready)
    loops = tuple(loops_of(ready, connections, outputs))
    driven = {
        end.key: reference
        for reference in signals
        for end in finder.find(system.source, "[inputs]", reference)
    }
    settings = system.simulation

    def place(name: str) -> str:
        if in_process:
            return "in process"
        if not launch or system.slaves[name].model is None:
            return "found"
        return "agent" if system.slaves[name].needs_agent else "launched"

    feeding = {connection.source.key for connection in connections}
    return SystemReport(
        source=system.source,
        start_time=float(settings.start_time),
        stop_time=settings.end,
        estimator=settings.estimator,
        sequence=settings.sequence,
        coupling=settings.coupling,
        order=str(settings.order),
        slaves=tuple(
            _slave(ready, slaves, name, costs.get(name), place(name)) for name in descriptions
        ),
        connections=tuple(map(_connection, connections)),
        unconnected=tuple(_unconnected(ready, connections, driven, signals)),
        unused=tuple(
            f"{name}.{variable.name}"
            for name, description in descriptions.items()
            for variable in description.of(Causality.OUTPUT)
            if (name, variable.name) not in feeding
        ),
        loops=loops,
        bounds=tuple(step_bounds(ready, loops)),
        warnings=(),
    )


def _slave(
    ready: Ready, slaves: Slaves, name: str, costs: StateCosts | None, place: str
) -> SlaveReport:
    prepared = ready.prepared
    description, settings = prepared.descriptions[name], prepared.system.slaves[name]
    examination = prepared.examinations.get(name)
    part = next(part for part in ready.coupled.parts if part.name == name)
    is_native = description.state_kind is StateKind.NATIVE
    multiple = settings.step_multiple
    return SlaveReport(
        name=name,
        model=description.model,
        kind=description.kind,
        generation_tool=description.generation_tool,
        host=slaves.hosts[name],
        place=place,
        state_kind=str(description.state_kind),
        state_reason=description.state_reason,
        state_verdict="" if examination is None else str(examination.state_verdict),
        state_costs=costs,
        state_remedy="" if is_native else state_remedy(description.generation_tool),
        input_derivatives=str(description.input_derivatives),
        input_order=part.max_order,
        output_derivative_order=description.capabilities.max_output_derivative_order,
        internal_clock=None if examination is None else examination.internal_clock,
        step_multiple=None if multiple is None else float(multiple),
        inputs=len(description.of(Causality.INPUT)),
        outputs=len(description.of(Causality.OUTPUT)),
    )


def _connection(connection: ScalarConnection) -> ConnectionReport:
    source, target = connection.source.variable, connection.target.variable
    return ConnectionReport(
        source=connection.source.reference,
        target=connection.target.reference,
        source_unit=source.unit,
        target_unit=target.unit,
        factor=connection.transformation.factor,
        offset=connection.transformation.offset,
        cast="" if source.type is target.type else f"{source.type} to {target.type}",
        is_mapped=isinstance(connection.cast, MappedCast),
        is_continuous=connection.is_continuous,
    )


def _unconnected(
    ready: Ready,
    connections: Sequence[ScalarConnection],
    driven: Mapping[tuple[str, str], str],
    signals: Signals,
) -> Iterator[InputReport]:
    fed = {connection.target.key for connection in connections}
    system = ready.prepared.system
    for part in ready.coupled.parts:
        given = system.slaves[part.name].parameters
        for variable in part.description.of(Causality.INPUT):
            key = part.name, variable.name
            name = f"{part.name}.{variable.name}"
            if key in fed or variable.type is VariableType.CLOCK:
                continue
            if key in driven:
                signal = signals[driven[key]]
                is_constant = isinstance(signal, StartValue)
                yield InputReport(
                    name,
                    variable.unit,
                    _shown(signal) if isinstance(signal, StartValue) else None,
                    "[inputs]",
                    "" if is_constant else _kind_of(signal),
                )
                continue
            value = part.start_values.get(variable.name, variable.start)
            by = "parameters" if variable.name in given else "the model"
            yield InputReport(
                name, variable.unit, _shown(value), "nothing" if value is None else by
            )


def _kind_of(signal: object) -> str:
    return "a function" if isinstance(signal, SignalFunction) else "a table"


def _shown(value: StartValue | None) -> float | int | bool | str | None:
    """A value as JSON can hold it."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float) and not isfinite(value):
        return str(value)
    return value
