"""Saved states of slaves that hold more than their FMU: the FMU's own, and numbers beside it."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from protocol.errors import SlaveError
from protocol.signals import FloatArray

_MAGIC = b"2StepFmu"
_VERSION = 1
_HEADER = struct.Struct("<8sHII")  # magic, version, count of numbers, CRC of all behind


@dataclass(frozen=True, slots=True, eq=False)
class SavedState:
    """A saved state.

    Attributes:
        fmu: the state that the FMU saved, None if it saves none.
        numbers: what the slave keeps beside it, shape (n,).
    """

    fmu: object
    numbers: FloatArray


def pack(numbers: FloatArray, fmu: bytes) -> bytes:
    """A saved state as bytes; the numbers are little-endian.

    Args:
        numbers: see `SavedState`.
        fmu: the FMU's state, serialized.
    """
    body = numbers.astype("<f8").tobytes() + fmu
    return _HEADER.pack(_MAGIC, _VERSION, len(numbers), zlib.crc32(body)) + body


def unpack(data: bytes, count: int) -> tuple[FloatArray, bytes]:
    """The numbers and the FMU's part of what `pack` gave.

    Args:
        data: from `pack`.
        count: of the numbers.

    Raises:
        SlaveError: the bytes are damaged, or another number of numbers is in them.
    """
    if len(data) < _HEADER.size + 8 * count:
        raise SlaveError(f"{len(data)} bytes are not a state of this slave")
    magic, version, found, checksum = _HEADER.unpack_from(data)
    body = data[_HEADER.size :]
    if magic != _MAGIC or version != _VERSION or found != count:
        raise SlaveError("these bytes are not a state of this slave")
    if zlib.crc32(body) != checksum:
        raise SlaveError("the saved state is damaged")
    return np.frombuffer(body[: 8 * count], "<f8").astype(float), body[8 * count :]
