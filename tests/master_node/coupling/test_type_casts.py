"""Casts between types: all that lose nothing, and no other."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from master_node.coupling.type_casts import cast, mapped_cast
from protocol.variables import Variable, VariableType

INTEGERS = [kind for kind in VariableType if kind.integer_range is not None]
REALS = [kind for kind in VariableType if kind.is_real]


def of(kind: VariableType, **items: int) -> Variable:
    """A variable of that type, with these items of its enumeration."""
    return Variable("v", type=kind, items=items)


@pytest.mark.parametrize(("source", "target"), list(itertools.product(INTEGERS, INTEGERS)))
def test_an_integer_goes_where_its_whole_range_fits(
    source: VariableType, target: VariableType
) -> None:
    """The extreme values arrive as they are; a number need not be one of an enumeration."""
    assert source.integer_range is not None
    assert target.integer_range is not None
    how = cast(of(source), of(target))
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
    how = cast(of(source), of(target))
    assert (how is not None) == all(int(number(value)) == value for value in within)
    if how is not None:
        assert [type(how(value)) for value in within] == [float] * len(within)


def test_reals_only_widen() -> None:
    """Float32 to Float64, not back, and Real is Float64."""
    assert cast(of(VariableType.FLOAT32), of(VariableType.REAL)) is not None
    assert cast(of(VariableType.REAL), of(VariableType.FLOAT64)) is not None
    assert cast(of(VariableType.FLOAT64), of(VariableType.FLOAT32)) is None
    assert all(cast(of(real), of(integer)) is None for real in REALS for integer in INTEGERS)


def test_booleans_are_zero_or_one() -> None:
    """In every number type; nothing becomes a boolean, a string or bytes but itself."""
    for target in (*REALS, *INTEGERS):
        how = cast(of(VariableType.BOOLEAN), of(target))
        if target is VariableType.ENUMERATION:
            assert how is None
            continue
        assert how is not None
        assert [how(False), how(True)] == [0, 1]
        assert type(how(True)) is (float if target.is_real else int)
    for target in (VariableType.BOOLEAN, VariableType.STRING, VariableType.BINARY):
        for source in VariableType:
            assert (cast(of(source), of(target)) is not None) == (source is target)


def test_clocks_carry_no_value() -> None:
    """They cannot be connected, not even to each other."""
    for kind in VariableType:
        assert cast(of(VariableType.CLOCK), of(kind)) is None
        assert cast(of(kind), of(VariableType.CLOCK)) is None


@pytest.mark.parametrize(("source", "target"), list(itertools.product(VariableType, VariableType)))
def test_a_mapping_is_for_booleans_or_for_integers(
    source: VariableType, target: VariableType
) -> None:
    """Entries come first, then the cast between the types; without one there is no other value."""
    booleans = mapped_cast(of(source), of(target), {True: False})
    assert (booleans is not None) == (source is target is VariableType.BOOLEAN)
    numbers = mapped_cast(of(source), of(target), {5: 7})
    assert (numbers is not None) == (source in INTEGERS and target in INTEGERS)
    if numbers is None:
        return
    assert numbers(5) == 7
    if cast(of(source), of(target)) is None:
        with pytest.raises(KeyError):
            numbers(6)
    else:
        assert numbers(6) == 6
    assert target.integer_range is not None
    assert mapped_cast(of(source), of(target), {5: target.integer_range[1] + 1}) is None


@pytest.mark.parametrize("source", INTEGERS)
def test_an_integer_becomes_the_item_that_has_its_number(source: VariableType) -> None:
    """Any integer type goes to an enumeration whose items are known; a number of none does not."""
    gear = of(VariableType.ENUMERATION, reverse=-1, neutral=0, first=5)
    how = cast(of(source), gear)
    assert how is not None
    assert [how(number) for number in (-1, 0, 5)] == [-1, 0, 5]
    with pytest.raises(KeyError):
        how(1)


def test_an_enumeration_goes_where_its_items_fit() -> None:
    """By the numbers of its items: to smaller integers, to floats, and to other enumerations."""
    gear = of(VariableType.ENUMERATION, reverse=-1, first=5)
    assert cast(gear, of(VariableType.INT8)) is not None
    assert cast(gear, of(VariableType.UINT8)) is None
    assert cast(gear, of(VariableType.FLOAT32)) is not None
    assert cast(gear, of(VariableType.ENUMERATION, low=-1, high=5, highest=6)) is not None
    other = cast(gear, of(VariableType.ENUMERATION, high=5))
    assert other is not None
    assert other(5) == 5
    with pytest.raises(KeyError):
        other(-1)


def test_a_mapping_leads_to_items() -> None:
    """An entry for a number that no item has is refused before anything starts."""
    gear = of(VariableType.ENUMERATION, reverse=-1, first=5)
    mapped = mapped_cast(of(VariableType.INT32), gear, {1: 5})
    assert mapped is not None
    assert mapped(1) == 5
    assert mapped(-1) == -1
    with pytest.raises(KeyError):
        mapped(0)
    assert mapped_cast(of(VariableType.INT32), gear, {1: 6}) is None
