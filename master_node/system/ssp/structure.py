"""Content of an SSP document, as plain values: systems, components, connections, parameters.

Words are those of SSP 1.0 and 2.0. Nothing here knows XML or the settings of a run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

Scalar = float | int | bool | str
Value = Scalar | tuple["Value", ...]
"""Value of a parameter: an array's are its rows, a binary's hexadecimal digits."""


@dataclass(frozen=True, slots=True)
class Linear:
    """target = factor * source + offset."""

    factor: float = 1.0
    offset: float = 0.0

    def __call__(self, value: float) -> float:
        """The target for one source value."""
        return self.factor * value + self.offset

    def then(self, later: Linear) -> Linear:
        """This one first, and ``later`` on what it gives."""
        return Linear(later.factor * self.factor, later(self.offset))


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit by its base unit: base value = factor * value + offset (FMI 2.0, section 2.2.2).

    Attributes:
        exponents: of kg, m, s, A, K, mol, cd, rad.
    """

    name: str
    exponents: tuple[int, ...]
    factor: float
    offset: float

    def to(self, other: Unit) -> Linear | None:
        """From values in this unit to values in ``other``; None: another dimension."""
        if self.exponents != other.exponents:
            return None
        if (self.factor, self.offset) == (other.factor, other.offset):
            return Linear()
        return Linear(self.factor / other.factor, (self.offset - other.offset) / other.factor)


@dataclass(frozen=True, slots=True)
class Table:
    """A boolean or integer mapping transformation: what values become; others stay as they are.

    Attributes:
        is_boolean: whether all values are booleans, and not integers.
    """

    entries: Mapping[int, int]
    is_boolean: bool

    def __call__(self, value: int) -> int:
        """The target for one source value."""
        return self.entries.get(value, value)

    def then(self, later: Table) -> Table:
        """This one first, and ``later`` on what it gives."""
        both = {source: later(target) for source, target in self.entries.items()}
        return Table({**later.entries, **both}, self.is_boolean)


@dataclass(frozen=True, slots=True)
class ItemTable:
    """An enumeration mapping transformation: what items become, by their names."""

    entries: Mapping[str, str]

    def __call__(self, item: str) -> str:
        """The target for one source item."""
        return self.entries.get(item, item)

    def numbered(self, sources: Mapping[str, int], targets: Mapping[str, int]) -> Table:
        """Mapping of the numbers of the items in both enumerations.

        Raises:
            KeyError: an item is not in its enumeration.
        """
        return Table({sources[a]: targets[b] for a, b in self.entries.items()}, is_boolean=False)


Transformation = Linear | Table | ItemTable


@dataclass(frozen=True, slots=True)
class Connector:
    """An end of connections.

    Attributes:
        kind: input, output, parameter, ...; "" of an entry of a signal dictionary.
        unit: as declared, None if none is.
        items: of its enumeration, with their numbers; empty if it is none.
        dimensions: sizes of an array, None for one that is not declared; empty for a scalar.
        mime_type: of a binary, "" if none is declared.
        problem: why nothing can be connected to it, or "".
        place: file and line.
    """

    name: str
    kind: str
    unit: Unit | None
    items: Mapping[str, int]
    dimensions: tuple[int | None, ...]
    mime_type: str
    problem: str
    place: str


@dataclass(frozen=True, slots=True)
class ConnectionElement:
    """A connection between two connectors of one system or of its elements.

    Start and end say nothing of the direction; the connectors' kinds do.

    Attributes:
        start, end: element and connector; the element is None for a connector of the system.
        start_indices, end_indices: of one element of an array, from 1; empty: the whole connector.
        suppress_unit_conversion: take numbers as they are.
        place: file and line.
    """

    start: tuple[str | None, str]
    end: tuple[str | None, str]
    start_indices: tuple[int, ...]
    end_indices: tuple[int, ...]
    transformation: Transformation | None
    suppress_unit_conversion: bool
    place: str


@dataclass(frozen=True, slots=True)
class Parameter:
    """A value for a parameter or for the start of another variable.

    Attributes:
        name: as seen from the element that the binding belongs to.
        value: an enumeration's is the name of an item until its number is known.
        kind: name of the type in SSP, without its size: Real, Integer, Boolean, String,
            Enumeration, Binary.
        unit: name of the unit of ``value``, "" if none is said.
        definition: of that unit, None if the file has none.
        items: numbers of the enumeration's items in the same file, empty if it has none.
        transformation: still to be applied, in the unit of what the value is for.
        place: file and line.
    """

    name: str
    value: Value
    kind: str
    unit: str
    definition: Unit | None
    items: Mapping[str, int]
    transformation: Transformation | None
    place: str


@dataclass(frozen=True, slots=True)
class Binding:
    """Parameter values for one element, prefix and mapping applied, in order."""

    parameters: tuple[Parameter, ...]
    place: str


@dataclass(frozen=True, slots=True)
class Component:
    """An FMU in a system.

    Attributes:
        model: the FMU file.
        place: file and line.
    """

    name: str
    model: Path
    connectors: Mapping[str, Connector]
    bindings: tuple[Binding, ...]
    place: str


@dataclass(frozen=True, slots=True)
class Dictionary:
    """A signal dictionary: signals that references in several systems share.

    Attributes:
        entries: by name.
        place: file and line.
    """

    name: str
    entries: Mapping[str, Connector]
    place: str


@dataclass(frozen=True, slots=True)
class DictionaryReference:
    """Access to a signal dictionary of the same system, or of one that it is in.

    Attributes:
        dictionary: its name.
        connectors: by the names of entries.
        place: file and line.
    """

    name: str
    dictionary: str
    connectors: Mapping[str, Connector]
    bindings: tuple[Binding, ...]
    place: str


@dataclass(frozen=True, slots=True)
class SystemElement:
    """A system of components and systems; a component that refers to one is one as well."""

    name: str
    connectors: Mapping[str, Connector]
    elements: Mapping[str, Component | DictionaryReference | SystemElement]
    connections: tuple[ConnectionElement, ...]
    dictionaries: Mapping[str, Dictionary]
    bindings: tuple[Binding, ...]
    place: str


@dataclass(frozen=True, slots=True)
class Structure:
    """A whole SystemStructureDescription.

    Attributes:
        start_time, stop_time: of the default experiment [s].
        settings: TOML text of our own annotation, "" if there is none.
    """

    system: SystemElement
    start_time: float | None = None
    stop_time: float | None = None
    settings: str = ""


@dataclass
class Notes:
    """Notes on what a document holds that is not carried, and what else its user should know.

    Attributes:
        source: the file that was asked for.
        told: sentences, in the order in which they came up.
        not_carried: how often what has no influence on a simulation was met, by its name.
    """

    source: str
    told: list[str] = field(default_factory=list)
    not_carried: dict[str, int] = field(default_factory=dict)

    def tell(self, sentence: str) -> None:
        """Add a sentence, once."""
        if sentence not in self.told:
            self.told.append(sentence)

    def count(self, name: str) -> None:
        """Count one that has no influence."""
        self.not_carried[name] = self.not_carried.get(name, 0) + 1

    def sentences(self) -> tuple[str, ...]:
        """All of them; what has no influence in one sentence at the end."""
        if not self.not_carried:
            return tuple(self.told)
        counted = (
            f"{name} ({times} times)" if times > 1 else name
            for name, times in self.not_carried.items()
        )
        return (
            *self.told,
            f"{self.source}: not carried, as it has no influence here: {', '.join(counted)}",
        )


def each(change: Callable[[Scalar], Value], value: Value) -> Value:
    """``change`` of a value, or of each element of an array."""
    if isinstance(value, tuple):
        return tuple(each(change, element) for element in value)
    return change(value)


def element_name(name: str, indices: tuple[int, ...]) -> str:
    """``name[i,j]``; the name itself without indices."""
    return f"{name}[{','.join(map(str, indices))}]" if indices else name
