"""Definitions that several documents of SSP have: types with units, enumerations and dimensions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from master_node.system.ssp.structure import Connector, Unit
from master_node.system.ssp.xml_nodes import Node, integer, number
from protocol.text.names import nearest

MAX_ELEMENTS = 100_000
"""Largest number of elements of one array."""

_BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
_INTEGERS = tuple(f"{sign}Int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "U"))
_TYPES = tuple(
    f"ssc:{name}"
    for name in (
        *("Real", "Float64", "Float32", "Integer", *_INTEGERS),
        *("Boolean", "String", "Enumeration", "Binary"),
    )
)
_CLOCKS = ("ssd:Clock", "ssc:Clock", "ssd:ConnectorClock", "ssc:ConnectorClock")
_DIMENSIONS = ("ssc:Dimension", "ssd:Dimension", "ssv:Dimension", "ssb:Dimension")


@dataclass(frozen=True, slots=True)
class Definitions:
    """Definitions of one document.

    Attributes:
        units: by name.
        enumerations: numbers of items by name, by the enumeration's name.
    """

    units: Mapping[str, Unit]
    enumerations: Mapping[str, Mapping[str, int]]


def read_definitions(root: Node, prefix: str) -> Definitions:
    """The definitions of a document.

    Args:
        root: its root.
        prefix: of its namespace, such as ``ssd``.

    Raises:
        ConfigurationError: a name is there twice, or a number is wrong.
    """
    return Definitions(
        _units(root.child(f"{prefix}:Units")), _enumerations(root.child(f"{prefix}:Enumerations"))
    )


def read_connector(node: Node, kind: str, definitions: Definitions) -> Connector:
    """A connector, or an entry of a signal dictionary.

    Raises:
        ConfigurationError: it has several types, or wrong dimensions.
    """
    unit, items, mime_type, problem = None, {}, "", ""
    types = node.children(*_TYPES)
    if len(types) > 1:
        raise types[1].error("is a second type")
    for child in types:
        name = child.attribute("unit")
        if name and name not in definitions.units:
            near = nearest(name, definitions.units)
            child.tell(f"unit {name!r} is not in the Units of the file{near}; it counts as none")
        unit = definitions.units.get(name)
        items = dict(definitions.enumerations.get(child.attribute("name"), {}))
        mime_type = child.attribute("mime-type")
        child.done()
    if node.children(*_CLOCKS):
        problem = "a clock"
    dimensions = read_dimensions(node)
    return Connector(
        node.required("name"), kind, unit, items, dimensions, mime_type, problem, node.place
    )


def read_dimensions(node: Node) -> tuple[int | None, ...]:
    """The sizes of an array, None for one that only the model knows; empty for a scalar.

    Raises:
        ConfigurationError: a size is no number from 1, or the array is too large.
    """
    sizes: list[int | None] = []
    whole = 1
    for child in node.children(*_DIMENSIONS):
        if child.has("size") and child.has("sizeConnector"):
            raise child.error("has both size and sizeConnector")
        child.attribute("sizeConnector")
        size = integer(child, "size") if child.has("size") else None
        whole *= size or 1
        if size is not None and (size < 1 or whole > MAX_ELEMENTS):
            raise child.error(
                f"an array of size {size}", f"arrays have 1 to {MAX_ELEMENTS} elements"
            )
        sizes.append(size)
        child.done()
    return tuple(sizes)


def _units(node: Node | None) -> dict[str, Unit]:
    units: dict[str, Unit] = {}
    for child in node.children("ssc:Unit") if node is not None else ():
        base = child.child("ssc:BaseUnit")
        if base is None:
            raise child.error("has no ssc:BaseUnit")
        name = child.required("name")
        if name in units:
            raise child.error(f"{name!r} is there twice")
        exponents = tuple(integer(base, unit, "0") for unit in _BASE_UNITS)
        factor = number(base, "factor", "1")
        if factor == 0.0:
            raise base.error("a factor of 0")
        units[name] = Unit(name, exponents, factor, number(base, "offset", "0"))
        base.done()
        child.done()
    if node is not None:
        node.done()
    return units


def _enumerations(node: Node | None) -> dict[str, dict[str, int]]:
    enumerations: dict[str, dict[str, int]] = {}
    for child in node.children("ssc:Enumeration") if node is not None else ():
        name = child.required("name")
        if name in enumerations:
            raise child.error(f"{name!r} is there twice")
        items: dict[str, int] = {}
        for item in child.children("ssc:Item"):
            if item.required("name") in items:
                raise item.error(f"{item.required('name')!r} is there twice")
            items[item.required("name")] = integer(item, "value")
            item.done()
        enumerations[name] = items
        child.done()
    if node is not None:
        node.done()
    return enumerations
