"""Discrete inputs that are driven from outside: tables whose values hold, functions of time.

A slave gets the value at the beginning of each step, and keeps it up to the end. Where a table
changes, and at the breakpoints of a function, there is a communication point.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, ulp
from typing import Any

import numpy as np
from numpy.typing import NDArray

from master_node.inputs.continuous import Jump, SignalFunction, beside_breakpoint
from master_node.numerics.input_tables import Table
from protocol.errors import SlaveError
from protocol.signals import FloatArray
from protocol.values import checked_value, parsed
from protocol.variables import StartValue, Variable

_INSIDE = 8.0


@dataclass(frozen=True, eq=False)
class HoldRows:
    """The rows of a ``hold`` table, for an input of any type.

    Attributes:
        times: increasing, shape (n,) [s].
        values: as they were given: numbers, booleans or texts, shape (n,).
        numbers: the same as a table of numbers; None where not all of them are.
        unit: of the values, as their file says; "" where it says none.
    """

    times: FloatArray
    values: NDArray[Any]
    numbers: Table | None
    unit: str = ""


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
        """Times of its changes [s]."""
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
        ignores_bounds: take values that the model excludes for the input.
    """

    slave: str
    variable: Variable
    signal: SignalFunction
    ignores_bounds: bool = False

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
            return legal_value(self.variable, given, ignores_bounds=self.ignores_bounds)
        except ValueError as error:
            raise self._error(f"{name} {error}", time) from None

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
        is_searched: whether it may change at undeclared times, as a discrete output does.
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


def driven_input(
    slave: str,
    variable: Variable,
    signal: HoldRows | SignalFunction,
    *,
    ignores_bounds: bool = False,
) -> DrivenInput:
    """An input, or a tunable parameter, with its signal.

    Raises:
        BoundsError: the model excludes the value of a row, unless ``ignores_bounds``.
        ValueError: a row has no value of the input's type; the message says which.
    """
    if isinstance(signal, SignalFunction):
        # A real one changes all the time, and what it does in between is what a sample leaves out.
        is_searched = not variable.type.is_real
        function = HeldFunction(slave, variable, signal, ignores_bounds)
        return DrivenInput(slave, variable.name, function, is_searched)
    values = []
    for row, given in enumerate(signal.values, 1):
        try:
            values.append(legal_value(variable, given, ignores_bounds=ignores_bounds))
        except ValueError as error:
            raise type(error)(f"row {row}: it {error}") from None
    table = HeldTable(signal.times, tuple(values))
    return DrivenInput(slave, variable.name, table, is_searched=False)


def legal_value(variable: Variable, given: object, *, ignores_bounds: bool = False) -> StartValue:
    """A value out of a table, or of a function, as one of a variable's type.

    Raises:
        BoundsError: the model excludes it, unless ``ignores_bounds``.
        ValueError: it is none, or not finite.
    """
    value = given.item() if isinstance(given, np.generic) else given
    if isinstance(value, str):
        value = parsed(variable, value)
    value = checked_value(variable, value, ignores_bounds=ignores_bounds)
    if isinstance(value, float) and not isfinite(value):
        raise ValueError(f"is of type {variable.type}; it cannot be {value!r}")
    return value
