"""Parameters on their way from where they are bound to the variables that they are for.

A value for a connector of a system follows its connections inwards. Wherever it arrives it is
converted to the unit there, and then transformed (SSP 2.0, section 7.1.1).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

from master_node.system.ssp.graph import INWARD, Edge, Port, SignalGraph, numbered, shape
from master_node.system.ssp.graph import Path as ElementPath
from master_node.system.ssp.structure import (
    Component,
    Connector,
    DictionaryReference,
    ItemTable,
    Linear,
    Notes,
    Parameter,
    Scalar,
    SystemElement,
    Transformation,
    Unit,
    Value,
    each,
    element_name,
)
from master_node.system.ssp.transformations import apply
from master_node.system.start_values import structural_parameters
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError, DoublestepError
from protocol.text.names import listed, nearest
from protocol.variables import Variable, VariableType

Describe = Callable[[Path], SlaveDescription]

_MOST_DIMENSIONS = 2
"""Most dimensions of an array that is given by rows; others are given element by element."""


class Given(NamedTuple):
    """A start value, and the file and line that it comes from."""

    value: Value
    place: str


@dataclass(frozen=True, slots=True)
class _Target:
    """Where a value arrives.

    Attributes:
        shown: what to call it in messages.
        unit: its name, "" for none; None: it takes any.
        definition: of the unit, None if it has none.
        items: numbers of its enumeration's items, empty if they are not known.
    """

    shown: str
    unit: str | None
    definition: Unit | None
    items: Mapping[str, int]


class _Model:
    """The variables of an FMU by their names."""

    def __init__(self, description: SlaveDescription) -> None:
        self.units = description.units
        self._variables = {variable.name: variable for variable in description.variables}
        self._arrays = {
            variable.name.rpartition("[")[0]: variable
            for variable in reversed(description.variables)
            if variable.name.endswith("]")
        }
        self._is_sized = bool(structural_parameters(description))

    def find(self, name: str) -> tuple[Variable | None, bool]:
        """The variable of that name, or the first element of that array, and whether it is one.

        Structural parameters may give an array more elements than the description has.
        """
        if name in self._variables:
            return self._variables[name], False
        if self._is_sized and name.endswith("]"):
            return self._arrays.get(name.rpartition("[")[0]), False
        return self._arrays.get(name), True


class ParameterBinder:
    """Gives bound values to the variables of components.

    Args:
        graph: the nested systems.
        names: of the slaves, by path.
        describe: gives the description of an FMU file.
        notes: for what is not carried.

    Attributes:
        parameters: start values by variable, by path of the component, with their places.
        given: ports of systems and signal dictionaries that got a value.
    """

    def __init__(
        self,
        graph: SignalGraph,
        names: Mapping[ElementPath, str],
        describe: Describe,
        notes: Notes,
    ) -> None:
        self._graph = graph
        self._names = names
        self._model = cache(lambda fmu: _Model(describe(fmu)))
        self._notes = notes
        self.parameters: dict[ElementPath, dict[str, Given]] = {p: {} for p in graph.components}
        self.given: set[Port] = set()

    def bind(self) -> None:
        """Give every bound value to its variables; those of outer systems win.

        Raises:
            ConfigurationError: a value cannot be carried to where it is bound.
        """
        for path, element in _innermost_first((), self._graph.systems[()]):
            for binding in element.bindings:
                unknown = [p.name for p in binding.parameters if not self._give(path, p)]
                if unknown:
                    self._notes.tell(
                        f"{binding.place}: no variable of {element.name!r} has the name "
                        f"{listed(unknown)}; not applied"
                    )

    def _give(self, path: ElementPath, parameter: Parameter) -> bool:
        """Give a value to all variables of a hierarchical name; False: there is none."""
        if path in self._graph.components:
            return self._give_component(path, parameter)
        connector = self._graph.connector(path, parameter.name)
        if connector is not None:
            self._give_connector(path, connector, parameter)
        found = connector is not None
        if path in self._graph.systems:
            for name in self._graph.systems[path].elements:
                if parameter.name.startswith(f"{name}."):
                    inner = replace(parameter, name=parameter.name.removeprefix(f"{name}."))
                    found |= self._give((*path, name), inner)
        return found

    def _give_component(self, path: ElementPath, parameter: Parameter) -> bool:
        component, slave, name = self._graph.components[path], self._names[path], parameter.name
        try:
            model = self._model(component.model)
        except DoublestepError as error:
            raise error.located(slave=slave) from None
        variable, is_array = model.find(name)
        if variable is None:
            return False
        defined = model.units.get(variable.unit)
        connector = component.connectors.get(name)
        target = _Target(
            f"{slave}.{name}",
            variable.unit,
            None
            if defined is None
            else Unit(variable.unit, defined.exponents, defined.factor, defined.offset),
            connector.items if connector is not None else {},
        )
        items = {**parameter.items, **variable.items}
        parameter = _numbered(self._arrived(parameter, target), items)
        value = _checked(parameter, variable, target.shown, is_array=is_array)
        whole = len(_sizes(value)) <= _MOST_DIMENSIONS
        given = {name: value} if whole else dict(_elements(name, (), value))
        parameters = self.parameters[path]
        for key in given.keys() & parameters.keys():
            del parameters[key]  # of an array and its elements what comes later wins
        parameters.update({key: Given(one, parameter.place) for key, one in given.items()})
        return True

    def _give_connector(
        self, path: ElementPath, connector: Connector, parameter: Parameter
    ) -> None:
        """Give a value to what a connector of a system, or an entry of a dictionary, leads to."""
        port = (path, connector.name)
        if path in self._graph.references:
            port = self._graph.entry(path, connector.name)
        elif connector.kind not in INWARD:
            raise ConfigurationError(
                f"{parameter.place}: a value for {connector.name!r}, a connector of kind "
                f"{connector.kind!r}, is not supported",
                remedy="give it to the component that the connector belongs to",
            )
        sizes = _sizes(parameter.value)
        if len(sizes) != len(connector.dimensions) or any(
            declared not in (None, size)
            for declared, size in zip(connector.dimensions, sizes, strict=True)
        ):
            raise ConfigurationError(
                f"{parameter.place}: a value of dimensions {shape(sizes)} for "
                f"{self._graph.shown(port)} of dimensions {shape(connector.dimensions)}",
                remedy="give the parameter a Dimension for each one of the connector",
            )
        parameter = self._arrived(parameter, _at(connector))
        parts = {port: parameter}
        if self._graph.is_by_elements:
            parts = {
                (port[0], name): replace(parameter, value=value)
                for name, value in _elements(connector.name, (), parameter.value)
            }
        if self._graph.outgoing.keys().isdisjoint(parts):
            self._notes.tell(
                f"{parameter.place}: {self._graph.shown(port)} leads to nothing that could take "
                "its value; not applied"
            )
        self.given.update((port, *parts))
        for start, part in parts.items():
            self._follow(start, part, {start})

    def _follow(self, port: Port, parameter: Parameter, passed: set[Port]) -> None:
        for edge in self._graph.outgoing.get(port, ()):
            if edge.target in passed:
                continue
            passed.add(edge.target)
            path, name = edge.target
            behind = replace(self._behind(edge, parameter), name=name)
            if path not in self._graph.components:
                self._follow(edge.target, behind, passed)
            elif not self._give_component(path, behind):
                raise ConfigurationError(
                    f"{edge.element.place}: {self._names[path]!r} has no variable {name!r}"
                )

    def _behind(self, edge: Edge, parameter: Parameter) -> Parameter:
        """The parameter behind a connection."""
        parameter = self._arrived(parameter, _at(edge.source_connector))
        transformation = edge.element.transformation
        if isinstance(transformation, ItemTable) and parameter.kind != "Enumeration":
            transformation = numbered(edge)
        if edge.element.suppress_unit_conversion:
            parameter = replace(parameter, unit="", definition=None)
        return self._arrived(
            replace(parameter, transformation=transformation), _at(edge.target_connector)
        )

    def _arrived(self, parameter: Parameter, target: _Target) -> Parameter:
        """The parameter as it is at ``target``: in its unit, and transformed."""
        if parameter.definition is not None and target.definition is not None:
            step = parameter.definition.to(target.definition)
            if step is None:
                raise ConfigurationError(
                    f"{parameter.place}: the value for {target.shown}: unit {parameter.unit!r} "
                    f"cannot be converted to {target.unit!r}",
                    remedy="correct the units, or say suppressUnitConversion in a mapping",
                )
            if step != Linear():
                parameter = _transformed(parameter, step)
        elif parameter.unit and target.unit not in (None, parameter.unit):
            self._notes.tell(
                f"{parameter.place}: the value for {target.shown} has the unit "
                f"{parameter.unit!r}, which is not converted to its unit "
                f"{target.unit or 'none'!r}; the number is taken as it is"
            )
        if target.unit is not None:
            parameter = replace(parameter, unit=target.unit, definition=target.definition)
        if parameter.transformation is not None:
            parameter = _transformed(
                replace(parameter, transformation=None), parameter.transformation
            )
        return _numbered(parameter, target.items) if target.items else parameter


def _at(connector: Connector) -> _Target:
    unit = connector.unit
    name = unit.name if unit is not None else None
    return _Target(f"connector {connector.name!r}", name, unit, connector.items)


def _transformed(parameter: Parameter, transformation: Transformation) -> Parameter:
    if not isinstance(transformation, ItemTable):
        parameter = _numbered(parameter, parameter.items)
    try:
        value = each(lambda one: apply(transformation, one), parameter.value)
    except ValueError as error:
        raise ConfigurationError(
            f"{parameter.place}: parameter {parameter.name!r}: {error}",
            remedy="transform it by the transformation for its type",
        ) from None
    return replace(parameter, value=value)


def _numbered(parameter: Parameter, items: Mapping[str, int]) -> Parameter:
    """With the numbers of an enumeration's items in place of their names."""
    if parameter.kind != "Enumeration":
        return parameter

    def number(item: Scalar) -> Scalar:
        if str(item) not in items:
            raise ConfigurationError(
                f"{parameter.place}: parameter {parameter.name!r}: Enumeration item {item!r:.60} "
                f"has no number{nearest(str(item), items)}",
                remedy="correct it, or declare the enumeration with all its items, in the file of "
                "the parameter or for the connector of the component",
            )
        return items[str(item)]

    return replace(parameter, value=each(number, parameter.value), kind="Integer")


def _checked(parameter: Parameter, variable: Variable, shown: str, *, is_array: bool) -> Value:
    """The value, if it is of the shape of the variable, and a binary or none as the variable is."""
    is_binary = variable.type is VariableType.BINARY
    if parameter.kind in ("Binary", "String") and is_binary != (parameter.kind == "Binary"):
        raise ConfigurationError(
            f"{parameter.place}: a {parameter.kind} for {shown}, which is of type {variable.type}",
            remedy="give it as the type of the variable",
        )
    if isinstance(parameter.value, tuple) != is_array:
        given, wanted = ("one value", "an array") if is_array else ("an array", "one value")
        raise ConfigurationError(
            f"{parameter.place}: {given} for {shown}, which is {wanted}",
            remedy="give the parameter a Dimension for each one of the variable",
        )
    return parameter.value


def _sizes(value: Value) -> tuple[int, ...]:
    return (len(value), *_sizes(value[0])) if isinstance(value, tuple) else ()


def _elements(name: str, indices: tuple[int, ...], value: Value) -> Iterator[tuple[str, Scalar]]:
    """Names and values of an array's elements; one pair for a single value."""
    if not isinstance(value, tuple):
        yield element_name(name, indices), value
        return
    yield from itertools.chain.from_iterable(
        _elements(name, (*indices, index), part) for index, part in enumerate(value, start=1)
    )


def _innermost_first(
    path: ElementPath, element: Component | DictionaryReference | SystemElement
) -> Iterator[tuple[ElementPath, Component | DictionaryReference | SystemElement]]:
    if isinstance(element, SystemElement):
        for name, inner in element.elements.items():
            yield from _innermost_first((*path, name), inner)
    yield path, element
