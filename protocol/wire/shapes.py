"""Shapes of programs and replies: messages without their numbers.

From one double step to the next only the numbers change, so a shape is parsed and checked once and
then looked up: the hot path is one copy of a block of numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from protocol.errors import MalformedMessageError
from protocol.signals import MAX_ORDER, FloatArray
from protocol.wire.packing import LITTLE_ENDIAN, MAX_COLUMNS, SMALL_MESSAGE

CACHED_SHAPES: Final = 256
Maker = Callable[[FloatArray], Any]


class Plan(NamedTuple):
    """Recipe that makes the items of a message of one shape from its numbers.

    Attributes:
        items: those that need no numbers, None where one does.
        made: index, maker and place in the numbers of those that do.
        size: number of numbers.
    """

    items: list[Any]
    made: list[tuple[int, Maker, int, int]]
    size: int

    def build(self, numbers: bytes, what: str) -> list[Any]:
        """Items of the message; the arrays among them are read-only views of ``numbers``."""
        if len(numbers) != 8 * self.size:
            raise MalformedMessageError(
                f"{what} has {len(numbers)} bytes of numbers where its shape wants {8 * self.size}"
            )
        block = np.frombuffer(numbers, LITTLE_ENDIAN)
        items = self.items.copy()
        for index, make, begin, end in self.made:
            items[index] = make(block[begin:end])
        return items


class PlanBuilder:
    """Collection of the items of a shape, in order."""

    def __init__(self) -> None:
        self._items: list[Any] = []
        self._made: list[tuple[int, Maker, int, int]] = []
        self._size = 0

    def add(self, item: Any) -> None:
        """An item that needs no numbers."""
        self._items.append(item)

    def add_made(self, make: Maker, size: int) -> None:
        """An item that is made of the next ``size`` numbers."""
        self._made.append((len(self._items), make, self._size, self._size + size))
        self._items.append(None)
        self._size += size

    def plan(self) -> Plan:
        """Plan of the items so far."""
        return Plan(self._items, self._made, self._size)


def matrix_size(rows: Any, columns: Any, what: str) -> tuple[int, int]:
    """Rows and columns of an array in a shape."""
    if type(rows) is not int or not 1 <= rows <= MAX_ORDER + 1:
        raise MalformedMessageError(f"{what} must have 1 to {MAX_ORDER + 1} rows")
    if type(columns) is not int or not 0 <= columns <= MAX_COLUMNS:
        raise MalformedMessageError(f"{what} must have 0 to {MAX_COLUMNS} columns")
    return rows, columns


def is_cached(shape: bytes) -> bool:
    """True for a shape worth keeping; one with long lists of names comes once."""
    return len(shape) <= SMALL_MESSAGE


def shape_and_numbers(value: Any, what: str) -> tuple[bytes, bytes]:
    """Both byte strings of ``[shape, numbers]``."""
    if type(value) is list and len(value) == 2:
        shape, numbers = value
        if type(shape) is bytes and type(numbers) is bytes:
            return shape, numbers
    raise MalformedMessageError(f"{what} must be [shape, numbers], both bytes")
