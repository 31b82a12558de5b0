"""Journal of a run: counters and observers are told of each attempt, results of accepted steps."""

from __future__ import annotations

import logging
from math import nan

from master_node.coupling.result_points import ReachedPoint, ResultPoints, count_accepted
from master_node.methods.base import Back, Candidate, Counts, Shape, Verdict
from master_node.methods.position import Position
from master_node.numerics.extrapolation import highest
from master_node.observing.observers import Attempt, Observer, Statistics
from master_node.running.interrupts import Interrupts

log = logging.getLogger("master_node")


class Journal:
    """Tells of attempts, never of half a one.

    Args:
        results: where they are wanted.
        observer: is told of every attempt.
        statistics: are counted up.
        interrupts: wait while an attempt is told and counted.

    Attributes:
        results, statistics, interrupts: as above.
    """

    def __init__(
        self,
        results: ResultPoints,
        observer: Observer,
        statistics: Statistics,
        interrupts: Interrupts,
    ) -> None:
        self.results = results
        self._observer = observer
        self.statistics = statistics
        self.interrupts = interrupts

    def accepted(self, step: Candidate, verdict: Verdict) -> None:
        """Tell of an accepted step."""
        order, slopes = highest(step.polynomials)
        reached = step.reached
        if verdict.shape is Shape.JUMP:
            points = self.results.jumped(reached)
        else:
            points = self.results.reached(reached, order)
        if verdict.shape is Shape.EVENT_AT_END:
            self.results.cut(reached[-1])
        if verdict.remark and not self.statistics.steps_above_tolerance:
            log.warning("%s", verdict.remark)
        attempt = Attempt(
            step.begin,
            step.step_size,
            order,
            slopes,
            verdict.norm,
            True,
            verdict.limiting_variable,
            points,
            step.iterations,
        )
        with self.interrupts:
            count_accepted(self.statistics, step.step_size, reached)
            self._count(verdict.counts)
            self._observer.attempted(attempt)

    def changed(self, position: Position, text: str) -> None:
        """Tell of a change at a position, by a user or an action: a row without a step."""
        self.results.cut(ReachedPoint(position.time, *position.outputs))
        log.info("t=%r s: %s", position.time, text)
        attempt = Attempt(position.time, 0.0, 0, 0, nan, True, text)
        with self.interrupts:
            self.statistics.discontinuities += 1
            self._observer.attempted(attempt)

    def rejected(self, time: float, back: Back) -> None:
        """Tell of an attempt from T_n = ``time`` [s] that was rejected."""
        order, slopes = highest(back.polynomials)
        attempt = Attempt(time, back.step_size, order, slopes, back.norm, False, back.reason)
        with self.interrupts:
            self.statistics.rejected_double_steps += 1
            self._count(back.counts)
            self._observer.attempted(attempt)

    def _count(self, counts: Counts) -> None:
        for name, number in counts.items():
            setattr(self.statistics, name, getattr(self.statistics, name) + number)
