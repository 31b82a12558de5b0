"""Points that a run tells its observers: results where they are wanted, and counters."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.discrete import DiscreteValues
from master_node.coupling.outputs import Outputs
from master_node.numerics.dense_output import OutputGrid, OutputHistory
from master_node.numerics.norms import error_scale
from master_node.observing.observers import Point, Points, Statistics
from protocol.signals import FloatArray


class ReachedPoint(NamedTuple):
    """A communication point that was reached.

    Attributes:
        time: [s].
        y: outputs there, shape (rows, m).
        d: discrete outputs there, then recorded variables.
    """

    time: float
    y: FloatArray
    d: DiscreteValues = ()


log = logging.getLogger("master_node")

_COARSE = 100.0
"""Tolerances: two polynomials that differ by more do not tell what lies between their points."""

Reached = tuple[ReachedPoint, ...]
"""In the order of time."""


class ResultMemory(NamedTuple):
    """Memory from one accepted step to the next.

    Attributes:
        history: outputs at the last communication points.
        d: discrete outputs at the last one.
        number: of the next point of the grid.
    """

    history: OutputHistory
    d: DiscreteValues
    number: int


class ResultPoints:
    """Results at the communication points, or on a grid by dense output.

    Args:
        grid: where results are wanted; None: at the communication points.
        coupled: the system, for names and tolerances, and for what results hold beside outputs.
        has_derivative: which outputs come with their derivatives, shape (m,).
        time: T_0 [s].
        outputs: there.
    """

    def __init__(
        self,
        grid: OutputGrid | None,
        coupled: CoupledSystem,
        has_derivative: NDArray[np.bool_],
        time: float,
        outputs: Outputs,
    ) -> None:
        self._grid = grid
        self._recorded = recorded = coupled.recorded
        self._names = (*coupled.output_names, *(one.name for one in recorded.continuous))
        self._absolute_tolerance, self._relative_tolerance = (
            np.concatenate([own, np.array(more)])
            for own, more in zip(
                (coupled.absolute_tolerance, coupled.relative_tolerance),
                recorded.tolerances,
                strict=True,
            )
        )
        self._has_warned = False
        more = np.zeros(len(recorded.continuous), np.bool_)
        self._has_derivative = np.concatenate([has_derivative, more])
        y, self._d = recorded.split(outputs.y, outputs.d)
        self._history = OutputHistory((time,), (y,))
        self._number = 1

    @property
    def memory(self) -> ResultMemory:
        """Memory; set it to go on from there."""
        return ResultMemory(self._history, self._d, self._number)

    @memory.setter
    def memory(self, memory: ResultMemory) -> None:
        self._history, self._d, self._number = memory

    def reached(self, reached: Reached, order: int) -> Points:
        """The results up to the last of some communication points that were ``reached``.

        Args:
            reached: in the order of time.
            order: k of the steps that led there.
        """
        reached = self._split(reached)
        if self._grid is None:
            return _values(reached)
        for point in reached:
            self._history = self._history.pushed(point.time, point.y)
        times = self._wanted(self._grid, reached[-1].time)
        held = self._held(times, reached)
        if not times:
            return ()
        scale = error_scale(reached[-1].y[0], self._absolute_tolerance, self._relative_tolerance)
        history, at = self._history, np.array(times)
        values = history.at(at, order, self._has_derivative, scale)
        if not self._has_warned and history.can_compare(order):
            others = history.at(at, order, self._has_derivative, scale, more=1)
            self._compare(times, values, others)
        return tuple(map(Point, times, values, held))

    def jumped(self, reached: Reached) -> Points:
        """Points that lead over a discontinuity: nothing smooth lies between them."""
        reached = self._split(reached)
        time, y, _ = reached[-1]
        self._history = OutputHistory((time,), (y,))
        if self._grid is None:
            return _values(reached)
        times = self._wanted(self._grid, time)
        behind = [next(point.y[0] for point in reached if point.time >= t) for t in times]
        return tuple(map(Point, times, behind, self._held(times, reached)))

    def cut(self, point: ReachedPoint) -> None:
        """Forget what was before: nothing smooth leads over ``point``."""
        y, _ = self._recorded.split(point.y, point.d)
        self._history = OutputHistory((point.time,), (y,))

    def _split(self, reached: Reached) -> Reached:
        """With what is recorded among the outputs and the discrete ones."""
        if self._recorded.is_empty:
            return reached
        return tuple(ReachedPoint(p.time, *self._recorded.split(p.y, p.d)) for p in reached)

    def _compare(self, times: Sequence[float], values: FloatArray, others: FloatArray) -> None:
        """Warn, once, where communication points lie too far apart to read between them."""
        scale = self._absolute_tolerance + self._relative_tolerance * np.abs(values)
        deviation = np.abs(values - others) / scale
        if not (deviation > _COARSE).any():  # what is not finite is told by itself
            return
        row, column = divmod(int(np.nanargmax(deviation)), deviation.shape[1])
        log.warning(
            "results between communication points are not as accurate as those at them: two "
            "polynomials differ at t=%r s by %.2g times the tolerance of %s; give "
            "[simulation] largest_step_size, or leave out output_interval",
            times[row],
            deviation[row, column],
            self._names[column],
        )
        self._has_warned = True

    def _held(self, times: Sequence[float], reached: Reached) -> list[DiscreteValues]:
        """Discrete outputs at ``times``: what they were at the communication point before."""
        held = []
        for time in times:
            passed = [point.d for point in reached if point.time <= time]
            held.append(passed[-1] if passed else self._d)
        self._d = reached[-1].d
        return held

    def _wanted(self, grid: OutputGrid, end: float) -> list[float]:
        times = grid.up_to(end, self._number)
        self._number += len(times)
        return times


def _values(reached: Reached) -> Points:
    return tuple([Point(time, y[0], d) for time, y, d in reached])


def count_accepted(statistics: Statistics, step_size: float, reached: Reached) -> None:
    """Note accepted communication steps of ``step_size`` H [s]."""
    statistics.communication_steps += len(reached)
    statistics.time = reached[-1].time
    if not step_size >= statistics.smallest_step_size:
        statistics.smallest_step_size = step_size
    if not step_size <= statistics.largest_step_size:
        statistics.largest_step_size = step_size
