"""Nested systems as one graph of signals, with a direction for each connection.

A port is a path of names from the root system and the name of a connector there, or of an element
of its array. The entries of signal dictionaries are ports too.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

from master_node.system.ssp.structure import (
    Component,
    ConnectionElement,
    Connector,
    Dictionary,
    DictionaryReference,
    ItemTable,
    Linear,
    SystemElement,
    Table,
    element_name,
)
from protocol.errors import ConfigurationError
from protocol.text.names import nearest

Path = tuple[str, ...]
Port = tuple[Path, str]
INWARD = frozenset({"input", "parameter", "structuralParameter"})
MAX_EDGES = 1_000_000
OPEN = frozenset({"inout", "unspecified"})
"""Kinds whose direction is that of what they are connected to."""


@dataclass(frozen=True, slots=True)
class Edge:
    """One connection, or what it does to one element of arrays, with a direction."""

    source: Port
    target: Port
    source_connector: Connector
    target_connector: Connector
    element: ConnectionElement


@dataclass(frozen=True, slots=True)
class _End:
    """One end of a connection.

    Attributes:
        is_source: whether it gives a signal to the other end; None: either.
        shown: what to call it in messages.
    """

    path: Path
    connector: Connector
    indices: tuple[int, ...]
    is_source: bool | None
    shown: str

    def port(self, indices: tuple[int, ...]) -> Port:
        """The port of the end, or of one element of its array."""
        return self.path, element_name(self.connector.name, self.indices or indices)


class SignalGraph:
    """Graph of the signals between the components.

    Args:
        root: the root system.

    Attributes:
        systems, components, references: all of them by path; components in document order.
        incoming: the one edge that leads to a port.
        outgoing: the edges that lead away from a port.
        is_by_elements: whether any connection is of single elements of an array, so that all
            connections of arrays are there once for each element.

    Raises:
        ConfigurationError: a connection has no direction, a wrong end, or a second source.
    """

    def __init__(self, root: SystemElement) -> None:
        self.systems: dict[Path, SystemElement] = {}
        self.components: dict[Path, Component] = {}
        self.references: dict[Path, DictionaryReference] = {}
        self._collect((), root)
        self._dictionaries = {path: self._dictionary(path) for path in self.references}
        self.is_by_elements = any(
            element.start_indices or element.end_indices
            for system in self.systems.values()
            for element in system.connections
        )
        self.incoming: dict[Port, Edge] = {}
        self.outgoing: dict[Port, list[Edge]] = {}
        for path, system in self.systems.items():
            for element in system.connections:
                for edge in self._edges(path, system, element):
                    self._add(edge)
                if len(self.incoming) > MAX_EDGES:
                    raise ConfigurationError(
                        f"{element.place}: more than {MAX_EDGES} connections, counting each "
                        "element of an array",
                        remedy="connect whole arrays, or remove connections of single elements",
                    )

    def way_to(self, edge: Edge) -> list[Edge]:
        """All connections from where a signal comes from to ``edge``, the first one first.

        Raises:
            ConfigurationError: the way leads back to itself.
        """
        way = [edge]
        while (before := self.incoming.get(way[0].source)) is not None:
            if before in way:
                raise ConfigurationError(
                    f"{before.element.place}: the connection leads through systems back to itself"
                )
            way.insert(0, before)
        return way

    def connector(self, path: Path, name: str) -> Connector | None:
        """The connector of a system, a component or a reference; None: it has none."""
        if path not in self.references:
            return (self.components.get(path) or self.systems[path]).connectors.get(name)
        connector = self.references[path].connectors.get(name)
        return connector and _as_entry(connector, self._dictionaries[path][1].entries[name])

    def entry(self, path: Path, name: str) -> Port:
        """The port of the entry that a connector of a reference stands for."""
        return self._dictionaries[path][0], name

    def shown(self, port: Port) -> str:
        """Name of a port in messages."""
        path, name = port
        if "" in path:
            return f"entry {name!r} of signal dictionary {path[-1]!r}"
        return f"connector {'.'.join((*path, name))!r}"

    def _collect(self, path: Path, element: SystemElement) -> None:
        self.systems[path] = element
        for name, inner in element.elements.items():
            match inner:
                case Component():
                    self.components[*path, name] = inner
                case DictionaryReference():
                    self.references[*path, name] = inner
                case SystemElement():
                    self._collect((*path, name), inner)

    def _dictionary(self, path: Path) -> tuple[Path, Dictionary]:
        """The dictionary of a reference: of its own system, or the nearest one around it."""
        reference = self.references[path]
        known: list[str] = []
        for length in reversed(range(len(path))):
            dictionaries = self.systems[path[:length]].dictionaries
            known += dictionaries
            if reference.dictionary in dictionaries:
                dictionary = dictionaries[reference.dictionary]
                break
        else:
            raise ConfigurationError(
                f"{reference.place}: no signal dictionary {reference.dictionary!r}"
                f"{nearest(reference.dictionary, known)}"
            )
        for connector in reference.connectors.values():
            if connector.name not in dictionary.entries:
                raise ConfigurationError(
                    f"{connector.place}: signal dictionary {dictionary.name!r} has no entry "
                    f"{connector.name!r}{nearest(connector.name, dictionary.entries)}"
                )
        # No element has an empty name, so this is the path of nothing else.
        return (*path[:length], "", dictionary.name), dictionary

    def _edges(
        self, path: Path, system: SystemElement, element: ConnectionElement
    ) -> Iterator[Edge]:
        ends = (
            self._end(path, system, element.start, element.start_indices, element.place),
            self._end(path, system, element.end, element.end_indices, element.place),
        )
        for end in ends:
            if end.connector.problem:
                raise ConfigurationError(
                    f"{element.place}: {end.shown} cannot be connected: {end.connector.problem}",
                    remedy="remove the connection: clocks of FMI 3.0 are not activated",
                )
        source, target = _directed(ends, element.place)
        for indices in self._all_indices(source, target, element.place):
            yield Edge(
                source.port(indices),
                target.port(indices),
                source.connector,
                target.connector,
                element,
            )

    def _end(
        self,
        path: Path,
        system: SystemElement,
        end: tuple[str | None, str],
        indices: tuple[int, ...],
        place: str,
    ) -> _End:
        name, connector_name = end
        if name is None:
            owner: Component | DictionaryReference | SystemElement = system
            port_path = path
        elif name in system.elements:
            owner = system.elements[name]
            port_path = (*path, name)
        else:
            raise ConfigurationError(
                f"{place}: no element {name!r}{nearest(name, system.elements)}"
            )
        connector = owner.connectors.get(connector_name)
        if connector is None:
            raise ConfigurationError(
                f"{place}: {owner.name!r} has no connector {connector_name!r}"
                f"{nearest(connector_name, owner.connectors)}"
            )
        # A connector of the system itself is seen from inside: its inputs are sources there.
        is_source = None if connector.kind in OPEN else (name is None) == (connector.kind in INWARD)
        shown = f"connector {connector.name!r} of kind {connector.kind!r}"
        if isinstance(owner, DictionaryReference):
            port_path, dictionary = self._dictionaries[port_path]
            connector = _as_entry(connector, dictionary.entries[connector.name])
        if indices and len(indices) != len(connector.dimensions):
            raise ConfigurationError(
                f"{place}: {len(indices)} indices for {shown}, which has "
                f"{len(connector.dimensions)} dimensions",
                remedy="give one index for each dimension",
            )
        for index, size in zip(indices, connector.dimensions, strict=False):
            if size is not None and index > size:
                raise ConfigurationError(f"{place}: {shown} has no index {index}, only {size}")
        return _End(port_path, connector, indices, is_source, shown)

    def _all_indices(self, source: _End, target: _End, place: str) -> Iterator[tuple[int, ...]]:
        """One tuple of indices for each element that is connected; () for the whole."""
        shapes = [() if end.indices else end.connector.dimensions for end in (source, target)]
        sizes = [
            one if other is None else other for one, other in zip(*shapes, strict=False)
        ]  # of either end, as far as they are declared
        if len(shapes[0]) != len(shapes[1]) or any(
            size not in (None, known)
            for shape in shapes
            for size, known in zip(shape, sizes, strict=True)
        ):
            raise ConfigurationError(
                f"{place}: {source.shown} and {target.shown} have different dimensions: "
                f"{shape(shapes[0])} and {shape(shapes[1])}",
                remedy="connect arrays of one size, or elements by startIndices and endIndices",
            )
        if not self.is_by_elements:
            yield ()
            return
        ranges = []
        for size in sizes:
            if size is None:
                raise ConfigurationError(
                    f"{place}: the size of {source.shown} is not declared",
                    remedy="give size in its Dimension: elements of arrays are connected here",
                )
            ranges.append(range(1, size + 1))
        yield from itertools.product(*ranges)

    def _add(self, edge: Edge) -> None:
        if edge.target in self.incoming:
            raise ConfigurationError(
                f"{edge.element.place}: {self.shown(edge.target)} has two sources; the other one: "
                f"{self.incoming[edge.target].element.place}"
            )
        self.incoming[edge.target] = edge
        self.outgoing.setdefault(edge.source, []).append(edge)


def _directed(ends: tuple[_End, _End], place: str) -> tuple[_End, _End]:
    """Source and target."""
    first, second = ends
    is_first = first.is_source
    if is_first is None and second.is_source is not None:
        is_first = not second.is_source
    if is_first is None or is_first is second.is_source:
        kinds = " and ".join(repr(end.connector.kind) for end in ends)
        raise ConfigurationError(
            f"{place}: a connection of kinds {kinds} has no direction",
            remedy="connect an output with an input",
        )
    return (first, second) if is_first else (second, first)


def _as_entry(connector: Connector, entry: Connector) -> Connector:
    """The connector of a reference, with what only the entry of the dictionary says."""
    return replace(
        connector,
        unit=connector.unit or entry.unit,
        items=connector.items or entry.items,
        dimensions=connector.dimensions or entry.dimensions,
        mime_type=connector.mime_type or entry.mime_type,
        problem=connector.problem or entry.problem,
    )


def shape(dimensions: tuple[int | None, ...]) -> str:
    """Dimensions for a message."""
    return " x ".join("?" if size is None else str(size) for size in dimensions) or "one value"


def numbered(edge: Edge) -> Linear | Table | None:
    """The transformation of a connection, items of enumerations by their numbers.

    Raises:
        ConfigurationError: an item has no number.
    """
    transformation = edge.element.transformation
    if not isinstance(transformation, ItemTable):
        return transformation
    ends = (edge.source_connector, edge.target_connector)
    for connector, names in (
        (ends[0], list(transformation.entries.keys())),
        (ends[1], list(transformation.entries.values())),
    ):
        for name in names:
            if name not in connector.items:
                raise ConfigurationError(
                    f"{edge.element.place}: EnumerationMappingTransformation: connector "
                    f"{connector.name!r} has no item {name!r}{nearest(name, connector.items)}",
                    remedy="give both connectors an ssc:Enumeration of ssd:Enumerations with "
                    "these items, or map numbers by an IntegerMappingTransformation",
                )
    return transformation.numbered(*(connector.items for connector in ends))
