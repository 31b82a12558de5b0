"""Dense output: the solution between communication points, by polynomials through them.

The solution has order k + 1. Outputs that come with derivatives are read from the Hermite
polynomial through the newest three points, values and derivatives; the others from the polynomial
through the newest k + 2 points. Both have an error of a higher order than the solution, so what is
read between the points is of the same order as what is read at them.

No polynomial leads over what has jumped. An output jumps between two points if it changes by far
more than its tolerance and its slopes at both of them explain; where in between is not known. It
has the later value there, and is read elsewhere through the points on the same side.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ulp

import numpy as np
from numpy.typing import NDArray

from master_node.numerics.extrapolation import divided_differences
from protocol.signals import MAX_ORDER, FloatArray

_HERMITE_POINTS = 3
_DEPTH = MAX_ORDER + 3
"""Points for the polynomial of the highest order, and one to compare it with."""

_STEEP = 10.0
"""Factor by which a jump is above the tolerance, and above what slopes explain."""


@dataclass(frozen=True, slots=True)
class OutputHistory:
    """The outputs at the last communication points. Immutable.

    Attributes:
        times: newest first [s].
        outputs: at each of them, shape (rows, m): values, and derivatives if there are two rows,
            not finite where one is not known.
    """

    times: tuple[float, ...]
    outputs: tuple[FloatArray, ...]

    def pushed(self, time: float, outputs: FloatArray) -> OutputHistory:
        """With a newer point."""
        return OutputHistory(
            (time, *self.times[: _DEPTH - 1]), (outputs, *self.outputs[: _DEPTH - 1])
        )

    def can_compare(self, order: int) -> bool:
        """True if there is a point more than the polynomials of a step of order k need."""
        return len(self.times) > max(_HERMITE_POINTS, order + 2)

    def at(
        self,
        times: FloatArray,
        order: int,
        has_derivative: NDArray[np.bool_],
        scale: FloatArray | None = None,
        more: int = 0,
    ) -> FloatArray:
        """The outputs at ``times``, shape (s, m).

        Args:
            times: between the newest points [s], shape (s,).
            order: k of the step.
            has_derivative: which outputs come with their derivatives, shape (m,); one that lacks
                its derivative at a newest point is read as those without.
            scale: ATOL_j + RTOL_j |y_j|, shape (m,), unit [y]; None: nothing jumps.
            more: points beyond those that are needed. Where the result then is another one, the
                points lie too far apart for what the outputs do between them.
        """
        has_derivative = self._with_slopes(has_derivative, more)
        values = np.empty((len(times), has_derivative.size))
        smooth = np.ones(has_derivative.size, dtype=bool)
        if scale is not None and len(self.times) > 1:
            jumps = self.jumps(has_derivative, scale)
            smooth = np.logical_not(jumps.any(axis=0))
            for j in np.flatnonzero(~smooth):
                values[:, j] = self._beside_jumps(
                    times, order, int(j), jumps[:, j], has_derivative, more
                )
        plain, hermite = smooth & ~has_derivative, smooth & has_derivative
        if plain.any():
            values[:, plain] = self._polynomial(
                times, order, plain, has_derivative=False, more=more
            )
        if hermite.any():
            values[:, hermite] = self._polynomial(
                times, order, hermite, has_derivative=True, more=more
            )
        return values

    def jumps(self, has_derivative: NDArray[np.bool_], scale: FloatArray) -> NDArray[np.bool_]:
        """Between which neighbouring points outputs jump, newest first, shape (points - 1, m).

        A slope is the derivative, or that of the straight line over the interval beside it. An
        output without derivatives has none yet at the newest point: the lines over both intervals
        before count instead, as one alone may lie over an extremum.

        Args:
            has_derivative: which outputs come with their derivatives, shape (m,).
            scale: ATOL_j + RTOL_j |y_j|, shape (m,), unit [y].
        """
        sizes = -np.diff(self.times)[:, np.newaxis]
        values = np.array([y[0] for y in self.outputs])
        changes = np.abs(np.diff(values, axis=0))
        steep = np.full_like(changes, -1.0)  # where no slope is known
        lines = changes / sizes
        steep[:-1] = lines[1:]
        np.maximum(steep[1:], lines[:-1], out=steep[1:])
        steep[0] = np.maximum(lines[1], lines[2]) if len(lines) > 2 else -1.0
        if has_derivative.any():
            slopes = np.abs([y[1, has_derivative] for y in self.outputs])
            steep[:, has_derivative] = np.maximum(slopes[1:], slopes[:-1])
        is_known: NDArray[np.bool_] = steep >= 0.0
        return is_known & (changes > _STEEP * scale) & (changes > _STEEP * sizes * steep)

    def _beside_jumps(  # noqa: PLR0917  those of `at`, and the jumps
        self,
        times: FloatArray,
        order: int,
        output: int,
        jumps: NDArray[np.bool_],
        has_derivative: NDArray[np.bool_],
        more: int,
    ) -> FloatArray:
        """One output at ``times``, read from the points that no jump divides from them, (s,)."""
        values = np.empty(len(times))
        column = np.array([output])
        for i, time in enumerate(times.tolist()):
            older = next(p for p in range(1, len(self.times)) if self.times[p] <= time)
            if jumps[older - 1]:
                at_point = self.times[older] == time
                values[i] = self.outputs[older if at_point else older - 1][0, output]
                continue
            first = older - 1
            while first > 0 and not jumps[first - 1]:
                first -= 1
            last = older
            while last < len(jumps) and not jumps[last]:
                last += 1
            beside = OutputHistory(self.times[first : last + 1], self.outputs[first : last + 1])
            has_slopes = bool(beside._with_slopes(has_derivative, more)[output])
            read = beside._polynomial(
                times[i : i + 1], order, column, has_derivative=has_slopes, more=more
            )
            values[i] = read[0, 0]
        return values

    def _with_slopes(self, has_derivative: NDArray[np.bool_], more: int) -> NDArray[np.bool_]:
        """Outputs with derivatives that have them at all points of a Hermite polynomial, (m,)."""
        if not has_derivative.any():
            return has_derivative
        known = [np.isfinite(y[1]) for y in self.outputs[: _HERMITE_POINTS + more]]
        has_slopes: NDArray[np.bool_] = has_derivative & np.logical_and.reduce(known)
        return has_slopes

    def _polynomial(
        self,
        times: FloatArray,
        order: int,
        columns: NDArray[np.bool_] | NDArray[np.intp],
        *,
        has_derivative: bool,
        more: int,
    ) -> FloatArray:
        """Some outputs at ``times``, shape (s, number), by the polynomial through the points."""
        now = self.times[0]
        offsets = [time - now for time in self.times]
        tau = (times - now)[:, np.newaxis]
        if not has_derivative:
            nodes = offsets[: max(_HERMITE_POINTS, order + 2) + more]
            points = [y[0, columns] for y in self.outputs[: len(nodes)]]
            return _newton(nodes, divided_differences(nodes, points), tau)
        newest = self.outputs[: _HERMITE_POINTS + more]
        nodes = [offset for offset in offsets[: len(newest)] for _ in range(2)]
        points = [y[0, columns] for y in newest for _ in range(2)]
        slopes = [y[1, columns] for y in newest]
        return _newton(nodes, divided_differences(nodes, points, slopes), tau)


def _newton(nodes: list[float], coefficients: list[FloatArray], tau: FloatArray) -> FloatArray:
    """Newton's form at the offsets ``tau``, shape (s, 1): shape (s, n)."""
    values: FloatArray = np.broadcast_to(coefficients[-1], (len(tau), coefficients[-1].size))
    for node, coefficient in zip(nodes[-2::-1], coefficients[-2::-1], strict=True):
        values = coefficient + (tau - node) * values
    return values


@dataclass(frozen=True, slots=True)
class OutputGrid:
    """start + i interval, i = 0, 1, 2, ...: the times at which results are wanted.

    Attributes:
        start, interval: [s].
        stop: a time that is the stop time but for the rounding of its product is the stop time.
    """

    start: float
    interval: float
    stop: float

    def up_to(self, end: float, number: int) -> list[float]:
        """The times from the one with this number up to ``end`` [s]."""
        times: list[float] = []
        while (time := self._time(number + len(times))) <= end:
            times.append(time)
        return times

    def _time(self, number: int) -> float:
        time = self.start + number * self.interval
        rounding = 4.0 * ulp(max(abs(self.start), abs(self.stop)))
        return self.stop if abs(time - self.stop) <= rounding else time
