"""Connections between variables: names and arrays resolved, types and units settled."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from master_node.coupling.type_casts import Cast, cast, mapped_cast
from master_node.coupling.units import (
    IDENTITY,
    Transformation,
    UnitMismatchError,
    UnknownUnitError,
    conversion,
)
from master_node.system.fields import MappingEntries
from master_node.system.system import System
from master_node.system.tables import Connection
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError
from protocol.text.names import nearest
from protocol.values import type_in_words
from protocol.variables import Causality, Variable, VariableType

log = logging.getLogger("master_node")

_SOURCES = (Causality.OUTPUT, Causality.LOCAL, Causality.CALCULATED_PARAMETER)
"""Causalities of variables that can feed an input: all that a model computes."""

Descriptions = Mapping[str, SlaveDescription]


class End(NamedTuple):
    """A variable of a slave."""

    slave: str
    variable: Variable

    @property
    def reference(self) -> str:
        """``slave.variable``."""
        return f"{self.slave}.{self.variable.name}"

    @property
    def key(self) -> tuple[str, str]:
        """Slave and variable by their names."""
        return self.slave, self.variable.name


class ScalarConnection(NamedTuple):
    """An output that feeds an input.

    Attributes:
        source: the output.
        target: the input.
        transformation: from the one to the other.
        cast: from the type of the one to that of the other.
    """

    source: End
    target: End
    transformation: Transformation
    cast: Cast

    @property
    def is_continuous(self) -> bool:
        """True if the input follows a polynomial; else it is held constant in each step."""
        return self.source.variable.is_continuous_real and self.target.variable.is_continuous_real


class VariableFinder:
    """Finds variables by ``slave.variable``; both names may hold dots.

    Args:
        descriptions: of all slaves, by name.
    """

    def __init__(self, descriptions: Descriptions) -> None:
        self.descriptions = descriptions
        self._slaves = sorted(descriptions, key=len, reverse=True)
        self._variables: dict[str, dict[str, list[Variable]]] = {}
        for slave, description in descriptions.items():
            known = {variable.name: [variable] for variable in description.variables}
            for variable in description.variables:
                array, bracket, _ = variable.name.rpartition("[")
                if bracket and variable.name.endswith("]"):
                    known.setdefault(array, []).append(variable)
            self._variables[slave] = known

    def find(self, where: str, key: str, reference: str) -> list[End]:
        """The variable that ``reference`` means, or the elements of the array of that name.

        Args:
            where: what to call the place in messages.
            key: the key there.
            reference: ``slave.variable``.

        Raises:
            ConfigurationError: there is none, with the nearest names.
        """
        candidates = [slave for slave in self._slaves if reference.startswith(f"{slave}.")]
        if not candidates:
            slave = reference.partition(".")[0]
            near = nearest(slave, self.descriptions)
            raise ConfigurationError(f"{where}: {key} = {reference!r}: no slave {slave!r}{near}")
        for slave in candidates:
            found = self.elements(slave, reference[len(slave) + 1 :])
            if found:
                return [End(slave, variable) for variable in found]
        slave = candidates[0]
        name = reference[len(slave) + 1 :]
        near = nearest(name, self._variables[slave])
        raise ConfigurationError(
            f"{where}: {key} = {reference!r}: {slave} has no variable {name!r}{near}"
        )

    def elements(self, slave: str, name: str) -> list[Variable]:
        """The variable called ``name``, or the elements of that array; empty if there is none."""
        return self._variables[slave].get(name, [])

    def names(self, slave: str) -> list[str]:
        """Names of all variables and arrays of a slave."""
        return list(self._variables[slave])


def resolve_connections(system: System, finder: VariableFinder) -> list[ScalarConnection]:
    """All connections of a system, element by element.

    Raises:
        ConfigurationError: names the system's source, the number of the connection, both ends, and
            the nearest names.
    """
    resolved: list[ScalarConnection] = []
    driven: dict[tuple[str, str], str] = {}
    for number, connection in enumerate(system.connections):
        where = system.places.connection(number)
        for source, target in _elements(where, system.places.ends, connection, finder):
            before = driven.get(target.key)
            if before is not None:
                raise ConfigurationError(
                    f"{where}: {target.reference} is driven twice: by {before} and by "
                    f"{source.reference}"
                )
            driven[target.key] = source.reference
            resolved.append(_connection(where, connection, source, target, finder.descriptions))
    return resolved


def _connection(
    where: str, connection: Connection, source: End, target: End, descriptions: Descriptions
) -> ScalarConnection:
    types = source.variable.type, target.variable.type
    if connection.mapping is not None:
        entries = _numbered(where, connection.mapping, source, target)
        mapped = mapped_cast(source.variable, target.variable, entries)
        if mapped is None:
            raise ConfigurationError(
                f"{where}: mapping: {source.reference} is of type {types[0]}, {target.reference} "
                f"of type {types[1]}, and the mapping is not from the one to the other",
                remedy="map booleans to booleans, or integers and enumerations to values that "
                "the input can have",
            )
        return ScalarConnection(source, target, IDENTITY, mapped)
    how = cast(source.variable, target.variable)
    if how is None:
        raise ConfigurationError(
            f"{where}: {source.reference} is of type {types[0]}, {target.reference} of type "
            f"{types[1]}, and values could be lost on the way"
        )
    transformation = _transformation(where, connection, source, target, descriptions)
    if not transformation.is_identity and not (types[0].is_real and types[1].is_real):
        raise ConfigurationError(
            f"{where}: only floating-point values can be transformed, and {source.reference} is of "
            f"type {types[0]}, {target.reference} of type {types[1]}"
        )
    return ScalarConnection(source, target, transformation, how)


def _numbered(
    where: str, mapping: MappingEntries, source: End, target: End
) -> Mapping[bool, bool] | Mapping[int, int]:
    """The entries with the numbers of items in place of their names."""

    def number(end: End, entry: int | str) -> int:
        items = end.variable.items
        if isinstance(entry, str) and entry not in items:
            raise ConfigurationError(
                f"{where}: mapping: {end.reference} is of type {type_in_words(end.variable)}, and "
                f"has no item {entry!r}{nearest(entry, items)}"
            )
        return items[entry] if isinstance(entry, str) else entry

    return {number(source, one): number(target, other) for one, other in mapping.items()}


def _transformation(
    where: str, connection: Connection, source: End, target: End, descriptions: Descriptions
) -> Transformation:
    if connection.factor is not None or connection.offset is not None:
        factor = 1.0 if connection.factor is None else connection.factor
        return Transformation(float(factor), float(connection.offset or 0.0))
    if connection.ignore_units:
        return IDENTITY
    try:
        return conversion(
            source.variable.unit,
            descriptions[source.slave].units,
            target.variable.unit,
            descriptions[target.slave].units,
        )
    except UnitMismatchError as error:
        raise ConfigurationError(
            f"{where}: {source.reference} and {target.reference} have units of different "
            f"dimensions: {error}",
            remedy="connect other variables, or give factor, or ignore_units = true",
        ) from None
    except UnknownUnitError as error:
        log.warning(
            "%s: the units of %s and %s are not compared: %s",
            where,
            source.reference,
            target.reference,
            error,
        )
        return IDENTITY


def _elements(
    where: str, words: tuple[str, str], connection: Connection, finder: VariableFinder
) -> list[tuple[End, End]]:
    """The scalar variables of both ends, one to one; ``words``: what to call the ends."""
    sources = finder.find(where, words[0], connection.source)
    targets = finder.find(where, words[1], connection.target)
    for key, reference, ends, allowed in (
        (words[0], connection.source, sources, _SOURCES),
        (words[1], connection.target, targets, (Causality.INPUT,)),
    ):
        _check_causality(where, f"{key} = {reference!r}", ends[0], allowed, finder)
    shapes = [_indices(ends) for ends in (sources, targets)]
    if shapes[0] != shapes[1]:
        raise ConfigurationError(
            f"{where}: {connection.source} has {_size(sources)}, {connection.target} has "
            f"{_size(targets)}"
        )
    return list(zip(sources, targets, strict=True))


def _indices(ends: list[End]) -> list[str]:
    """Indices in brackets behind an array's name; nothing for a single variable."""
    return [] if len(ends) == 1 else [end.variable.name.rpartition("[")[2] for end in ends]


def _size(ends: list[End]) -> str:
    if len(ends) == 1:
        return "one value"
    return f"elements up to [{ends[-1].variable.name.rpartition('[')[2]}"


def _check_causality(
    where: str,
    reference: str,
    end: End,
    allowed: tuple[Causality, ...],
    finder: VariableFinder,
) -> None:
    slave, variable = end
    if variable.causality not in allowed:
        names = [v.name for v in finder.descriptions[slave].of(allowed[0])]
        raise ConfigurationError(
            f"{where}: {reference} is not an {allowed[0]} but of causality "
            f"{variable.causality}{nearest(variable.name, names)}"
        )


def read_variables(
    descriptions: Descriptions, connections: Sequence[ScalarConnection]
) -> dict[str, tuple[Variable, ...]]:
    """Variables of each slave that are read at communication points: outputs, and other sources.

    In the order of its variables; clocks carry no value.
    """
    sources = {connection.source.key for connection in connections}
    return {
        slave: tuple(
            variable
            for variable in description.variables
            if variable.type is not VariableType.CLOCK
            and (variable.causality is Causality.OUTPUT or (slave, variable.name) in sources)
        )
        for slave, description in descriptions.items()
    }
