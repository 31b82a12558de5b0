"""What a run tells its observers of accepted steps: results where they are wanted, counters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from master_node.numerics.dense_output import OutputGrid, OutputHistory
from master_node.observers import Point, Points, Statistics
from protocol.signals import FloatArray

Reached = tuple[tuple[float, FloatArray], ...]
"""Communication points [s] and the outputs there, shape (rows, m) each."""


class ResultPoints:
    """Results at the communication points, or on a grid by dense output.

    Args:
        grid: where results are wanted; None: at the communication points.
        has_derivative: which outputs come with their derivatives, shape (m,).
        time: T_0 [s].
        y: outputs there, shape (rows, m).
    """

    def __init__(
        self, grid: OutputGrid | None, has_derivative: NDArray[np.bool_], time: float, y: FloatArray
    ) -> None:
        self._grid = grid
        self._has_derivative = has_derivative
        self._history = OutputHistory((time,), (y,))
        self._number = 1

    def reached(self, reached: Reached, order: int) -> Points:
        """The results up to the last of some communication points that were ``reached``.

        Args:
            reached: in the order of time.
            order: k of the steps that led there.
        """
        if self._grid is None:
            return _values(reached)
        for time, y in reached:
            self._history = self._history.pushed(time, y)
        times = self._wanted(self._grid, reached[-1][0])
        if not times:
            return ()
        values = self._history.at(np.array(times), order, self._has_derivative)
        return tuple(Point(time, y) for time, y in zip(times, values, strict=True))

    def jumped(self, reached: Reached) -> Points:
        """The same for points that lead over a discontinuity: nothing smooth lies between them."""
        time, y = reached[-1]
        self._history = OutputHistory((time,), (y,))
        if self._grid is None:
            return _values(reached)
        return tuple(
            Point(wanted, next(y[0] for point, y in reached if point >= wanted))
            for wanted in self._wanted(self._grid, time)
        )

    def _wanted(self, grid: OutputGrid, end: float) -> list[float]:
        times = grid.up_to(end, self._number)
        self._number += len(times)
        return times


def _values(reached: Reached) -> Points:
    return tuple(Point(time, y[0]) for time, y in reached)


def count_accepted(statistics: Statistics, step_size: float, reached: Reached) -> None:
    """Note accepted communication steps of ``step_size`` H [s]."""
    statistics.communication_steps += len(reached)
    statistics.time = reached[-1][0]
    if not step_size >= statistics.smallest_step_size:
        statistics.smallest_step_size = step_size
    if not step_size <= statistics.largest_step_size:
        statistics.largest_step_size = step_size
