"""Which type can be handed on as which other without losing anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from protocol.slave import StartValue, VariableType

Cast = Callable[[StartValue], StartValue]

_EXACT_INTEGERS = {
    VariableType.FLOAT32: 2**24,
    VariableType.REAL: 2**53,
    VariableType.FLOAT64: 2**53,
}
"""Up to here a floating-point type holds every integer."""


def cast(source: VariableType, target: VariableType) -> Cast | None:
    """How a value of type ``source`` becomes one of type ``target``.

    Returns:
        None if a value could be lost or changed on the way.
    """
    if source is VariableType.CLOCK or target is VariableType.CLOCK:
        return None
    if source is target:
        return _same
    if source.is_real:
        narrows = target is VariableType.FLOAT32
        return _same if target.is_real and not narrows else None
    if source is VariableType.BOOLEAN:
        return _from_boolean(target)
    if source.integer_range is not None:
        return _from_integer(source.integer_range, target)
    return None


@dataclass(frozen=True, slots=True)
class MappedCast:
    """A cast by a table of single values; KeyError for one that neither it nor a cast is for.

    Attributes:
        entries: what a value becomes.
        unmapped: for all other values; None: there is no cast between the types.
    """

    entries: Mapping[bool, bool] | Mapping[int, int]
    unmapped: Cast | None

    def __call__(self, value: StartValue) -> StartValue:
        """The value of the one type that belongs to ``value`` of the other."""
        mapped = self.entries.get(value)  # type: ignore[arg-type]
        if mapped is not None:
            return mapped
        if self.unmapped is None:
            raise KeyError(value)
        return self.unmapped(value)


def mapped_cast(
    source: VariableType,
    target: VariableType,
    entries: Mapping[bool, bool] | Mapping[int, int],
) -> MappedCast | None:
    """How values of one type become some of another by a mapping.

    Args:
        source: type of the output.
        target: type of the input.
        entries: booleans to booleans, or integers to integers.

    Returns:
        None if the types are not those of the entries: both Boolean, or both integers or
        enumerations; or if an entry does not fit the type ``target``.
    """
    types = (source, target)
    if all(isinstance(value, bool) for pair in entries.items() for value in pair):
        fits = types == (VariableType.BOOLEAN, VariableType.BOOLEAN)
    else:
        bounds = target.integer_range
        fits = (
            source.integer_range is not None
            and bounds is not None
            and all(bounds[0] <= value <= bounds[1] for value in entries.values())
        )
    return MappedCast(entries, cast(source, target)) if fits else None


def _from_boolean(target: VariableType) -> Cast | None:
    if target.is_real:
        return float
    if target.integer_range is not None and target is not VariableType.ENUMERATION:
        return int
    return None


def _from_integer(values: tuple[int, int], target: VariableType) -> Cast | None:
    """From an integer type with a range; no integer can be relied on to be an enumeration's."""
    smallest, largest = values
    if target.is_real:
        bound = _EXACT_INTEGERS[target]
        return float if -bound <= smallest and largest <= bound else None
    if target.integer_range is None or target is VariableType.ENUMERATION:
        return None
    least, most = target.integer_range
    return _same if least <= smallest and largest <= most else None


def _same(value: StartValue) -> StartValue:
    return value
