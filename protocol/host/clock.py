"""Time and waiting, as those get them who wait for others: of the system, or virtual in tests.

Whatever waits, locks or begins something later does it through a `Clock` that it is given. So a
test can let hours of lost and late messages pass in milliseconds, in an order that it chooses and
can repeat (``tests/support/virtual_clock.py``).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Protocol

from protocol.host.threads import start_thread, started


class Lock(Protocol):
    """Part of `threading.Lock` that is used."""

    def __enter__(self) -> bool: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None: ...

    def locked(self) -> bool:
        """True if somebody holds it."""
        ...


class Condition(Protocol):
    """Part of `threading.Condition` that is used."""

    def __enter__(self) -> bool: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None: ...

    def wait(self, timeout: float | None = None) -> bool:
        """Let the lock go until somebody notifies, at most ``timeout`` seconds."""
        ...

    def wait_for(self, predicate: Callable[[], object], timeout: float) -> object:
        """Wait until ``predicate`` holds; gives its last value."""
        ...

    def notify_all(self) -> None:
        """Wake all who wait."""
        ...


class Task(Protocol):
    """Thread: the part of `threading.Thread` that is used."""

    def join(self, timeout: float) -> None:
        """Wait until it has ended, at most ``timeout`` seconds."""
        ...


class Timer(Protocol):
    """Part of `threading.Timer` that is used."""

    def cancel(self) -> None:
        """Nothing happens any more, unless it has happened."""
        ...


class Clock(Protocol):
    """Time, and what waits for it. All methods may be called from any thread."""

    def monotonic(self) -> float:
        """Seconds since some moment; never goes back, whatever happens to the wall clock."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...

    def lock(self) -> Lock:
        """A new lock."""
        ...

    def condition(self) -> Condition:
        """A new condition with a lock of its own."""
        ...

    def start(self, action: Callable[[], None], name: str) -> Task:
        """Run ``action`` beside all else from now on, unless the process has ended."""
        ...

    def later(self, seconds: float, action: Callable[[], None]) -> Timer:
        """Run ``action`` after ``seconds`` beside all else, unless the process has ended."""
        ...


class SystemClock:
    """Implements `Clock` with the system's monotonic clock and threads."""

    def monotonic(self) -> float:
        """See `Clock`."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """See `Clock`."""
        time.sleep(seconds)

    def lock(self) -> Lock:
        """See `Clock`."""
        return threading.Lock()

    def condition(self) -> Condition:
        """See `Clock`."""
        return threading.Condition()

    def start(self, action: Callable[[], None], name: str) -> Task:
        """See `Clock`."""
        return start_thread(action, name)

    def later(self, seconds: float, action: Callable[[], None]) -> Timer:
        """See `Clock`."""
        timer = threading.Timer(seconds, action)
        timer.daemon = True
        return started(timer)


SYSTEM_CLOCK = SystemClock()
"""The one that everybody has unless told otherwise."""
