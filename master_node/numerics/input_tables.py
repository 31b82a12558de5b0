"""Tables over time: piecewise polynomials of degree up to 3, and where they are not smooth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ulp

import numpy as np
from numpy.typing import NDArray

from master_node.numerics.step_polynomials import Quadrature, step_polynomial
from protocol.signals import MAX_ORDER, FloatArray, InputSignal

INTERPOLATIONS = ("linear", "hold", "spline")

_ROUNDING = 1e-9
"""Relative to a table's largest values: a smaller jump or change of slope is one of rounding, and a
table that ends this part of its length too early covers the simulated time."""

_INSIDE = 8.0


class InputTableError(Exception):
    """The rows are no table; the message says which."""


@dataclass(frozen=True, eq=False)
class Table:
    """A signal in p pieces; the first and the last go on beyond their ends.

    Attributes:
        begins: where the pieces begin, increasing, shape (p,) [s].
        derivatives: of order 0 to 3 there, shape (p, 4).
        jumps: time [s], value before and value behind, shape (q, 3).
        kinks: where the slope changes at once, shape (r,) [s].
        extremes: smallest and largest value.
        unit: of the values, as their file says; "" where it says none.
    """

    begins: FloatArray
    derivatives: FloatArray
    jumps: FloatArray
    kinks: FloatArray
    extremes: tuple[float, float]
    unit: str = ""

    def transformed(self, factor: float, offset: float) -> Table:
        """The table of ``factor`` * u(t) + ``offset``."""
        sides = self.jumps * np.array([1.0, factor, factor])
        sides[:, 1:] += offset
        derivatives = self.derivatives * factor
        derivatives[:, 0] += offset
        smallest, largest = sorted(factor * value + offset for value in self.extremes)
        return Table(self.begins, derivatives, sides, self.kinks, (smallest, largest))


def make_table(
    times: FloatArray,
    values: FloatArray,
    interpolation: str,
    span: tuple[float, float],
    *,
    extrapolates: bool,
    unit: str = "",
) -> Table:
    """A table of n rows.

    ``linear``: straight lines; two rows of the same time are a jump, at the first and the last time
    too. ``hold``: each value holds up to the next row, the last one for good. ``spline``: a cubic
    spline, twice differentiable (not-a-knot).

    Args:
        times: shape (n,) [s].
        values: shape (n,).
        interpolation: one of `INTERPOLATIONS`.
        span: the simulated time [s].
        extrapolates: hold the first and the last value where the rows do not cover the span.
        unit: of the values.

    Raises:
        InputTableError: the times do not increase, a number is not finite, there are too few
            rows, or they do not cover the span.
    """
    _check_rows(times, values, interpolation)
    slack = _ROUNDING * (times[-1] - times[0])
    is_early = times[0] > span[0] + slack
    is_late = times[-1] < span[1] - slack and interpolation != "hold"
    if (is_early or is_late) and not extrapolates:
        raise InputTableError(
            f"its rows from {float(times[0])!r} s to {float(times[-1])!r} s do not cover the "
            f'simulated time from {span[0]!r} s to {span[1]!r} s; extrapolate = "hold" would '
            "hold the first and the last value"
        )
    begins, derivatives = _pieces(times, values, interpolation)
    extremes = _extremes(times, values, derivatives)
    if is_early:
        begins = np.concatenate([[min(span[0], times[0] - 1.0)], begins])
        derivatives = np.concatenate([[[values[0], 0.0, 0.0, 0.0]], derivatives])
    if is_late or (interpolation == "linear" and times[-1] == times[-2]):
        begins = np.concatenate([begins, times[-1:]])
        derivatives = np.concatenate([derivatives, [[values[-1], 0.0, 0.0, 0.0]]])
    return Table(begins, derivatives, *_breakpoints(begins, derivatives), extremes, unit)


def _check_rows(times: FloatArray, values: FloatArray, interpolation: str) -> None:
    if len(times) < (1 if interpolation == "hold" else 2):
        raise InputTableError(f"{len(times)} rows are too few")
    for name, numbers in (("time", times), ("value", values)):
        finite = np.isfinite(numbers)
        if not finite.all():
            row = int(np.argmin(finite))
            raise InputTableError(f"row {row + 1}: the {name} is {float(numbers[row])!r}")
    steps = np.diff(times)
    wrong = steps <= 0.0
    if interpolation == "linear":  # two rows of the same time are a jump, three are nonsense
        repeated = steps == 0.0
        is_third = np.zeros_like(repeated)
        is_third[1:] = repeated[1:] & repeated[:-1]
        wrong = (steps < 0.0) | is_third
        if repeated.all():
            raise InputTableError("all its rows have the same time")
    if wrong.any():
        row = int(np.argmax(wrong)) + 1
        raise InputTableError(
            f"row {row + 1}: the time {float(times[row])!r} s is not above that of the row before, "
            f"{float(times[row - 1])!r} s"
        )


def _pieces(
    times: FloatArray, values: FloatArray, interpolation: str
) -> tuple[FloatArray, FloatArray]:
    if interpolation == "hold":
        derivatives = np.zeros((len(times), MAX_ORDER + 1))
        derivatives[:, 0] = values
        return times, derivatives
    if interpolation == "linear":
        is_piece = np.diff(times) > 0.0
        derivatives = np.zeros((int(is_piece.sum()), MAX_ORDER + 1))
        derivatives[:, 0] = values[:-1][is_piece]
        derivatives[:, 1] = np.diff(values)[is_piece] / np.diff(times)[is_piece]
        return times[:-1][is_piece], derivatives
    # SciPy takes a tenth of a second to import, which a run without splines need not pay
    from scipy.interpolate import CubicSpline  # noqa: PLC0415

    powers = CubicSpline(times, values).c[::-1].T
    return times[:-1], powers * np.array([1.0, 1.0, 2.0, 6.0])


def _extremes(
    times: FloatArray, values: FloatArray, derivatives: FloatArray
) -> tuple[float, float]:
    """Smallest and largest value, at the rows and where the slope of a spline is 0 between them."""
    found = values
    _, slope, bend, third = derivatives.T
    if bend.any() or third.any():
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(bend * bend - 2.0 * third * slope)
            far = -(bend + np.copysign(root, bend))  # of the two roots, without cancellation
            offsets = np.concatenate([far / third, 2.0 * slope / far])
        inside = (offsets > 0.0) & (offsets < np.tile(np.diff(times), 2))
        pieces = np.tile(derivatives, (2, 1))[inside]
        found = np.concatenate([values, _taylor(pieces, offsets[inside])])
    return float(found.min()), float(found.max())


def _breakpoints(begins: FloatArray, derivatives: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Jumps and kinks where one piece ends and the next begins."""
    lengths = np.diff(begins)
    before = _taylor(derivatives[:-1], lengths)
    behind = derivatives[1:]
    slopes_before = _taylor(derivatives[:-1, 1:], lengths)
    scale, slope_scale = _ROUNDING * np.abs(derivatives[:, :2]).max(axis=0)
    jumps = np.abs(behind[:, 0] - before) > scale
    kinks = (np.abs(behind[:, 1] - slopes_before) > slope_scale) & ~jumps
    sides = np.column_stack([begins[1:], before, behind[:, 0]])
    return sides[jumps], begins[1:][kinks]


def _taylor(derivatives: FloatArray, offsets: FloatArray) -> FloatArray:
    """Values at ``offsets``, shape (p,), from derivatives, shape (p, rows)."""
    value = derivatives[:, -1]
    for j in range(derivatives.shape[1] - 1, 0, -1):
        value = derivatives[:, j - 1] + value * (offsets / j)
    return value


class TableGroup:
    """Tables of n signals whose pieces begin at the same times: one look-up for all.

    Args:
        tables: with the same ``begins``.
        degree: of the polynomials in a step: 3 reproduces each piece, 0 takes means.
    """

    def __init__(self, tables: Sequence[Table], degree: int) -> None:
        self._begins = tables[0].begins
        self._derivatives = np.stack([table.derivatives for table in tables], axis=2)
        self._degree = degree

    def at(self, time: float) -> FloatArray:
        """Values at ``time`` [s], behind a jump there, shape (n,)."""
        piece = self._piece(time, "right")
        value: FloatArray = self._signal(piece).at(time - self._begins[piece])
        return value

    def over(self, begin: float, end: float) -> tuple[FloatArray, FloatArray]:
        """For a step from ``begin`` to ``end`` [s].

        What is within rounding of an end of the step counts as being there: a jump at ``begin``
        has happened, one at ``end`` has not.

        Returns:
            Derivatives of order 0 to 3 at ``begin`` of the polynomials, shape (4, n), and the
            values at ``end``, shape (n,).
        """
        inside = _INSIDE * ulp(max(abs(begin), abs(end)))
        first = self._piece(begin + inside, "right")
        last = max(first, self._piece(end - inside, "left"))
        signal = self._signal(first).shifted(begin - self._begins[first])
        at_end: FloatArray = self._signal(last).at(end - self._begins[last])
        if first == last and self._degree == MAX_ORDER:
            return signal.derivatives, at_end
        deviations = self._deviations(begin, end, first, last, signal.derivatives[0])
        rows = step_polynomial(signal.derivatives[0], at_end, deviations, end - begin, self._degree)
        return rows, at_end

    def _piece(self, time: float, side: str) -> int:
        piece = int(self._begins.searchsorted(time, side)) - 1  # type: ignore[call-overload]
        return max(0, piece)

    def _signal(self, piece: int) -> InputSignal:
        return InputSignal(self._derivatives[piece])

    def _deviations(
        self, begin: float, end: float, first: int, last: int, origin: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and first moment of the signals less ``origin``, over several pieces."""
        inner = self._begins[first + 1 : last + 1]
        quadrature = Quadrature.over(begin, inner, end)
        offsets = (quadrature.times - self._begins[first : last + 1, np.newaxis])[..., np.newaxis]
        pieces = self._derivatives[first : last + 1, np.newaxis]
        values = pieces[:, :, MAX_ORDER]
        for j in range(MAX_ORDER, 0, -1):
            values = pieces[:, :, j - 1] + values * (offsets / j)
        values = values - origin
        return (
            np.einsum("qg,qgn->n", quadrature.mean, values),
            np.einsum("qg,qgn->n", quadrature.moment, values),
        )


def group_tables(
    tables: Sequence[Table], degrees: Sequence[int]
) -> list[tuple[NDArray[np.intp], TableGroup]]:
    """Groups of tables that can be looked up together, each with their numbers."""
    alike: dict[tuple[bytes, int], list[int]] = {}
    for number, (table, degree) in enumerate(zip(tables, degrees, strict=True)):
        alike.setdefault((table.begins.tobytes(), degree), []).append(number)
    return [
        (np.array(numbers, dtype=np.intp), TableGroup([tables[i] for i in numbers], degree))
        for (_, degree), numbers in alike.items()
    ]
