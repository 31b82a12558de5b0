"""From nested systems to slaves and connections between them.

A signal is followed from each input back through connectors of systems to the output that it comes
from; what lies on its way is composed into one transformation. A parameter is followed forwards
from where it is bound to the variables that it is for.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from master_node.ssp.parameters import transformed
from master_node.ssp.structure import (
    Component,
    ConnectionElement,
    Connector,
    Linear,
    Notes,
    Parameter,
    SystemElement,
    Unit,
    Value,
    listed,
)
from protocol.errors import ConfigurationError, DoublestepError
from protocol.keys import check_name
from protocol.names import nearest
from protocol.slave import SlaveDescription

Describe = Callable[[Path], SlaveDescription]

_Path = tuple[str, ...]
_Port = tuple[_Path, str]
_INWARD = frozenset({"input", "parameter", "structuralParameter"})


@dataclass(frozen=True)
class Slave:
    """A component with its place in the coupled system.

    Attributes:
        name: of the slave.
        model: the FMU file.
        parameters: start values by variable.
    """

    name: str
    model: Path
    parameters: Mapping[str, Value]


def flatten(
    system: SystemElement, describe: Describe, notes: Notes
) -> tuple[list[Slave], list[dict[str, Any]]]:
    """The slaves of a system and the tables of its connections, in the order of the document.

    Args:
        system: the root system.
        describe: gives the description of an FMU file; asked only where parameters are bound.
        notes: for what is not carried.

    Raises:
        ConfigurationError: a connection or a parameter cannot be carried, with file and line.
    """
    flattening = _Flattening(system, describe, notes)
    connections = flattening.connections()
    flattening.bind()
    flattening.tell_external_inputs()
    slaves = [
        Slave(flattening.names[path], component.model, flattening.parameters[path])
        for path, component in flattening.components.items()
    ]
    return slaves, connections


@dataclass(frozen=True)
class _Edge:
    """One connection with a direction."""

    source: _Port
    target: _Port
    element: ConnectionElement


class _Flattening:
    def __init__(self, root: SystemElement, describe: Describe, notes: Notes) -> None:
        self._notes = notes
        self._describe = describe
        self._systems = dict(_systems((), root))
        self.components: dict[_Path, Component] = dict(_in_document_order((), root))
        self.names = _slave_names(self.components, notes)
        self.parameters: dict[_Path, dict[str, Value]] = {p: {} for p in self.components}
        self._incoming: dict[_Port, _Edge] = {}
        self._outgoing: dict[_Port, list[_Edge]] = {}
        self._given: set[_Port] = set()
        for path, system in self._systems.items():
            for element in system.connections:
                self._add(self._edge(path, system, element))

    # ---- connections ----------------------------------------------------------------------------

    def connections(self) -> list[dict[str, Any]]:
        """The tables of all connections between components."""
        tables = []
        for edge in self._incoming.values():
            path, name = edge.target
            if path not in self.components:
                continue
            way = self._way_back(edge)
            source = way[0].source
            if source[0] not in self.components:
                continue
            kinds = (self._connector(source).kind, self._connector(edge.target).kind)
            if kinds != ("output", "input"):
                raise ConfigurationError(
                    f"{edge.element.place}: a connection from kind {kinds[0]!r} to kind "
                    f"{kinds[1]!r} of components is not supported",
                    remedy="connect outputs to inputs; give parameters as values",
                )
            table: dict[str, Any] = {
                "from": f"{self.names[source[0]]}.{source[1]}",
                "to": f"{self.names[path]}.{name}",
            }
            tables.append(table | self._transformation(way))
        return tables

    def _edge(self, path: _Path, system: SystemElement, element: ConnectionElement) -> _Edge:
        ends = [
            self._port(path, system, end, element.place) for end in (element.start, element.end)
        ]
        for port in ends:
            connector = self._connector(port)
            if connector.problem:
                raise ConfigurationError(
                    f"{element.place}: connector {connector.name!r} cannot be connected: "
                    f"{connector.problem}",
                    remedy="this version connects scalar variables",
                )
        # A connector of the system itself is seen from inside: its inputs are sources there.
        sources = [(port[0] == path) == (self._connector(port).kind in _INWARD) for port in ends]
        if sources[0] == sources[1]:
            kinds = " and ".join(repr(self._connector(port).kind) for port in ends)
            raise ConfigurationError(
                f"{element.place}: a connection of kinds {kinds} has no direction",
                remedy="connect an output with an input",
            )
        source, target = ends if sources[0] else reversed(ends)
        return _Edge(source, target, element)

    def _port(
        self, path: _Path, system: SystemElement, end: tuple[str | None, str], place: str
    ) -> _Port:
        element, connector = end
        if element is None:
            owner: Component | SystemElement = system
            port = (path, connector)
        else:
            if element not in system.elements:
                raise ConfigurationError(
                    f"{place}: no element {element!r}{nearest(element, system.elements)}"
                )
            owner = system.elements[element]
            port = ((*path, element), connector)
        if connector not in owner.connectors:
            raise ConfigurationError(
                f"{place}: {owner.name!r} has no connector {connector!r}"
                f"{nearest(connector, owner.connectors)}"
            )
        return port

    def _connector(self, port: _Port) -> Connector:
        path, name = port
        owner = self.components.get(path) or self._systems[path]
        return owner.connectors[name]

    def _add(self, edge: _Edge) -> None:
        if edge.target in self._incoming:
            raise ConfigurationError(
                f"{edge.element.place}: connector {edge.target[1]!r} has two sources; the other "
                f"one: {self._incoming[edge.target].element.place}"
            )
        self._incoming[edge.target] = edge
        self._outgoing.setdefault(edge.source, []).append(edge)

    def _way_back(self, edge: _Edge) -> list[_Edge]:
        """All connections from where a signal comes from to ``edge``, the first one first."""
        way = [edge]
        while (before := self._incoming.get(way[0].source)) is not None:
            if before in way:
                raise ConfigurationError(
                    f"{before.element.place}: the connection leads through systems back to itself"
                )
            way.insert(0, before)
        return way

    def _transformation(self, way: list[_Edge]) -> dict[str, Any]:
        """The keys of the connection table for what lies on the way of a signal."""
        elements = [edge.element for edge in way]
        for element in elements:
            if not isinstance(element.transformation, Linear | None):
                kind = getattr(element.transformation, "element", "a mapping transformation")
                raise ConfigurationError(
                    f"{element.place}: {kind} of a connection is not supported",
                    remedy="connect continuous variables, by a LinearTransformation",
                )
        if all(element.transformation is None for element in elements):
            suppressed = {element.suppress_unit_conversion for element in elements}
            if suppressed == {False}:
                return {}
            if suppressed == {True}:
                return {"ignore_units": True}
        linear = self._composed(way)
        return {"factor": linear.factor, "offset": linear.offset}

    def _composed(self, way: list[_Edge]) -> Linear:
        whole = Linear()
        unit = self._connector(way[0].source).unit
        assumed = False
        for edge in way:
            if not edge.element.suppress_unit_conversion:
                ends_here = edge is way[-1] and self._connector(edge.target).unit is None
                assumed |= unit is None or ends_here
            step, unit = self._step(edge, unit)
            whole = whole.then(step)
        if assumed:
            self._notes.tell(
                f"{way[-1].element.place}: the units of {way[0].source[1]!r} and "
                f"{way[-1].target[1]!r} are not both declared; they count as equal in the "
                "transformation"
            )
        return whole

    def _step(self, edge: _Edge, unit: Unit | None) -> tuple[Linear, Unit | None]:
        """What one connection does to a value in ``unit``, and the unit behind it."""
        element = edge.element
        target = self._connector(edge.target).unit
        step = Linear()
        if element.suppress_unit_conversion:
            unit = target
        elif unit is not None and target is not None:
            conversion = unit.to(target)
            if conversion is None:
                raise ConfigurationError(
                    f"{element.place}: unit {unit.name!r} cannot be converted to {target.name!r}",
                    remedy="correct the units, or say suppressUnitConversion",
                )
            step = conversion
        if isinstance(element.transformation, Linear):
            step = step.then(element.transformation)
        return step, target or unit

    # ---- parameters -----------------------------------------------------------------------------

    def bind(self) -> None:
        """Give every bound value to its variables; those of outer systems win."""
        for path, element in _innermost_first((), self._systems[()]):
            for binding in element.bindings:
                unknown = [p.name for p in binding.parameters if not self._give(path, p)]
                if unknown:
                    self._notes.tell(
                        f"{binding.place}: no variable of {element.name!r} has the name "
                        f"{listed(unknown)}; not applied"
                    )

    def tell_external_inputs(self) -> None:
        """Name inputs of the root system, which nothing can drive."""
        root = self._systems[()]
        external = [
            name
            for name, connector in root.connectors.items()
            if connector.kind == "input"
            and self._outgoing.get(((), name))
            and ((), name) not in self._given
        ]
        if external:
            self._notes.tell(
                f"{root.place}: inputs of the whole system {listed(external)}: nothing drives "
                "them; what they lead to keeps its start value"
            )

    def _give(self, path: _Path, parameter: Parameter) -> bool:
        """Give a value to all variables of a hierarchical name; False: there is none."""
        if path in self.components:
            return self._give_component(path, parameter)
        system = self._systems[path]
        found = False
        if parameter.name in system.connectors:
            self._give_connector((path, parameter.name), parameter)
            found = True
        for name in system.elements:
            if parameter.name.startswith(f"{name}."):
                inner = replace(parameter, name=parameter.name.removeprefix(f"{name}."))
                found |= self._give((*path, name), inner)
        return found

    def _give_component(self, path: _Path, parameter: Parameter) -> bool:
        try:
            description = self._describe(self.components[path].model)
        except DoublestepError as error:
            raise error.located(slave=self.names[path]) from None
        try:
            variable = description.variable(parameter.name)
        except KeyError:
            return False
        if parameter.unit and parameter.unit != variable.unit:
            self._notes.tell(
                f"{parameter.place}: the value for {self.names[path]}.{parameter.name} has the "
                f"unit {parameter.unit!r}, the variable {variable.unit or 'none'!r}; the number "
                "is taken as it is"
            )
        self.parameters[path][parameter.name] = parameter.usable()
        return True

    def _give_connector(self, port: _Port, parameter: Parameter) -> None:
        """Give a value to what a connector of a system leads to inside."""
        kind = self._connector(port).kind
        if kind not in _INWARD:
            raise ConfigurationError(
                f"{parameter.place}: a value for {port[1]!r}, a connector of kind {kind!r}, is "
                "not supported",
                remedy="give it to the component that the connector belongs to",
            )
        self._given.add(port)
        self._follow(port, parameter, {port})

    def _follow(self, port: _Port, parameter: Parameter, passed: set[_Port]) -> None:
        for edge in self._outgoing.get(port, ()):
            if edge.target in passed:
                continue
            passed.add(edge.target)
            behind = self._behind(edge, replace(parameter, name=edge.target[1]))
            if edge.target[0] not in self.components:
                self._follow(edge.target, behind, passed)
            elif not self._give_component(edge.target[0], behind):
                raise ConfigurationError(
                    f"{edge.element.place}: {self.names[edge.target[0]]!r} has no variable "
                    f"{behind.name!r}"
                )

    def _behind(self, edge: _Edge, parameter: Parameter) -> Parameter:
        """The parameter behind a connection, in the unit of its target where that is known."""
        transformation = edge.element.transformation
        source = self._connector(edge.source).unit
        expected = source or self._connector(edge.target).unit
        if expected is not None and parameter.unit not in ("", expected.name):
            self._notes.tell(
                f"{parameter.place}: the value has the unit {parameter.unit!r}, connector "
                f"{edge.source[1]!r} {expected.name!r}; the number is taken as it is"
            )
        if not isinstance(transformation, Linear | None):
            return transformed(parameter, transformation)
        step, unit = self._step(edge, source)
        return replace(transformed(parameter, step), unit=unit.name if unit else parameter.unit)


def _systems(path: _Path, system: SystemElement) -> Iterator[tuple[_Path, SystemElement]]:
    yield path, system
    for name, element in system.elements.items():
        if isinstance(element, SystemElement):
            yield from _systems((*path, name), element)


def _in_document_order(path: _Path, system: SystemElement) -> Iterator[tuple[_Path, Component]]:
    for name, element in system.elements.items():
        if isinstance(element, Component):
            yield (*path, name), element
        else:
            yield from _in_document_order((*path, name), element)


def _innermost_first(
    path: _Path, element: Component | SystemElement
) -> Iterator[tuple[_Path, Component | SystemElement]]:
    if isinstance(element, SystemElement):
        for name, inner in element.elements.items():
            yield from _innermost_first((*path, name), inner)
    yield path, element


def _slave_names(components: Mapping[_Path, Component], notes: Notes) -> dict[_Path, str]:
    """Names of slaves: the path below the root, joined by dots."""
    names: dict[_Path, str] = {}
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
