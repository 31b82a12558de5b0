"""Time and waiting, as those get them who wait for others: of the system, or virtual in tests.

Whatever waits, locks or begins something later does it through a `Clock` that it is given. So a
test can let hours of lost and late messages pass in milliseconds, in an order that it chooses and
can repeat (``tests/virtual_clock.py``).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Protocol


class Lock(Protocol):
    """What is used of `threading.Lock`."""

    def __enter__(self) -> bool: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None: ...

    def locked(self) -> bool:
        """Whether somebody holds it."""
        ...


class Condition(Protocol):
    """What is used of `threading.Condition`."""

    def __enter__(self) -> bool: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None: ...

    def wait(self, timeout: float) -> bool:
        """Let the lock go until somebody notifies, at most ``timeout`` seconds."""
        ...

    def notify_all(self) -> None:
        """Wake all who wait."""
        ...


class Clock(Protocol):
    """Time, and what waits for it. All methods may be called from any thread."""

    def monotonic(self) -> float:
        """Seconds since some moment; never goes back, whatever happens to the wall clock."""
        ...

    def lock(self) -> Lock:
        """A new lock."""
        ...

    def condition(self) -> Condition:
        """A new condition with a lock of its own."""
        ...

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Run ``action`` after ``seconds`` beside all else, unless the process has ended."""
        ...


class SystemClock:
    """Implements `Clock` with the system's monotonic clock and threads."""

    def monotonic(self) -> float:
        """See `Clock`."""
        return time.monotonic()

    def lock(self) -> Lock:
        """See `Clock`."""
        return threading.Lock()

    def condition(self) -> Condition:
        """See `Clock`."""
        return threading.Condition()

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """See `Clock`."""
        timer = threading.Timer(seconds, action)
        timer.daemon = True
        timer.start()


SYSTEM_CLOCK = SystemClock()
"""The one that everybody has unless told otherwise."""
