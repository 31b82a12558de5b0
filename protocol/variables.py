"""Variables of a slave, in FMI's words: causality, type, unit and what is declared of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

StartValue = float | int | bool | str | bytes
"""A value of a variable of any type; an enumeration's is its number."""


class Causality(StrEnum):
    """FMI 2.0, section 2.2.7, and FMI 3.0, section 2.4.7.4."""

    STRUCTURAL_PARAMETER = "structuralParameter"
    PARAMETER = "parameter"
    CALCULATED_PARAMETER = "calculatedParameter"
    INPUT = "input"
    OUTPUT = "output"
    LOCAL = "local"
    INDEPENDENT = "independent"


class VariableType(StrEnum):
    """The types of FMI 2.0 and FMI 3.0. Real is Float64 and Integer is Int32 by another name."""

    REAL = "Real"
    INTEGER = "Integer"
    BOOLEAN = "Boolean"
    STRING = "String"
    ENUMERATION = "Enumeration"
    FLOAT32 = "Float32"
    FLOAT64 = "Float64"
    INT8 = "Int8"
    UINT8 = "UInt8"
    INT16 = "Int16"
    UINT16 = "UInt16"
    INT32 = "Int32"
    UINT32 = "UInt32"
    INT64 = "Int64"
    UINT64 = "UInt64"
    BINARY = "Binary"
    CLOCK = "Clock"

    @property
    def is_real(self) -> bool:
        """True if its values are floating-point numbers."""
        return self in _REAL_TYPES

    @property
    def integer_range(self) -> tuple[int, int] | None:
        """The smallest and the largest value of an integer type; None for other types."""
        return _INTEGER_RANGES.get(self)


_REAL_TYPES = frozenset({VariableType.REAL, VariableType.FLOAT32, VariableType.FLOAT64})


def _signed(bits: int) -> tuple[int, int]:
    return -(2 ** (bits - 1)), 2 ** (bits - 1) - 1


_INTEGER_RANGES = {
    VariableType.INTEGER: _signed(32),
    VariableType.ENUMERATION: _signed(64),
    VariableType.INT8: _signed(8),
    VariableType.UINT8: (0, 2**8 - 1),
    VariableType.INT16: _signed(16),
    VariableType.UINT16: (0, 2**16 - 1),
    VariableType.INT32: _signed(32),
    VariableType.UINT32: (0, 2**32 - 1),
    VariableType.INT64: _signed(64),
    VariableType.UINT64: (0, 2**64 - 1),
}


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit in terms of SI base units: value_SI = factor * value + offset (FMI 2.0, 2.2.2).

    Attributes:
        exponents: of kg, m, s, A, K, mol, cd, rad.
        factor, offset: see above.
    """

    exponents: tuple[int, ...] = (0, 0, 0, 0, 0, 0, 0, 0)
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Variable:
    """A scalar variable of a slave, in FMI's words.

    The elements of an array are variables of their own, named ``array[i,j]`` with indices from 1.

    Attributes:
        name: unique within the slave.
        unit: unit name as declared, "" if none.
        start: start value, None if the model gives none.
        nominal: nominal value, in ``unit``; scales the absolute tolerance.
        minimum, maximum: smallest and largest value [``unit``]; None: no bound is declared.
        items: of an enumeration: the number of each item by its name; empty for other types.
    """

    name: str
    causality: Causality = Causality.LOCAL
    type: VariableType = VariableType.REAL
    variability: str = "continuous"
    unit: str = ""
    start: StartValue | None = None
    nominal: float = 1.0
    description: str = ""
    minimum: float | int | None = None
    maximum: float | int | None = None
    items: Mapping[str, int] = field(default_factory=dict, hash=False)

    @property
    def has_bounds(self) -> bool:
        """True if values are declared that it must not have."""
        return bool(self.items) or self.minimum is not None or self.maximum is not None

    @property
    def is_continuous_real(self) -> bool:
        """True for what takes part in extrapolation and in the error norm."""
        return self.type.is_real and self.variability == "continuous"

    @property
    def is_discrete(self) -> bool:
        """True for what is held between communication points; clocks carry no value."""
        return not self.is_continuous_real and self.type is not VariableType.CLOCK
