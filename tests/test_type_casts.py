"""Casts between types: all that lose nothing, and no other."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from master_node.type_casts import cast, mapped_cast
from protocol.slave import VariableType

INTEGERS = [kind for kind in VariableType if kind.integer_range is not None]
REALS = [kind for kind in VariableType if kind.is_real]


@pytest.mark.parametrize(("source", "target"), list(itertools.product(INTEGERS, INTEGERS)))
def test_an_integer_goes_where_its_whole_range_fits(
    source: VariableType, target: VariableType
) -> None:
    """The extreme values arrive as they are; a number need not be one of an enumeration."""
    assert source.integer_range is not None
    assert target.integer_range is not None
    how = cast(source, target)
    fits = all(
        target.integer_range[0] <= v <= target.integer_range[1] for v in source.integer_range
    )
    if source is target or (fits and target is not VariableType.ENUMERATION):
        assert how is not None
        assert [how(value) for value in source.integer_range] == list(source.integer_range)
    else:
        assert how is None


@pytest.mark.parametrize(("source", "target"), list(itertools.product(INTEGERS, REALS)))
def test_an_integer_goes_to_a_float_that_holds_all_of_them(
    source: VariableType, target: VariableType
) -> None:
    """Every value of the type comes back from the float; where one would not, there is no cast."""
    assert source.integer_range is not None
    number = np.float32 if target is VariableType.FLOAT32 else np.float64
    extremes = [value + step for value in source.integer_range for step in (-1, 0, 1)]
    within = [v for v in extremes if source.integer_range[0] <= v <= source.integer_range[1]]
    how = cast(source, target)
    assert (how is not None) == all(int(number(value)) == value for value in within)
    if how is not None:
        assert [type(how(value)) for value in within] == [float] * len(within)


def test_reals_only_widen() -> None:
    """Float32 to Float64, not back, and Real is Float64."""
    assert cast(VariableType.FLOAT32, VariableType.REAL) is not None
    assert cast(VariableType.REAL, VariableType.FLOAT64) is not None
    assert cast(VariableType.FLOAT64, VariableType.FLOAT32) is None
    assert all(cast(real, integer) is None for real in REALS for integer in INTEGERS)


def test_booleans_are_zero_or_one() -> None:
    """In every number type; nothing becomes a boolean, a string or bytes but itself."""
    for target in (*REALS, *INTEGERS):
        how = cast(VariableType.BOOLEAN, target)
        if target is VariableType.ENUMERATION:
            assert how is None
            continue
        assert how is not None
        assert [how(False), how(True)] == [0, 1]
        assert type(how(True)) is (float if target.is_real else int)
    for target in (VariableType.BOOLEAN, VariableType.STRING, VariableType.BINARY):
        for source in VariableType:
            assert (cast(source, target) is not None) == (source is target)


def test_clocks_carry_no_value() -> None:
    """They cannot be connected, not even to each other."""
    for kind in VariableType:
        assert cast(VariableType.CLOCK, kind) is None
        assert cast(kind, VariableType.CLOCK) is None


@pytest.mark.parametrize(("source", "target"), list(itertools.product(VariableType, VariableType)))
def test_a_mapping_is_for_booleans_or_for_integers(
    source: VariableType, target: VariableType
) -> None:
    """Entries come first, then the cast between the types; without one there is no other value."""
    booleans = mapped_cast(source, target, {True: False})
    assert (booleans is not None) == (source is target is VariableType.BOOLEAN)
    numbers = mapped_cast(source, target, {5: 7})
    assert (numbers is not None) == (source in INTEGERS and target in INTEGERS)
    if numbers is None:
        return
    assert numbers(5) == 7
    if cast(source, target) is None:
        with pytest.raises(KeyError):
            numbers(6)
    else:
        assert numbers(6) == 6
    assert target.integer_range is not None
    assert mapped_cast(source, target, {5: target.integer_range[1] + 1}) is None
