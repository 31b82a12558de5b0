"""Transformations of connections and of parameter mappings."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from master_node.system.ssp.structure import ItemTable, Linear, Scalar, Table, Transformation
from master_node.system.ssp.xml_nodes import Node, boolean, integer, number

_TRANSFORMATIONS = (
    "ssc:LinearTransformation",
    "ssc:BooleanMappingTransformation",
    "ssc:IntegerMappingTransformation",
    "ssc:EnumerationMappingTransformation",
)


def read_transformation(node: Node) -> Transformation | None:
    """The transformation of a connection or of a mapping entry, None if there is none.

    Raises:
        ConfigurationError: there are several, or an entry or a number is wrong.
    """
    found = node.children(*_TRANSFORMATIONS)
    if not found:
        return None
    if len(found) > 1:
        raise found[1].error("is a second transformation")
    (child,) = found
    read: Transformation
    match child.name:
        case "ssc:LinearTransformation":
            read = Linear(number(child, "factor", "1.0"), number(child, "offset", "0.0"))
        case "ssc:BooleanMappingTransformation":
            read = Table(_entries(child, boolean), is_boolean=True)
        case "ssc:IntegerMappingTransformation":
            read = Table(_entries(child, integer), is_boolean=False)
        case _:
            read = ItemTable(_entries(child, Node.required))
    child.done()
    return read


def apply(transformation: Transformation, value: Scalar) -> Scalar:
    """Value behind the transformation; an enumeration's is the name of an item, or its number.

    Raises:
        ValueError: the transformation is not for values of that type, or gives no finite number.
    """
    match transformation:
        case Linear() if not isinstance(value, str | bool):
            result = transformation(value)
            if not math.isfinite(result):
                raise ValueError(f"the LinearTransformation gives {result}")
            return result
        case Table() if (
            isinstance(value, bool) if transformation.is_boolean else type(value) is int
        ):
            return transformation(int(value)) if type(value) is int else transformation(bool(value))
        case ItemTable() if isinstance(value, str):
            return transformation(value)
    raise ValueError(f"{name_of(transformation)} of {value!r:.60}")


def name_of(transformation: Transformation) -> str:
    """Name of the transformation in SSP, with an article."""
    match transformation:
        case Linear():
            return "a LinearTransformation"
        case Table():
            kind = "a BooleanMapping" if transformation.is_boolean else "an IntegerMapping"
            return f"{kind}Transformation"
        case ItemTable():
            return "an EnumerationMappingTransformation"


def _entries(node: Node, read: Callable[[Node, str], Any]) -> dict[Any, Any]:
    entries: dict[Any, Any] = {}
    for entry in node.children("ssc:MapEntry"):
        source = read(entry, "source")
        if source in entries:
            raise entry.error(f"the source {source!r:.60} is there twice")
        entries[source] = read(entry, "target")
        entry.done()
    if not entries:
        raise node.error("has no ssc:MapEntry")
    return entries
