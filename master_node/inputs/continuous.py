"""Inputs that are driven from outside the system: constants, tables and functions of time.

What they are is known before a step, so nothing is extrapolated: a slave gets, beside the
polynomials of its connected inputs, one polynomial of each signal over the very step
(``numerics/step_polynomials.py``). They are computed here and sent as derivatives, so a run has the
same bits wherever its slaves are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite, ulp
from typing import Any, NamedTuple

import numpy as np

from master_node.numerics.input_tables import Table, group_tables
from master_node.numerics.step_polynomials import Quadrature, step_polynomial
from protocol.errors import SlaveError, StepRejectedError
from protocol.signals import MAX_ORDER, FloatArray, InputSignal
from protocol.values import beyond_bounds
from protocol.variables import Variable

_INSIDE = 8.0


@dataclass(frozen=True, eq=False)
class SignalFunction:
    """u(t) as a function.

    Attributes:
        function: of the time [s]; must depend on nothing else.
        breakpoints: where it jumps or has a kink [s], increasing.
        order: highest degree of its polynomials.
    """

    function: Callable[[float], Any]
    breakpoints: tuple[float, ...] = ()
    order: int = MAX_ORDER


Signal = float | Table | SignalFunction
"""Signal that can drive a continuous input of type Real."""


class ExternalInput(NamedTuple):
    """One input that is driven from outside.

    Attributes:
        slave, variable: its names.
        signal: that drives it.
        max_order: highest degree of polynomial that its slave takes.
        absolute_tolerance, relative_tolerance: a jump within them is none.
        bounded: the input whose bounds a function must keep; None: it need not.
    """

    slave: str
    variable: str
    signal: Signal
    max_order: int
    absolute_tolerance: float
    relative_tolerance: float
    bounded: Variable | None = None

    @property
    def name(self) -> str:
        """``slave.variable``."""
        return f"{self.slave}.{self.variable}"

    @property
    def degree(self) -> int:
        """Degree of its polynomials."""
        if isinstance(self.signal, Table):
            return self.max_order
        if isinstance(self.signal, SignalFunction):
            return min(self.max_order, self.signal.order)
        return 0

    @property
    def is_constant(self) -> bool:
        """True if it never changes."""
        return not isinstance(self.signal, Table | SignalFunction)


class ExternalSignal(NamedTuple):
    """The polynomials of all external inputs in one step.

    Attributes:
        rows: derivatives of order 0 to 3 at its beginning, shape (4, n_e).
        end: values at its end, before a jump there, shape (n_e,).
    """

    rows: FloatArray
    end: FloatArray

    def shifted(self, offset: float) -> ExternalSignal:
        """Polynomials around a point ``offset`` [s] later."""
        if not self.end.size:
            return self
        return ExternalSignal(InputSignal(self.rows).shifted(offset).derivatives, self.end)


class Jump(NamedTuple):
    """An input that jumps.

    Attributes:
        time: when [s].
        name: ``slave.variable``.
        is_held: whether the input keeps its old value in a step over the jump.
    """

    time: float
    name: str
    is_held: bool = False


class ExternalInputs:
    """All external inputs of a system, n_e of them.

    Args:
        inputs: in the order of their columns.

    Attributes:
        names: ``slave.variable`` of each.
        changes: whether each is more than a constant.
        degrees: of the polynomials of each.
        jumps: those larger than the tolerance, and all breakpoints of functions, in order of time.
        kinks: where slopes change at once, and smaller jumps [s].
    """

    def __init__(self, inputs: Sequence[ExternalInput] = ()) -> None:
        self.names = tuple(one.name for one in inputs)
        self.changes = tuple(not one.is_constant for one in inputs)
        self.degrees = tuple(one.degree for one in inputs)
        jumps, kinks = _breakpoints(inputs)
        self.jumps: tuple[Jump, ...] = tuple(sorted(jumps))
        self.kinks: tuple[float, ...] = tuple(sorted(kinks))
        self._constants = np.zeros(len(inputs))
        table_columns, tables = [], []
        functions: list[tuple[int, ExternalInput, SignalFunction]] = []
        for column, one in enumerate(inputs):
            if isinstance(one.signal, Table):
                table_columns.append(column)
                tables.append(one.signal)
            elif isinstance(one.signal, SignalFunction):
                functions.append((column, one, one.signal))
            else:
                self._constants[column] = one.signal
        degrees = [self.degrees[column] for column in table_columns]
        self._tables = [
            (np.array(table_columns, dtype=np.intp)[numbers], group)
            for numbers, group in group_tables(tables, degrees)
        ]
        self._function_columns = np.array([column for column, _, _ in functions], dtype=np.intp)
        self._functions = [
            (one, signal, np.array(signal.breakpoints)) for _, one, signal in functions
        ]
        self._function_degrees = np.array(
            [self.degrees[column] for column, _, _ in functions], dtype=np.intp
        )
        self._nothing = ExternalSignal(np.zeros((MAX_ORDER + 1, 0)), np.zeros(0))

    def at(self, time: float) -> FloatArray:
        """Values at ``time`` [s], behind a jump there, shape (n_e,).

        Raises:
            StepRejectedError: one is not finite.
            SlaveError: a function failed.
        """
        values = self._constants.copy()
        for columns, group in self._tables:
            values[columns] = group.at(time)
        for column, (one, signal, points) in zip(
            self._function_columns, self._functions, strict=True
        ):
            inside = _INSIDE * ulp(abs(time))
            values[column] = _value(one, signal, beside_breakpoint(points, time, inside))
        return values

    def over(self, begin: float, end: float) -> ExternalSignal:
        """The polynomials for a step from ``begin`` to ``end`` [s].

        Raises:
            StepRejectedError: a value is not finite; another step size may help.
            SlaveError: a function failed.
        """
        if not self.names:
            return self._nothing
        rows = np.zeros((MAX_ORDER + 1, len(self.names)))
        rows[0] = self._constants
        at_end = self._constants.copy()
        for columns, group in self._tables:
            rows[:, columns], at_end[columns] = group.over(begin, end)
        if self._functions:
            try:
                values = np.array([_sampled(*item, begin, end) for item in self._functions])
            except SlaveError as error:
                error.located(time=begin, step_size=end - begin)
                raise
            first, last, mean, moment = values.T
            rows[:, self._function_columns] = step_polynomial(
                first, last, (mean, moment), end - begin, self._function_degrees
            )
            at_end[self._function_columns] = last
        return ExternalSignal(rows, at_end)


def _breakpoints(inputs: Sequence[ExternalInput]) -> tuple[set[Jump], set[float]]:
    jumps, kinks = set(), set()
    for one in inputs:
        if isinstance(one.signal, SignalFunction):
            jumps |= {Jump(time, one.name) for time in one.signal.breakpoints}
        elif isinstance(one.signal, Table):
            kinks |= set(one.signal.kinks.tolist())
            for time, before, behind in one.signal.jumps.tolist():
                size = max(abs(before), abs(behind))
                tolerance = one.absolute_tolerance + one.relative_tolerance * size
                if abs(behind - before) > tolerance:
                    jumps.add(Jump(time, one.name))
                else:
                    kinks.add(time)
    return jumps, kinks


def _sampled(
    one: ExternalInput, signal: SignalFunction, points: FloatArray, begin: float, end: float
) -> tuple[float, float, float, float]:
    """Values at both ends of a step from inside, mean and first moment less the first value."""
    inside = _INSIDE * ulp(max(abs(begin), abs(end)))
    inner = points[points.searchsorted(begin + inside) : points.searchsorted(end - inside)]
    first = _value(one, signal, beside_breakpoint(points, begin, inside))
    last = _value(one, signal, beside_breakpoint(points, end, -inside))
    quadrature = Quadrature.over(begin, inner, end)
    values = np.array([_value(one, signal, t) for t in quadrature.times.ravel().tolist()]) - first
    mean = float(quadrature.mean.ravel() @ values)
    return first, last, mean, float(quadrature.moment.ravel() @ values)


def beside_breakpoint(points: FloatArray, time: float, inside: float) -> float:
    """``time`` [s], or where it is on a breakpoint a point on the side of ``inside`` [s]."""
    near = points.searchsorted(time - abs(inside))
    is_on = near < len(points) and points[near] <= time + abs(inside)
    return float(points[near]) + inside if is_on else time


def _value(one: ExternalInput, signal: SignalFunction, time: float) -> float:
    """u(t).

    Raises:
        StepRejectedError: it is not finite, or the function has no value there.
        SlaveError: the function failed otherwise, or left the bounds of the input.
    """
    try:
        value = float(signal.function(time))
    except (ArithmeticError, ValueError) as error:
        raise StepRejectedError(
            f"the function of {one.name} has no value at t={time!r} s: {_text(error)}",
            slave=one.slave,
            phase="external input",
        ) from error
    except Exception as error:
        raise SlaveError(
            f"the function of {one.name} failed at t={time!r} s: {_text(error)}",
            slave=one.slave,
            phase="external input",
        ) from error
    if not isfinite(value):
        raise StepRejectedError(
            f"{one.name} is {value!r} at t={time!r} s", slave=one.slave, phase="external input"
        )
    problem = "" if one.bounded is None else beyond_bounds(one.bounded, value)
    if problem:
        raise SlaveError(
            f"{one.name} {problem}",
            slave=one.slave,
            phase="external input",
            time=time,
            remedy="correct the function, or say ignore_bounds = true in the table of the slave",
        )
    return value


def _text(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
