"""Parameter values (SSV) and parameter mappings (SSM), read into the parameters of a binding."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from master_node.ssp.structure import (
    Linear,
    Notes,
    Parameter,
    Table,
    Transformation,
    Unsupported,
    Value,
    listed,
)
from master_node.ssp.xml_nodes import Node, boolean, integer, number
from protocol.errors import ConfigurationError

_REALS = ("ssv:Real", "ssv:Float64", "ssv:Float32")
_INTEGERS = (
    "ssv:Integer",
    *(f"ssv:{sign}Int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "U")),
)
_TYPES = (*_REALS, *_INTEGERS, "ssv:Boolean", "ssv:String", "ssv:Enumeration", "ssv:Binary")
_TRANSFORMATIONS = (
    "ssc:LinearTransformation",
    "ssc:BooleanMappingTransformation",
    "ssc:IntegerMappingTransformation",
    "ssc:EnumerationMappingTransformation",
)


@dataclass(frozen=True, slots=True)
class MappingEntry:
    """From a name in the parameter source to a name in the element."""

    source: str
    target: str
    transformation: Transformation | None
    place: str


def check_version(node: Node) -> None:
    """Check that a document is of SSP 1 or 2.

    Raises:
        ConfigurationError: it is of another version.
    """
    version = node.required("version")
    if version.partition(".")[0] not in ("1", "2"):
        raise node.error(f"version {version!r:.60} is not known", "export it as SSP 1.0 or 2.0")


def read_parameter_set(node: Node) -> tuple[Parameter, ...]:
    """The parameters of an ``ssv:ParameterSet``, in order.

    Raises:
        ConfigurationError: a value is not of its type, a name is there twice, or an element is
            not known.
    """
    check_version(node)
    node.attribute("name")
    enumerations = _enumerations(node.child("ssv:Enumerations"))
    node.children("ssv:Units")
    parameters: dict[str, Parameter] = {}
    container = node.child("ssv:Parameters")
    for child in container.children("ssv:Parameter") if container else ():
        parameter = _parameter(child, enumerations)
        if parameter.name in parameters:
            raise child.error(f"{parameter.name!r} is there twice")
        parameters[parameter.name] = parameter
    if container:
        container.done()
    node.done()
    return tuple(parameters.values())


def read_mapping(node: Node) -> tuple[MappingEntry, ...]:
    """The entries of an ``ssm:ParameterMapping``, in order.

    Raises:
        ConfigurationError: two parameters are mapped to one name, or an element is not known.
    """
    check_version(node)
    entries: dict[str, MappingEntry] = {}
    for child in node.children("ssm:MappingEntry"):
        entry = MappingEntry(
            source=child.required("source"),
            target=child.required("target"),
            transformation=read_transformation(child),
            place=child.place,
        )
        boolean(child, "suppressUnitConversion", "false")  # values are never converted
        child.done()
        if entry.target in entries:
            raise child.error(f"two parameters are mapped to {entry.target!r}")
        entries[entry.target] = entry
    node.done()
    return tuple(entries.values())


def read_transformation(node: Node) -> Transformation | None:
    """The transformation of a connection or of a mapping entry, None if there is none.

    Raises:
        ConfigurationError: there are several, or a number is wrong.
    """
    found = node.children(*_TRANSFORMATIONS)
    if not found:
        return None
    if len(found) > 1:
        raise found[1].error("is a second transformation")
    (transformation,) = found
    match transformation.name:
        case "ssc:LinearTransformation":
            linear = Linear(
                number(transformation, "factor", "1.0"), number(transformation, "offset", "0.0")
            )
            transformation.done()
            return linear
        case "ssc:BooleanMappingTransformation":
            return _table(transformation, boolean)
        case "ssc:IntegerMappingTransformation":
            return _table(transformation, integer)
    return Unsupported(transformation.name)


def transformed(parameter: Parameter, transformation: Transformation | None) -> Parameter:
    """The parameter with a transformed value.

    Raises:
        ConfigurationError: the value is not of a type that the transformation is for.
    """
    if transformation is None or transformation == Linear():
        return parameter
    value = parameter.usable()
    where = f"{parameter.place}: parameter {parameter.name!r}"
    match transformation:
        case Linear():
            if isinstance(value, str | bool):
                raise ConfigurationError(f"{where}: a LinearTransformation of {value!r:.60}")
            result = transformation(value)
            if not math.isfinite(result):
                raise ConfigurationError(f"{where}: the LinearTransformation gives {result}")
            return replace(parameter, value=result)
        case Table():
            if not isinstance(value, int) or value not in transformation.entries:
                raise ConfigurationError(f"{where}: no MapEntry for the value {value!r:.60}")
            return replace(parameter, value=transformation.entries[value])
        case Unsupported():
            raise ConfigurationError(
                f"{where}: {transformation.element} is not supported",
                remedy="map the number by an IntegerMappingTransformation",
            )


def mapped(
    parameters: Sequence[Parameter], mapping: Sequence[MappingEntry], place: str, notes: Notes
) -> tuple[Parameter, ...]:
    """The parameters under their new names, transformed; those without an entry are left out."""
    known = {parameter.name: parameter for parameter in parameters}
    result = []
    for entry in mapping:
        parameter = known.get(entry.source)
        if parameter is None:
            notes.tell(f"{entry.place}: no parameter {entry.source!r} is there to be mapped")
        else:
            result.append(replace(transformed(parameter, entry.transformation), name=entry.target))
    sources = {entry.source for entry in mapping}
    if unmapped := [name for name in known if name not in sources]:
        notes.tell(f"{place}: not mapped, so not applied: {listed(unmapped)}")
    return tuple(result)


def _parameter(node: Node, enumerations: Mapping[str, Mapping[str, int]]) -> Parameter:
    types = node.children(*_TYPES)
    if len(types) != 1:
        raise node.error("needs one element with its type and value")
    (kind,) = types
    problem, unit = "", ""
    value: Value = 0
    if node.children("ssv:Dimension", "ssc:Dimension"):
        problem = "an array"
        kind.attribute("value")
        kind.children("ssv:Value")
    elif kind.name in _REALS:
        value, unit = number(kind, "value"), kind.attribute("unit")
    elif kind.name in _INTEGERS:
        value = integer(kind, "value")
    elif kind.name == "ssv:Boolean":
        value = boolean(kind, "value")
    elif kind.name == "ssv:Binary":
        problem = "a Binary value"
        kind.attribute("value")
        kind.attribute("mime-type")
        kind.children("ssv:Value")
    else:
        value = _text(kind)
    if kind.name == "ssv:Enumeration" and not problem:
        items = enumerations.get(kind.attribute("name"), {})
        if value in items:
            value = items[str(value)]
        else:
            problem = f"Enumeration item {value!r:.60} has no number in this file"
    kind.attribute("unit")
    kind.attribute("name")
    kind.done()
    parameter = Parameter(node.required("name"), value, unit, problem, node.place)
    node.done()
    return parameter


def _text(node: Node) -> str:
    values = node.children("ssv:Value")
    if not values:
        return node.attribute("value")
    if len(values) > 1 or node.has("value"):
        raise node.error("has several values")
    (value,) = values
    value.done()
    return value.text


def _enumerations(node: Node | None) -> dict[str, dict[str, int]]:
    if node is None:
        return {}
    return {
        enumeration.required("name"): {
            item.required("name"): integer(item, "value")
            for item in enumeration.children("ssc:Item")
        }
        for enumeration in node.children("ssc:Enumeration")
    }


def _table(node: Node, read: Callable[[Node, str], int]) -> Table:
    entries = {}
    for entry in node.children("ssc:MapEntry"):
        entries[read(entry, "source")] = read(entry, "target")
        entry.done()
    node.done()
    return Table(entries)
