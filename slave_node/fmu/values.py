"""Values of any type, exchanged with an FMU in one call for each type.

Not for the hot path: see ``exchange.py`` for continuous variables.
"""

from __future__ import annotations

import ctypes
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from protocol.errors import ConfigurationError, SlaveError
from protocol.variables import StartValue, VariableType
from slave_node.fmu.variables import Place


@dataclass(frozen=True, slots=True)
class ValueType:
    """Exchange of the variables of a type.

    Attributes:
        function: what stands behind Get and Set in the names of the functions.
        c_type: of one value.
    """

    function: str
    c_type: Any

    @property
    def bounds(self) -> tuple[int, int] | None:
        """The smallest and the largest value of an integer type."""
        return VariableType(self.function).integer_range


class Caller(Protocol):
    """Instance of an FMU that exchanges values."""

    def value_type(self, kind: VariableType, name: str) -> ValueType:
        """Exchange of a variable called ``name``; SlaveError if there is none."""
        ...

    def exchange(self, function: str, references: Any, arrays: Sequence[Any], values: int) -> None:
        """Call fmiXGet... or fmiXSet...; SlaveError if the FMU refuses."""
        ...


class ValueGroup(ABC):
    """Values of some variables of one type, of arrays always all elements.

    Args:
        caller: the FMU.
        value_type: of all of them.
        places: of the scalar variables.

    Attributes:
        raw: one value for each element, as C has it.
    """

    def __init__(self, caller: Caller, value_type: ValueType, places: Sequence[Place]) -> None:
        sizes = {place.reference: place.size for place in places}
        ends = np.cumsum(list(sizes.values()), dtype=int).tolist()
        begins = dict(zip(sizes, [0, *ends], strict=False))
        elements = [begins[place.reference] + place.element for place in places]
        self._caller = caller
        self._function = value_type.function
        self._references = np.array(list(sizes), dtype=np.uint32)
        self._elements = elements
        self._negated = [place.is_negated for place in places]
        self._has_gaps = len(set(elements)) < ends[-1]
        self.raw: list[Any] = [None] * ends[-1]

    def receive(self) -> None:
        """Get all from the FMU."""
        arrays = self._arrays()
        self._caller.exchange(f"Get{self._function}", self._references, arrays, len(self.raw))
        self.raw = self._read(arrays)

    def send(self) -> None:
        """Set all in the FMU."""
        arrays = self._arrays()
        kept = self._write(arrays)
        self._caller.exchange(f"Set{self._function}", self._references, arrays, len(self.raw))
        del kept

    def put(self, values: Sequence[StartValue]) -> None:
        """Take over one value for each variable; the other elements of arrays stay as they are."""
        if self._has_gaps:
            self.receive()
        for element, value, is_negated in zip(self._elements, values, self._negated, strict=True):
            self.raw[element] = self._encoded(_negative(value) if is_negated else value)

    def take(self) -> list[StartValue]:
        """One value for each variable."""
        values = [self._decoded(self.raw[element]) for element in self._elements]
        return [
            _negative(value) if is_negated else value
            for value, is_negated in zip(values, self._negated, strict=True)
        ]

    @abstractmethod
    def _arrays(self) -> list[Any]:
        """New C arrays for all values."""

    @abstractmethod
    def _read(self, arrays: list[Any]) -> list[Any]:
        """The values in the arrays, as copies."""

    @abstractmethod
    def _write(self, arrays: list[Any]) -> object:
        """Fill the arrays; they point into the result."""

    def _encoded(self, value: StartValue) -> Any:
        return value

    def _decoded(self, raw: Any) -> StartValue:
        value: StartValue = raw
        return value


class NumberGroup(ValueGroup):
    """Numbers and truth values."""

    def __init__(self, caller: Caller, value_type: ValueType, places: Sequence[Place]) -> None:
        super().__init__(caller, value_type, places)
        self._c_type = value_type.c_type
        self._is_boolean = value_type.function == VariableType.BOOLEAN

    def _arrays(self) -> list[Any]:
        return [(self._c_type * len(self.raw))()]

    def _read(self, arrays: list[Any]) -> list[Any]:
        return list(arrays[0])

    def _write(self, arrays: list[Any]) -> object:
        arrays[0][:] = self.raw
        return None

    def _encoded(self, value: StartValue) -> Any:
        return self._c_type(value).value  # a Float32 as it will be

    def _decoded(self, raw: Any) -> StartValue:
        return bool(raw) if self._is_boolean else raw


class StringGroup(ValueGroup):
    """Strings."""

    def _arrays(self) -> list[Any]:
        return [(ctypes.c_char_p * len(self.raw))()]

    def _read(self, arrays: list[Any]) -> list[Any]:
        return [text or b"" for text in arrays[0]]

    def _write(self, arrays: list[Any]) -> object:
        arrays[0][:] = self.raw
        return self.raw

    def _encoded(self, value: StartValue) -> Any:
        assert isinstance(value, str)
        return value.encode()

    def _decoded(self, raw: Any) -> StartValue:
        try:
            return str(raw, "utf-8")
        except UnicodeDecodeError as error:
            raise SlaveError(f"a string of the FMU is not UTF-8: {raw!r:.80}") from error


class BinaryGroup(ValueGroup):
    """Byte strings with their sizes."""

    def _arrays(self) -> list[Any]:
        n = len(self.raw)
        return [(ctypes.c_size_t * n)(), (ctypes.c_void_p * n)()]

    def _read(self, arrays: list[Any]) -> list[Any]:
        return [
            ctypes.string_at(address, size) if size else b""
            for size, address in zip(*arrays, strict=True)
        ]

    def _write(self, arrays: list[Any]) -> object:
        buffers = [ctypes.create_string_buffer(data, len(data) + 1) for data in self.raw]
        arrays[0][:] = [len(data) for data in self.raw]
        arrays[1][:] = [ctypes.addressof(buffer) for buffer in buffers]
        return buffers


_GROUPS: Mapping[str, type[ValueGroup]] = {"String": StringGroup, "Binary": BinaryGroup}


class DiscreteExchange:
    """Values of some variables of any types, in the order of their names.

    Args:
        caller: the FMU.
        places: by name, in order.
    """

    def __init__(self, caller: Caller, places: Mapping[str, Place]) -> None:
        self._places = places
        self._types = {name: caller.value_type(p.type, name) for name, p in places.items()}
        members: dict[ValueType, list[int]] = {}
        for position, value_type in enumerate(self._types.values()):
            members.setdefault(value_type, []).append(position)
        ordered = list(places.values())
        self._groups = [
            (
                _GROUPS.get(value_type.function, NumberGroup)(
                    caller, value_type, [ordered[i] for i in positions]
                ),
                positions,
            )
            for value_type, positions in members.items()
        ]

    def put(
        self, values: Sequence[StartValue], error: type[SlaveError | ConfigurationError]
    ) -> None:
        """Take over the values that `send` is to set.

        Raises:
            SlaveError: another number of values, or the FMU refused.
            error: a value is not of the type of its variable.
        """
        checked = self._checked(values, error)
        for group, positions in self._groups:
            group.put([checked[i] for i in positions])

    def put_changes(self, values: Sequence[StartValue]) -> bool:
        """Set values; returns whether that changes anything in the FMU."""
        checked = self._checked(values, SlaveError)
        is_changed = False
        for group, positions in self._groups:
            group.receive()
            before = list(group.raw)
            group.put([checked[i] for i in positions])
            is_changed |= group.raw != before
        return is_changed

    def send(self) -> None:
        """Set them in the FMU."""
        for group, _ in self._groups:
            group.send()

    def receive(self) -> tuple[StartValue, ...]:
        """Get them from the FMU."""
        values: list[Any] = [None] * len(self._places)
        for group, positions in self._groups:
            group.receive()
            for position, value in zip(positions, group.take(), strict=True):
                values[position] = value
        return tuple(values)

    def _checked(
        self, values: Sequence[StartValue], error: type[SlaveError | ConfigurationError]
    ) -> list[StartValue]:
        if len(values) != len(self._places):
            raise SlaveError(f"{len(values)} discrete values for {len(self._places)} variables")
        return [
            _checked(name, place.type, self._types[name].bounds, value, error)
            for (name, place), value in zip(self._places.items(), values, strict=True)
        ]


def _checked(
    name: str,
    kind: VariableType,
    bounds: tuple[int, int] | None,
    value: StartValue,
    error: type[SlaveError | ConfigurationError],
) -> StartValue:
    """The value in the type of its variable."""
    if kind.is_real and type(value) in (float, int):
        if math.isnan(value) and error is SlaveError:  # type: ignore[arg-type]
            raise error(f"{name!r} cannot be NaN")
        return float(value)
    accepted = _ACCEPTED.get(kind, int)
    is_within = not (bounds and type(value) is int) or bounds[0] <= value <= bounds[1]
    if type(value) is accepted and is_within and not (accepted is str and "\0" in str(value)):
        return value
    limits = f", {bounds[0]} to {bounds[1]}" if bounds else ""
    raise error(f"{name!r} is of type {kind}{limits}; it cannot be {value!r:.80}")


_ACCEPTED: Mapping[VariableType, type] = {
    VariableType.REAL: float,
    VariableType.FLOAT32: float,
    VariableType.FLOAT64: float,
    VariableType.BOOLEAN: bool,
    VariableType.STRING: str,
    VariableType.BINARY: bytes,
}
"""All others are integers."""


def _negative(value: StartValue) -> StartValue:
    """Value of a negated alias (FMI 1.0)."""
    if isinstance(value, bool):
        return not value
    assert isinstance(value, int | float)
    return -value
