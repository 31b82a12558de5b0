"""Parameter values (SSV) and parameter mappings (SSM), read into the parameters of a binding."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

from master_node.system.ssp.definitions import Definitions, read_definitions, read_dimensions
from master_node.system.ssp.structure import Notes, Parameter, Scalar, Transformation, Value
from master_node.system.ssp.transformations import read_transformation
from master_node.system.ssp.xml_nodes import Node, as_boolean, as_integer, as_number, boolean
from protocol.text.names import listed

_KINDS = {
    **dict.fromkeys(("Real", "Float64", "Float32"), "Real"),
    **dict.fromkeys(
        (
            "Integer",
            *(f"{sign}Int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "U")),
        ),
        "Integer",
    ),
    **{name: name for name in ("Boolean", "String", "Enumeration", "Binary")},
}
_TYPES = tuple(f"ssv:{name}" for name in _KINDS)


@dataclass(frozen=True, slots=True)
class MappingEntry:
    """From a name in the parameter source to a name in the element."""

    source: str
    target: str
    transformation: Transformation | None
    suppress_unit_conversion: bool
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
    definitions = read_definitions(node, "ssv")
    parameters: dict[str, Parameter] = {}
    container = node.child("ssv:Parameters")
    for child in container.children("ssv:Parameter") if container else ():
        parameter = _parameter(child, definitions)
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
            suppress_unit_conversion=boolean(child, "suppressUnitConversion", "false"),
            place=child.place,
        )
        child.done()
        if entry.target in entries:
            raise child.error(f"two parameters are mapped to {entry.target!r}")
        entries[entry.target] = entry
    node.done()
    return tuple(entries.values())


def mapped(
    parameters: Sequence[Parameter], mapping: Sequence[MappingEntry], place: str, notes: Notes
) -> tuple[Parameter, ...]:
    """The parameters under their new names; those without an entry are left out.

    A transformation is applied later, behind the conversion to the unit of the target.
    """
    known = {parameter.name: parameter for parameter in parameters}
    result = []
    for entry in mapping:
        parameter = known.get(entry.source)
        if parameter is None:
            notes.tell(f"{entry.place}: no parameter {entry.source!r} is there to be mapped")
            continue
        if entry.suppress_unit_conversion:
            parameter = replace(parameter, unit="", definition=None)
        result.append(replace(parameter, name=entry.target, transformation=entry.transformation))
    sources = {entry.source for entry in mapping}
    if unmapped := [name for name in known if name not in sources]:
        notes.tell(f"{place}: not mapped, so not applied: {listed(unmapped)}")
    return tuple(result)


def _parameter(node: Node, definitions: Definitions) -> Parameter:
    types = node.children(*_TYPES)
    if len(types) != 1:
        raise node.error("needs one element with its type and value")
    (element,) = types
    kind = _KINDS[element.name.partition(":")[2]]
    unit = element.attribute("unit")
    items = definitions.enumerations.get(element.attribute("name"), {})
    element.attribute("mime-type")
    sizes = read_dimensions(node)
    if kind in _TOKENS:
        read, texts = _TOKENS[kind], element.required("value").split()
        values: list[Scalar] = [read(element, text) for text in texts]
    else:
        values = [_text(element, kind, text) for text in _texts(element)]
    element.done()
    parameter = Parameter(
        node.required("name"),
        _shaped(node, values, sizes),
        kind,
        unit,
        definitions.units.get(unit),
        items,
        None,
        node.place,
    )
    node.done()
    return parameter


_TOKENS: dict[str, Callable[[Node, str], Scalar]] = {
    "Real": as_number,
    "Integer": as_integer,
    "Boolean": as_boolean,
}


def _texts(node: Node) -> list[str]:
    """The value, or the values of an array, which have elements of their own."""
    children = node.children("ssv:Value")
    if not children:
        return [node.attribute("value")]
    if node.has("value"):
        raise node.error("has several values")
    texts = [child.attribute("value", child.text) for child in children]
    for child in children:
        child.done()
    return texts


def _text(node: Node, kind: str, text: str) -> str:
    if kind == "Binary":
        try:
            return bytes.fromhex(text).hex()
        except ValueError:
            raise node.error(f"value = {text!r:.60} is not hexadecimal") from None
    return text


def _shaped(node: Node, values: list[Scalar], sizes: tuple[int | None, ...]) -> Value:
    """The value itself, or those of an array as its rows."""
    known = [size for size in sizes if size is not None]
    if len(known) < len(sizes):
        raise node.error("a Dimension of a parameter needs a size")
    if len(values) != math.prod(known):
        count = math.prod(known) if known else "one value"
        raise node.error(f"has {len(values)} values in place of {count}")
    return _rows(iter(values), known)


def _rows(values: Iterator[Scalar], sizes: Sequence[int]) -> Value:
    if not sizes:
        return next(values)
    if len(sizes) == 1:
        return tuple(islice(values, sizes[0]))
    return tuple(_rows(values, sizes[1:]) for _ in range(sizes[0]))
