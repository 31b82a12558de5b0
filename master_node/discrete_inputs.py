"""Discrete inputs that are driven from outside: tables whose values hold, functions of time.

A slave gets the value at the beginning of each step, and keeps it up to the end. Where a table
changes, and at the breakpoints of a function, there is a communication point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite, ulp
from sys import float_info
from typing import Any

import numpy as np
from numpy.typing import NDArray

from master_node.external_inputs import Jump, SignalFunction, beside_breakpoint
from master_node.numerics.input_tables import Table
from protocol.errors import SlaveError
from protocol.signals import FloatArray
from protocol.slave import StartValue, Variable, VariableType

_INSIDE = 8.0
_LARGEST_FLOAT = {VariableType.FLOAT32: float(np.finfo(np.float32).max)}
_TRUTH: dict[object, bool] = {"true": True, "false": False, 0: False, 1: True}


@dataclass(frozen=True, eq=False)
class HoldRows:
    """The rows of a ``hold`` table, for an input of any type.

    Attributes:
        times: increasing, shape (n,) [s].
        values: as they were given: numbers, booleans or texts, shape (n,).
        numbers: the same as a table of numbers; None where not all of them are.
    """

    times: FloatArray
    values: NDArray[Any]
    numbers: Table | None


@dataclass(frozen=True, eq=False)
class HeldTable:
    """Values that hold from their times on; the first one also before.

    Attributes:
        times: increasing, shape (n,) [s].
        values: of the input's type, n of them.
    """

    times: FloatArray
    values: tuple[StartValue, ...]

    def at(self, time: float) -> StartValue:
        """The value at ``time`` [s], behind a change there."""
        row = int(self.times.searchsorted(time + _INSIDE * ulp(abs(time)), "right"))
        return self.values[max(0, row - 1)]

    @property
    def changes(self) -> tuple[float, ...]:
        """When it changes [s]."""
        times = self.times.tolist()
        return tuple(
            times[row] for row in range(1, len(times)) if self.values[row] != self.values[row - 1]
        )


@dataclass(frozen=True, eq=False)
class HeldFunction:
    """A function that is asked at communication points.

    Attributes:
        slave: of the input.
        variable: the input.
        signal: the function.
    """

    slave: str
    variable: Variable
    signal: SignalFunction

    def at(self, time: float) -> StartValue:
        """The value at ``time`` [s], behind a breakpoint there.

        Raises:
            SlaveError: the function failed, or gave no value of the input's type.
        """
        points = np.array(self.signal.breakpoints)
        name = f"{self.slave}.{self.variable.name}"
        try:
            given = self.signal.function(beside_breakpoint(points, time, _INSIDE * ulp(abs(time))))
        except Exception as error:
            reason = f"the function of {name} failed: {type(error).__name__}: {error}"
            raise self._error(reason, time) from error
        try:
            return legal_value(self.variable, given)
        except ValueError:
            reason = f"{name} is of type {self.variable.type} and cannot be {given!r:.80}"
            raise self._error(reason, time) from None

    @property
    def changes(self) -> tuple[float, ...]:
        """The times that are said to be breakpoints [s]."""
        return self.signal.breakpoints

    def _error(self, reason: str, time: float) -> SlaveError:
        return SlaveError(reason, slave=self.slave, phase="external input", time=time)


@dataclass(frozen=True, eq=False)
class DrivenInput:
    """A discrete input that is driven from outside.

    Attributes:
        slave, variable: its names.
        signal: that drives it.
        is_searched: whether it may change where nobody has declared it, as a discrete output does.
    """

    slave: str
    variable: str
    signal: HeldTable | HeldFunction
    is_searched: bool

    @property
    def name(self) -> str:
        """``slave.variable``."""
        return f"{self.slave}.{self.variable}"

    @property
    def jumps(self) -> list[Jump]:
        """Its changes, as far as they are known."""
        return [Jump(time, self.name, is_held=True) for time in self.signal.changes]


def driven_input(slave: str, variable: Variable, signal: HoldRows | SignalFunction) -> DrivenInput:
    """An input with its signal.

    Raises:
        ValueError: a row has no value of the input's type; the message says which.
    """
    if isinstance(signal, SignalFunction):
        # A real one changes all the time, and what it does in between is what a sample leaves out.
        is_searched = not variable.type.is_real
        function = HeldFunction(slave, variable, signal)
        return DrivenInput(slave, variable.name, function, is_searched)
    values = []
    for row, given in enumerate(signal.values, 1):
        try:
            values.append(legal_value(variable, given))
        except ValueError:
            shown = given.item() if isinstance(given, np.generic) else given
            raise ValueError(
                f"row {row}: it is of type {variable.type} and cannot be {shown!r:.80}"
            ) from None
    table = HeldTable(signal.times, tuple(values))
    return DrivenInput(slave, variable.name, table, is_searched=False)


def legal_value(variable: Variable, given: object) -> StartValue:
    """A value out of a table, or of a function, as one of a variable's type.

    Texts are read as what the type asks for: numbers, ``true`` and ``false``, hexadecimal digits of
    a binary. 0 and 1 are booleans, 3.0 is an integer; nothing is rounded.

    Raises:
        ValueError: it is none.
    """
    value = given.item() if isinstance(given, np.generic) else given
    if variable.type is VariableType.STRING:
        return _of_type(value, str)
    if variable.type is VariableType.BINARY:
        return bytes.fromhex(value) if isinstance(value, str) else _of_type(value, bytes)
    if variable.type is VariableType.BOOLEAN:
        return _boolean(value)
    if isinstance(value, str):
        value = _number(value)
    if type(value) is float and not isfinite(value):
        raise ValueError
    if type(value) not in (int, float):
        raise ValueError
    assert isinstance(value, int | float)
    if variable.type.is_real:
        largest_number = _LARGEST_FLOAT.get(variable.type, float_info.max)
        if abs(value) > largest_number:
            raise ValueError
        return float(value)
    if variable.type.integer_range is None or value != int(value):
        raise ValueError
    smallest, largest = variable.type.integer_range
    if not smallest <= value <= largest:
        raise ValueError
    return int(value)


def _of_type(value: object, kind: Callable[..., StartValue]) -> StartValue:
    if type(value) is not kind:
        raise ValueError
    return value  # type: ignore[return-value]


def _boolean(value: object) -> bool:
    key = value.strip().lower() if isinstance(value, str) else value
    if isinstance(key, str) and key not in _TRUTH:
        key = _number(key)
    if not isinstance(key, str | int | float) or key not in _TRUTH:
        raise ValueError
    return _TRUTH[key]


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        return float(text)
