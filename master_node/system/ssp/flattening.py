"""From nested systems to slaves and connections between them.

A signal is followed from each input back through connectors of systems, and entries of signal
dictionaries, to the output that it comes from; what lies on its way is composed into one
transformation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from master_node.system.ssp.binding import Describe, ParameterBinder
from master_node.system.ssp.graph import OPEN, Edge, Port, SignalGraph, numbered
from master_node.system.ssp.graph import Path as ElementPath
from master_node.system.ssp.structure import (
    Component,
    Linear,
    Notes,
    SystemElement,
    Table,
    Transformation,
    Unit,
    Value,
)
from master_node.system.ssp.transformations import name_of
from protocol.errors import ConfigurationError
from protocol.text.names import listed
from protocol.wire.keys import check_name

_SOURCES = {"output", "local", "calculatedParameter", *OPEN}
"""Kinds of connectors of components that feed inputs."""


@dataclass(frozen=True)
class Slave:
    """A component with its place in the coupled system.

    Attributes:
        name: of the slave.
        model: the FMU.
        parameters: start values by variable.
        place: file and line of the component.
        parameter_places: file and line of each start value.
    """

    name: str
    model: Path
    parameters: Mapping[str, Value]
    place: str
    parameter_places: Mapping[str, str]


class FlatConnection(NamedTuple):
    """A connection between slaves.

    Attributes:
        table: of the system file.
        place: file and line of the element that leads to the input.
    """

    table: dict[str, Any]
    place: str


def flatten(
    system: SystemElement, describe: Describe, notes: Notes
) -> tuple[list[Slave], list[FlatConnection]]:
    """The slaves of a system and the connections between them, in the order of the document.

    Args:
        system: the root system.
        describe: gives the description of an FMU; asked only where parameters are bound.
        notes: for what is not carried.

    Raises:
        ConfigurationError: a connection or a parameter cannot be carried, with file and line.
    """
    graph = SignalGraph(system)
    if not graph.components:
        raise ConfigurationError(
            f"{system.place}: ssd:System {system.name!r} has no ssd:Component, so there is nothing "
            "to simulate",
            remedy="add the components, or choose another variant of the package",
        )
    names = _slave_names(graph.components, notes)
    flattening = _Flattening(graph, names, notes)
    connections = flattening.connections()
    binder = ParameterBinder(graph, names, describe, notes)
    binder.bind()
    flattening.tell_not_driven(binder.given)
    slaves = [
        Slave(
            names[path],
            component.model,
            {name: given.value for name, given in binder.parameters[path].items()},
            component.place,
            {name: given.place for name, given in binder.parameters[path].items()},
        )
        for path, component in graph.components.items()
    ]
    return slaves, connections


class _Flattening:
    def __init__(self, graph: SignalGraph, names: Mapping[ElementPath, str], notes: Notes) -> None:
        self._graph = graph
        self._names = names
        self._notes = notes
        self._not_driven: dict[Port, Edge] = {}

    def connections(self) -> list[FlatConnection]:
        """All connections between components."""
        found = []
        for edge in self._graph.incoming.values():
            path, name = edge.target
            if path not in self._graph.components:
                continue
            way = self._graph.way_to(edge)
            source = way[0].source
            if source[0] not in self._graph.components:
                self._not_driven.setdefault(source, way[0])
                continue
            kinds = (way[0].source_connector.kind, edge.target_connector.kind)
            if kinds[0] not in _SOURCES or kinds[1] not in {"input", *OPEN}:
                raise ConfigurationError(
                    f"{edge.element.place}: a connection from kind {kinds[0]!r} to kind "
                    f"{kinds[1]!r} of components is not supported",
                    remedy="connect outputs, local variables or calculated parameters to inputs; "
                    "give parameters as values",
                )
            table: dict[str, Any] = {
                "from": f"{self._names[source[0]]}.{source[1]}",
                "to": f"{self._names[path]}.{name}",
            }
            found.append(FlatConnection(table | self._transformation(way), edge.element.place))
        return found

    def tell_not_driven(self, given: set[Port]) -> None:
        """Name connectors and entries that feed inputs and get no signal.

        Args:
            given: those that got a value by a parameter binding.
        """
        root = self._graph.systems[()]
        external = []
        for port, edge in self._not_driven.items():
            connector = edge.source_connector
            if port in given or connector.kind in ("parameter", "structuralParameter"):
                continue
            if port[0]:
                self._notes.tell(
                    f"{edge.element.place}: nothing drives {self._graph.shown(port)}; what it "
                    "leads to keeps its start value"
                )
            elif (port[0], connector.name) not in given and connector.name not in external:
                external.append(connector.name)
        if external:
            self._notes.tell(
                f"{root.place}: inputs of the whole system {listed(external)}: nothing drives "
                "them; what they lead to keeps its start value"
            )

    def _transformation(self, way: list[Edge]) -> dict[str, Any]:
        """The keys of the connection table for what lies on the way of a signal."""
        self._compare_mime_types(way)
        steps = [numbered(edge) for edge in way]
        tables = [step for step in steps if isinstance(step, Table)]
        if tables:
            return {"mapping": self._mapping(way, steps, tables)}
        elements = [edge.element for edge in way]
        if all(step is None for step in steps):
            suppressed = {element.suppress_unit_conversion for element in elements}
            if suppressed == {False}:
                return {}
            if suppressed == {True}:
                return {"ignore_units": True}
        linear = self._composed(way)
        return {"factor": linear.factor, "offset": linear.offset}

    def _mapping(
        self, way: list[Edge], steps: list[Linear | Table | None], tables: list[Table]
    ) -> dict[int, int]:
        whole = tables[0]
        for table in tables[1:]:
            whole = whole.then(table)
        others: list[Transformation] = [step for step in steps if isinstance(step, Linear)]
        others += [table for table in tables if table.is_boolean != whole.is_boolean]
        if others:
            raise ConfigurationError(
                f"{way[-1].element.place}: {name_of(whole)} and {name_of(others[0])} lie on the "
                "way of one signal, and there are no values for both",
                remedy="keep the one that is for the type of the connected variables",
            )
        return dict(whole.entries)

    def _compare_mime_types(self, way: list[Edge]) -> None:
        one, other = way[0].source_connector.mime_type, way[-1].target_connector.mime_type
        if one and other and one != other:
            self._notes.tell(
                f"{way[-1].element.place}: the binaries of {way[0].source[1]!r} and "
                f"{way[-1].target[1]!r} are of mime-type {one!r} and {other!r}; they are handed on "
                "as they are"
            )

    def _composed(self, way: list[Edge]) -> Linear:
        whole = Linear()
        unit = way[0].source_connector.unit
        assumed = False
        for edge in way:
            given = edge.source_connector.unit
            if unit is not None and given is not None and unit != given:
                whole = whole.then(_conversion(edge, unit, given))  # by a signal dictionary
                unit = given
            if not edge.element.suppress_unit_conversion:
                ends_here = edge is way[-1] and edge.target_connector.unit is None
                assumed |= unit is None or ends_here
            step, unit = _step(edge, unit)
            whole = whole.then(step)
        if assumed:
            self._notes.tell(
                f"{way[-1].element.place}: the units of {way[0].source[1]!r} and "
                f"{way[-1].target[1]!r} are not both declared; they count as equal in the "
                "transformation"
            )
        return whole


def _step(edge: Edge, unit: Unit | None) -> tuple[Linear, Unit | None]:
    """Transformation of one connection for a value in ``unit``, and the unit behind it."""
    target = edge.target_connector.unit
    step = Linear()
    if edge.element.suppress_unit_conversion:
        unit = target
    elif unit is not None and target is not None:
        step = _conversion(edge, unit, target)
    if isinstance(edge.element.transformation, Linear):
        step = step.then(edge.element.transformation)
    return step, target or unit


def _conversion(edge: Edge, unit: Unit, target: Unit) -> Linear:
    conversion = unit.to(target)
    if conversion is None:
        raise ConfigurationError(
            f"{edge.element.place}: unit {unit.name!r} cannot be converted to {target.name!r}",
            remedy="correct the units, or say suppressUnitConversion",
        )
    return conversion


def _slave_names(
    components: Mapping[ElementPath, Component], notes: Notes
) -> dict[ElementPath, str]:
    """Names of slaves: the path below the root, joined by dots."""
    names: dict[ElementPath, str] = {}
    for path, component in components.items():
        whole = ".".join(path)
        name = re.sub(r"[^A-Za-z0-9_.-]", "_", whole)
        if name != whole:
            notes.tell(f"{component.place}: {whole!r} is called {name!r} here")
        try:
            check_name(name)
        except ConfigurationError as error:
            raise ConfigurationError(
                f"{component.place}: {error.cause}", remedy=error.remedy
            ) from None
        if name in names.values():
            raise ConfigurationError(
                f"{component.place}: two components get the name {name!r}",
                remedy="rename one of them, or the system that it is in",
            )
        names[path] = name
    return names
