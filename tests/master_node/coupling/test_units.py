"""Units: conversions are what their definitions say, and back is the inverse."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from master_node.coupling.units import IDENTITY, UnitMismatchError, UnknownUnitError, conversion
from protocol.variables import Unit

LENGTH = (0, 1, 0, 0, 0, 0, 0, 0)
TEMPERATURE = (0, 0, 0, 0, 1, 0, 0, 0)
UNITS = {
    "m": Unit(LENGTH),
    "mm": Unit(LENGTH, 1e-3),
    "K": Unit(TEMPERATURE),
    "degC": Unit(TEMPERATURE, 1.0, 273.15),
    "degF": Unit(TEMPERATURE, 5.0 / 9.0, 459.67 * 5.0 / 9.0),
    "N.m": Unit((1, 2, -2, 0, 0, 0, 0, 0)),
    "%": Unit(factor=0.01),
}


def test_known_conversions() -> None:
    """Millimetres, degrees, percent."""
    assert conversion("mm", UNITS, "m", UNITS) == (1e-3, 0.0)
    factor, offset = conversion("degF", UNITS, "degC", UNITS)
    assert factor * 212.0 + offset == pytest.approx(100.0)
    assert conversion("m", UNITS, "m", UNITS) is IDENTITY
    assert conversion("", {}, "m", UNITS) is IDENTITY
    assert conversion("bar", {}, "bar", {}) is IDENTITY


@given(
    value=st.floats(-1e6, 1e6),
    units=st.tuples(
        *[st.builds(Unit, st.just(LENGTH), st.floats(1e-6, 1e6), st.floats(-1e3, 1e3))] * 2
    ),
)
def test_a_value_means_the_same_in_both_units(value: float, units: tuple[Unit, Unit]) -> None:
    """Both ends have the same value in SI units."""
    one, other = units
    factor, offset = conversion("a", {"a": one}, "b", {"b": other})
    si = one.factor * value + one.offset
    converted = factor * value + offset
    scale = max(abs(one.factor * value), abs(one.offset), abs(other.offset), 1e-9)
    assert other.factor * converted + other.offset == pytest.approx(si, abs=1e-12 * scale)


def test_different_dimensions_are_named() -> None:
    """Both, in base units."""
    with pytest.raises(UnitMismatchError, match=r"'N.m' is kg m2 s-2, 'K' is K"):
        conversion("N.m", UNITS, "K", UNITS)
    with pytest.raises(UnitMismatchError, match="'%' is a plain number"):
        conversion("%", UNITS, "K", UNITS)


def test_names_that_say_nothing_are_told_apart_from_equal_ones() -> None:
    """Units without a definition are named."""
    with pytest.raises(UnknownUnitError, match="bar not defined"):
        conversion("bar", {}, "m", UNITS)
