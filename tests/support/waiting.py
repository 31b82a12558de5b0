"""Waits of tests: they end with what they wait for, and have room on a machine that is busy."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable

BOUND = 240.0
"""No wait in a test is longer [s]; it is for what hangs, not for what is slow."""

_START_TIME = 0.1
"""Least time of a start of Python with NumPy on any machine that is not busy [s]."""


def wait_until(condition: Callable[[], object], say: Callable[[], str] = str) -> None:
    """Wait for what no event tells of: the state of a file, a thread or another process.

    Raises:
        AssertionError: it has not come true within the bound; ``say`` tells more about it.
    """
    end = time.monotonic() + BOUND
    while not condition():
        assert time.monotonic() < end, say()
        time.sleep(0.005)


def is_quick(taken: float, limit: float) -> bool:
    """True where something took at most ``limit`` seconds, or as many times longer as the machine
    is slower now than when it has nothing else to do.
    """
    return taken <= limit or taken <= limit * slowdown()


def slowdown() -> float:
    """The time that processes take to start now, as a multiple of what they take at best."""
    taken = []
    for _ in range(5):
        begin = time.monotonic()
        subprocess.run([sys.executable, "-c", "import numpy"], check=True, timeout=BOUND)
        taken.append(time.monotonic() - begin)
    return max(taken) / _START_TIME
