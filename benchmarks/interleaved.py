"""An observer that times attempted double steps and, in turn with them, a baseline."""

from collections.abc import Callable
from time import perf_counter

import numpy as np

from master_node.observing.observers import Attempt, RunEnd, RunStart

BLOCK = 1


class Interleaved:
    """Times blocks of attempts and blocks of ``baseline`` calls, one after the other.

    Args:
        baseline: one call of what to compare with.
        warm_up: attempts that do not count.
    """

    def __init__(self, baseline: Callable[[], object], warm_up: int = 200) -> None:
        self._baseline = baseline
        self._left = warm_up
        self._warm_up = warm_up
        self._attempts: list[float] = []
        self._baselines: list[float] = []
        self._last = 0.0

    def started(self, _: RunStart) -> None:
        """The first attempt begins."""
        self._last = perf_counter()

    def attempted(self, _: Attempt) -> None:
        """One attempt is over; now and then the baseline's turn comes."""
        self._attempts.append(perf_counter() - self._last)
        self._left -= 1
        if self._left == 0:
            self._left = BLOCK
            for _ in range(BLOCK):
                begin = perf_counter()
                self._baseline()
                self._baselines.append(perf_counter() - begin)
        self._last = perf_counter()

    def ended(self, _: RunEnd) -> None:
        """Nothing to close."""

    def medians(self) -> tuple[float, float]:
        """Median attempt and median baseline [us]."""
        attempts = np.array(self._attempts[self._warm_up :])
        return float(np.median(attempts)) * 1e6, float(np.median(self._baselines[BLOCK:])) * 1e6
