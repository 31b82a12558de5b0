"""Names of the parts of a system in messages: the words of the file that its author wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol


class Places(Protocol):
    """Names of the parts of a system in messages."""

    def slave(self, name: str) -> str:
        """Where a slave is described."""
        ...

    def parameter(self, slave: str, name: str) -> str:
        """Where a start value is given."""
        ...

    def tolerance(self, slave: str, output: str) -> str:
        """Where the tolerances of an output are given."""
        ...

    def connection(self, number: int) -> str:
        """Where the connection with this number, from 0, is described."""
        ...

    @property
    def ends(self) -> tuple[str, str]:
        """Names of the output and the input of a connection."""
        ...

    def setting(self, table: str, key: str) -> str:
        """Words for giving a key of a table: the object of "give ..."."""
        ...

    @property
    def no_stop_time(self) -> str:
        """Sentence: the system has no stop time."""
        ...


@dataclass(frozen=True)
class SystemFilePlaces:
    """Places of a system file, or of a system in Python.

    Attributes:
        source: the file's name.
    """

    source: str

    def slave(self, name: str) -> str:
        """See `Places`."""
        return f"{self.source}: [slaves.{name}]"

    def parameter(self, slave: str, name: str) -> str:
        """See `Places`."""
        return f"{self.source}: [slaves.{slave}.parameters] {name!r}"

    def tolerance(self, slave: str, output: str) -> str:
        """See `Places`."""
        return f"{self.source}: [slaves.{slave}.tolerances] {output!r}"

    def connection(self, number: int) -> str:
        """See `Places`."""
        return f"{self.source}: [[connections]] number {number + 1}"

    @property
    def ends(self) -> tuple[str, str]:
        """See `Places`."""
        return "from", "to"

    def setting(self, table: str, key: str) -> str:
        """See `Places`."""
        return f"[{table}] {key}"

    @property
    def no_stop_time(self) -> str:
        """See `Places`."""
        return f"{self.source}: [simulation] stop_time is missing"


@dataclass(frozen=True)
class SspPlaces:
    """Places of an SSP package or an SSD: its elements, by file and line.

    Attributes:
        source: the package.
        components: place of each slave's ``ssd:Component``.
        parameters: place of each start value, by slave and variable.
        connections: place of the last ``ssd:Connection`` on the way of each connection.
    """

    source: str
    components: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[tuple[str, str], str] = field(default_factory=dict)
    connections: Sequence[str] = ()

    def slave(self, name: str) -> str:
        """See `Places`."""
        place = self.components.get(name, self.source)
        return f"{place}: ssd:Component {name!r}"

    def parameter(self, slave: str, name: str) -> str:
        """See `Places`."""
        place = self.parameters.get((slave, name))
        if place is None:  # given at the prompt, or in a study
            return f"{self.source}: the value for {slave}.{name}"
        return f"{place}: ssv:Parameter for {slave}.{name}"

    def tolerance(self, slave: str, output: str) -> str:
        """See `Places`: SSP has none, so they stand in Doublestep's annotation."""
        return (
            f"{self.source}: the annotation of Doublestep: [slaves.{slave}.tolerances] {output!r}"
        )

    def connection(self, number: int) -> str:
        """See `Places`."""
        return f"{self.connections[number]}: ssd:Connection"

    @property
    def ends(self) -> tuple[str, str]:
        """See `Places`: ``start`` and ``end`` say nothing of the direction."""
        return "output connector", "input connector"

    def setting(self, table: str, key: str) -> str:
        """See `Places`."""
        return f"[{table}] {key} in a system file, which `master-node import` makes"

    @property
    def no_stop_time(self) -> str:
        """See `Places`."""
        return f"{self.source}: ssd:DefaultExperiment has no stopTime"
