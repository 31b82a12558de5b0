"""Types that can be handed on as others without losing anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from protocol.variables import StartValue, Variable, VariableType

Cast = Callable[[StartValue], StartValue]

_EXACT_INTEGERS = {
    VariableType.FLOAT32: 2**24,
    VariableType.REAL: 2**53,
    VariableType.FLOAT64: 2**53,
}
"""Up to here a floating-point type holds every integer."""


def cast(source: Variable, target: Variable) -> Cast | None:
    """Cast of a value of ``source`` to one of ``target``.

    An integer becomes an enumeration's item that has its number.

    Returns:
        None if a value could be lost or changed on the way.
    """
    if source.type is VariableType.CLOCK or target.type is VariableType.CLOCK:
        return None
    if target.items and source.type.integer_range is not None:
        return _to_items(source, target)
    if source.type is target.type:
        return _same
    if source.type.is_real:
        narrows = target.type is VariableType.FLOAT32
        return _same if target.type.is_real and not narrows else None
    if source.type is VariableType.BOOLEAN:
        return _from_boolean(target.type)
    values = source.type.integer_range
    if source.items:
        values = min(source.items.values()), max(source.items.values())
    return None if values is None else _from_integer(values, target.type)


@dataclass(frozen=True, slots=True)
class ItemCast:
    """From integers to the items of an enumeration; KeyError for a number that no item has.

    Attributes:
        items: their numbers.
    """

    items: frozenset[int]

    def __call__(self, value: StartValue) -> StartValue:
        """The number itself."""
        if value not in self.items:
            raise KeyError(value)
        return value


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
    source: Variable,
    target: Variable,
    entries: Mapping[bool, bool] | Mapping[int, int],
) -> MappedCast | None:
    """Cast of values of one type to values of another by a mapping.

    Args:
        source: the output.
        target: the input.
        entries: booleans to booleans, or integers to integers.

    Returns:
        None if the types are not those of the entries: both Boolean, or both integers or
        enumerations; or if an entry does not fit ``target``.
    """
    types = (source.type, target.type)
    if all(isinstance(value, bool) for pair in entries.items() for value in pair):
        fits = types == (VariableType.BOOLEAN, VariableType.BOOLEAN)
    else:
        bounds, items = target.type.integer_range, target.items.values()
        fits = (
            source.type.integer_range is not None
            and bounds is not None
            and all(bounds[0] <= value <= bounds[1] for value in entries.values())
            and (not items or set(entries.values()).issubset(items))
        )
    return MappedCast(entries, cast(source, target)) if fits else None


def _to_items(source: Variable, target: Variable) -> Cast:
    items = frozenset(target.items.values())
    fits = source.items and items.issuperset(source.items.values())
    return _same if fits else ItemCast(items)


def _from_boolean(target: VariableType) -> Cast | None:
    if target.is_real:
        return float
    if target.integer_range is not None and target is not VariableType.ENUMERATION:
        return int
    return None


def _from_integer(values: tuple[int, int], target: VariableType) -> Cast | None:
    """From integers in a range; of an enumeration without known items none is known to be one."""
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
