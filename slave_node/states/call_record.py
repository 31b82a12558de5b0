"""Everything that was asked of a slave since it was instantiated, compactly, to be done again.

A call takes one byte, and eight more for each number that it carries.
"""

from __future__ import annotations

import struct
import sys
import zlib
from array import array
from collections.abc import Iterator

import numpy as np

from protocol.calls import (
    Call,
    DoStep,
    ExitInitializationMode,
    GetDiscreteOutputs,
    GetOutputs,
    GetRecordedVariables,
    Initialize,
    SetDiscreteInputs,
    SetInputs,
    SetValues,
)
from protocol.errors import DoublestepError, SlaveError
from protocol.signals import MAX_ORDER
from protocol.wire.programs import decode_program, encode_program

_MAGIC = b"2StepRec"
_VERSION = 1
_HEADER = struct.Struct("<8sHIQQQQ")  # magic, version, CRC of the body, sizes of its four parts
_LENGTH = struct.Struct("<Q")

_SET_INPUTS = 0  # plus the highest row
_GET_OUTPUTS = 8  # plus the order
_DO_STEP = 16  # plus no_set_state_prior
_SET_DISCRETE_INPUTS = 24
_GET_DISCRETE_OUTPUTS = 25
_EXIT_INITIALIZATION_MODE = 26
_GET_RECORDED_VARIABLES = 27
_SET_VALUES = 28


class CallRecord:
    """The calls after `Initialize`, in order; it only grows.

    Args:
        initialize: the first call.
    """

    def __init__(self, initialize: Initialize) -> None:
        self._initialize = initialize
        self._operations = bytearray()
        self._numbers = array("d")
        self._discrete: list[SetDiscreteInputs | SetValues] = []

    def __len__(self) -> int:
        """Number of calls."""
        return len(self._operations)

    @property
    def size(self) -> int:
        """Bytes that the calls take, but for the values of discrete inputs."""
        return len(self._operations) + self._numbers.itemsize * len(self._numbers)

    def add(self, call: Call) -> None:
        """Record a call that has succeeded."""
        match call:
            case SetInputs(derivatives=derivatives):
                self._operations.append(_SET_INPUTS + len(derivatives) - 1)
                self._numbers.frombytes(np.ascontiguousarray(derivatives, np.float64).tobytes())
            case DoStep(time, step_size, no_set_state_prior):
                self._operations.append(_DO_STEP + no_set_state_prior)
                self._numbers.extend((time, step_size))
            case GetOutputs(order=order):
                self._operations.append(_GET_OUTPUTS + order)
            case SetDiscreteInputs():
                self._operations.append(_SET_DISCRETE_INPUTS)
                self._discrete.append(call)
            case SetValues():
                self._operations.append(_SET_VALUES)
                self._discrete.append(call)
            case GetDiscreteOutputs():
                self._operations.append(_GET_DISCRETE_OUTPUTS)
            case GetRecordedVariables():
                self._operations.append(_GET_RECORDED_VARIABLES)
            case ExitInitializationMode():
                self._operations.append(_EXIT_INITIALIZATION_MODE)
            case _:
                raise AssertionError(call)

    def calls(self) -> Iterator[Call]:
        """All calls again, `Initialize` first."""
        yield self._initialize
        columns = len(self._initialize.inputs)
        numbers = np.frombuffer(self._numbers.tobytes())
        discrete = iter(self._discrete)
        place = 0
        for operation in self._operations:
            if operation < _GET_OUTPUTS:
                rows = operation - _SET_INPUTS + 1
                end = place + rows * columns
                yield SetInputs(numbers[place:end].reshape(rows, columns))
                place = end
            elif operation < _DO_STEP:
                yield GetOutputs(operation - _GET_OUTPUTS)
            elif operation < _SET_DISCRETE_INPUTS:
                time, step_size = numbers[place : place + 2].tolist()
                yield DoStep(time, step_size, bool(operation - _DO_STEP))
                place += 2
            elif operation in (_SET_DISCRETE_INPUTS, _SET_VALUES):
                yield next(discrete)
            elif operation == _GET_DISCRETE_OUTPUTS:
                yield GetDiscreteOutputs()
            elif operation == _GET_RECORDED_VARIABLES:
                yield GetRecordedVariables()
            else:
                yield ExitInitializationMode()

    def copy(self, length: int) -> CallRecord:
        """A record of its own of the first ``length`` calls."""
        record = CallRecord(self._initialize)
        record._operations = self._operations[:length]
        numbers, discrete = self._carried(record._operations)
        record._numbers = self._numbers[:numbers]
        record._discrete = self._discrete[:discrete]
        return record

    def _carried(self, operations: bytes | bytearray) -> tuple[int, int]:
        """Number of numbers, and of other values, that some operations carry."""
        columns = len(self._initialize.inputs)
        numbers = sum(
            operations.count(_SET_INPUTS + order) * (order + 1) * columns
            for order in range(MAX_ORDER + 1)
        )
        numbers += 2 * sum(operations.count(_DO_STEP + prior) for prior in (0, 1))
        return numbers, operations.count(_SET_DISCRETE_INPUTS) + operations.count(_SET_VALUES)

    def to_bytes(self) -> bytes:
        """The record for another process."""
        numbers = array("d", self._numbers)
        if sys.byteorder == "big":
            numbers.byteswap()
        discrete = [encode_program([call]) for call in self._discrete]
        parts = (
            encode_program([self._initialize]),
            bytes(self._operations),
            numbers.tobytes(),
            b"".join(_LENGTH.pack(len(item)) + item for item in discrete),
        )
        body = b"".join(parts)
        return _HEADER.pack(_MAGIC, _VERSION, zlib.crc32(body), *map(len, parts)) + body

    @staticmethod
    def from_bytes(data: bytes) -> CallRecord:
        """The record that `to_bytes` gave.

        Raises:
            SlaveError: the bytes are none.
        """
        try:
            return _read(data)
        except (struct.error, DoublestepError, ValueError) as error:
            raise SlaveError(f"not a saved state of a slave that is replayed: {error}") from error


def _read(data: bytes) -> CallRecord:
    magic, version, check, *sizes = _HEADER.unpack_from(data)
    body = memoryview(data)[_HEADER.size :]
    if magic != _MAGIC or version != _VERSION:
        raise ValueError("it begins with something else")
    if sum(sizes) != len(body) or zlib.crc32(body) != check:
        raise ValueError("it is damaged")
    parts = []
    for size in sizes:
        parts.append(bytes(body[:size]))
        body = body[size:]
    initialize, operations, numbers, discrete = parts
    call = _only_call(initialize)
    if not isinstance(call, Initialize):
        raise ValueError("it does not begin with an initialization")  # noqa: TRY004
    record = CallRecord(call)
    record._operations = bytearray(operations)
    record._numbers.frombytes(numbers)
    if sys.byteorder == "big":
        record._numbers.byteswap()
    while discrete:
        (size,) = _LENGTH.unpack_from(discrete)
        values = _only_call(discrete[_LENGTH.size : _LENGTH.size + size])
        discrete = discrete[_LENGTH.size + size :]
        if not isinstance(values, SetDiscreteInputs | SetValues):
            raise ValueError("values are something else")  # noqa: TRY004
        record._discrete.append(values)
    if not _KNOWN.issuperset(operations):
        raise ValueError("it holds an unknown call")
    if record._carried(operations) != (len(record._numbers), len(record._discrete)):
        raise ValueError("its numbers do not fit its calls")
    return record


def _only_call(program: bytes) -> Call:
    (call,) = decode_program(program)
    return call


_KNOWN = frozenset(
    {
        *range(_SET_INPUTS, _SET_INPUTS + MAX_ORDER + 1),
        *range(_GET_OUTPUTS, _GET_OUTPUTS + MAX_ORDER + 1),
        *range(_DO_STEP, _DO_STEP + 2),
        _SET_DISCRETE_INPUTS,
        _GET_DISCRETE_OUTPUTS,
        _EXIT_INITIALIZATION_MODE,
        _GET_RECORDED_VARIABLES,
        _SET_VALUES,
    }
)
