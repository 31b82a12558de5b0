"""What an SSP document says, as plain values: systems, components, connections, parameters.

Words are those of SSP 1.0 and 2.0. Nothing here knows XML or the settings of a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from protocol.errors import ConfigurationError

Value = float | int | bool | str
"""Of a parameter; an enumeration's is its number."""


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
    """A boolean or integer mapping transformation: what each source value becomes."""

    entries: Mapping[int, int]


@dataclass(frozen=True, slots=True)
class Unsupported:
    """A transformation that cannot be carried, by the name of its element."""

    element: str


Transformation = Linear | Table | Unsupported


@dataclass(frozen=True, slots=True)
class Connector:
    """An end of connections.

    Attributes:
        kind: input, output, parameter, ...
        unit: as declared, None if none is.
        problem: why nothing can be connected to it, or "".
        place: file and line.
    """

    name: str
    kind: str
    unit: Unit | None
    problem: str
    place: str


@dataclass(frozen=True, slots=True)
class ConnectionElement:
    """A connection between two connectors of one system or of its elements.

    Start and end say nothing of the direction; the connectors' kinds do.

    Attributes:
        start, end: element and connector; the element is None for a connector of the system.
        suppress_unit_conversion: take numbers as they are.
        place: file and line.
    """

    start: tuple[str | None, str]
    end: tuple[str | None, str]
    transformation: Transformation | None
    suppress_unit_conversion: bool
    place: str


@dataclass(frozen=True, slots=True)
class Parameter:
    """A value for a parameter or for the start of another variable.

    Attributes:
        name: as seen from the element that the binding belongs to.
        unit: name of the unit of ``value``, "" if none is said.
        problem: why the value cannot be used, or "".
        place: file and line.
    """

    name: str
    value: Value
    unit: str
    problem: str
    place: str

    def usable(self) -> Value:
        """The value.

        Raises:
            ConfigurationError: it is of a kind that cannot be carried.
        """
        if self.problem:
            raise ConfigurationError(
                f"{self.place}: parameter {self.name!r}: {self.problem}",
                remedy="give it as a Real, Integer, Boolean or String, or leave it out",
            )
        return self.value


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
class SystemElement:
    """A system of components and systems; a component that refers to one is one as well."""

    name: str
    connectors: Mapping[str, Connector]
    elements: Mapping[str, Component | SystemElement]
    connections: tuple[ConnectionElement, ...]
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
    """What a document holds that is not carried, and what else its user should know.

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


def listed(names: list[str]) -> str:
    """Names for a message, all of up to ten."""
    more = f" and {len(names) - 10} more" if len(names) > 10 else ""
    return ", ".join(map(repr, names[:10])) + more
