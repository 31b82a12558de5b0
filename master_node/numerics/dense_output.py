"""Dense output: the solution between communication points, by polynomials through them.

The solution has order k + 1. Outputs that come with derivatives are read from the Hermite
polynomial through the newest three points, values and derivatives; the others from the polynomial
through the newest k + 2 points. Both have an error of a higher order than the solution, so what is
read between the points is of the same order as what is read at them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ulp

import numpy as np
from numpy.typing import NDArray

from master_node.numerics.extrapolation import divided_differences
from protocol.signals import MAX_ORDER, FloatArray

_DEPTH = MAX_ORDER + 2
_HERMITE_POINTS = 3


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

    def at(self, times: FloatArray, order: int, has_derivative: NDArray[np.bool_]) -> FloatArray:
        """The outputs at ``times``, shape (s, m).

        Args:
            times: between the newest points [s], shape (s,).
            order: k of the step.
            has_derivative: which outputs come with their derivatives, shape (m,); one that lacks
                its derivative at a newest point is read as those without.
        """
        now = self.times[0]
        offsets = [time - now for time in self.times]
        tau = (times - now)[:, np.newaxis]
        values = np.empty((len(times), has_derivative.size))
        if has_derivative.any():
            slopes_known = [np.isfinite(y[1]) for y in self.outputs[:_HERMITE_POINTS]]
            has_derivative = has_derivative & np.logical_and.reduce(slopes_known)
        plain = ~has_derivative
        if plain.any():
            nodes = offsets[: max(_HERMITE_POINTS, order + 2)]
            points = [y[0, plain] for y in self.outputs[: len(nodes)]]
            values[:, plain] = _newton(nodes, divided_differences(nodes, points), tau)
        if has_derivative.any():
            newest = self.outputs[:_HERMITE_POINTS]
            nodes = [offset for offset in offsets[: len(newest)] for _ in range(2)]
            points = [y[0, has_derivative] for y in newest for _ in range(2)]
            slopes = [y[1, has_derivative] for y in newest]
            differences = divided_differences(nodes, points, slopes)
            values[:, has_derivative] = _newton(nodes, differences, tau)
        return values


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
