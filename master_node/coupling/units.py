"""Units of both ends of a connection: the factor and the offset between them.

A unit is value_SI = factor * value + offset (FMI 2.0, section 2.2.2; FMI 3.0, section 2.4.3), so an
input in one unit follows from an output in another by one factor and one offset.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from protocol.variables import Unit

_BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


class Transformation(NamedTuple):
    """input = factor * output + offset.

    Attributes:
        factor: unit of the input per unit of the output.
        offset: in the unit of the input.
    """

    factor: float = 1.0
    offset: float = 0.0

    @property
    def is_identity(self) -> bool:
        """True if the value is handed on as it is."""
        return self == IDENTITY


IDENTITY = Transformation()


class UnitMismatchError(ValueError):
    """Two units measure different things; the message says which."""


class UnknownUnitError(ValueError):
    """Two units have different names, and at least one of them is not defined."""


def conversion(
    source: str,
    source_units: Mapping[str, Unit],
    target: str,
    target_units: Mapping[str, Unit],
) -> Transformation:
    """From a value in the unit ``source`` to one in the unit ``target``.

    Args:
        source: name of the unit; "" if the output has none.
        source_units: definitions by name, of the output's slave.
        target: name of the unit; "" if the input has none.
        target_units: definitions by name, of the input's slave.

    Raises:
        UnitMismatchError: the units differ in their base-unit exponents.
        UnknownUnitError: the names differ and say nothing.
    """
    one, other = source_units.get(source), target_units.get(target)
    if not source or not target:
        return IDENTITY
    if one is None or other is None:
        if source == target:
            return IDENTITY
        undefined = [name for name, unit in ((source, one), (target, other)) if unit is None]
        raise UnknownUnitError(f"{source!r} and {target!r}: {' and '.join(undefined)} not defined")
    if one.exponents != other.exponents:
        raise UnitMismatchError(
            f"{source!r} is {_dimension(one)}, {target!r} is {_dimension(other)}"
        )
    if one == other:
        return IDENTITY
    return Transformation(one.factor / other.factor, (one.offset - other.offset) / other.factor)


def _dimension(unit: Unit) -> str:
    """A unit's base units, such as ``kg m2 s-2``."""
    parts = [
        name if exponent == 1 else f"{name}{exponent}"
        for name, exponent in zip(_BASE_UNITS, unit.exponents, strict=True)
        if exponent
    ]
    return " ".join(parts) or "a plain number"
