"""Virtual time: it passes only when everybody waits, and everything happens in one fixed order.

Tasks are greenlets. One runs until it waits for something; then the next event happens, at its
own time. Nothing depends on the machine: the same program takes the same course every time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush
from types import TracebackType
from typing import TypeVar

import greenlet

T = TypeVar("T")


class TimeIsUpError(AssertionError):
    """The program did not end within the virtual time that it may take."""


class DeadlockError(AssertionError):
    """Everybody waits, and nothing will ever happen: somebody waits without a bound."""


class VirtualTimer:
    """Something that will happen unless it is cancelled."""

    is_cancelled = False

    def cancel(self) -> None:
        """See `protocol.host.clock.Timer`."""
        self.is_cancelled = True


class VirtualClock:
    """Implements `protocol.host.clock.Clock`. Only tasks, that is what `run` runs, may wait."""

    def __init__(self) -> None:
        self._now = 0.0
        self._events: list[tuple[float, int, Callable[[], object]]] = []
        self._number = 0
        self._hub = greenlet.getcurrent()
        self._tasks: list[greenlet.greenlet] = []

    def monotonic(self) -> float:
        """Seconds since the beginning."""
        return self._now

    def at(self, time: float, action: Callable[[], object]) -> None:
        """Let ``action``, which must not wait, happen at ``time``."""
        self._number += 1
        heappush(self._events, (max(time, self._now), self._number, action))

    def start(self, action: Callable[[], object], name: str = "") -> VirtualTask:
        """See `Clock`."""
        task = VirtualTask(self)
        made = greenlet.greenlet(lambda: task.run(action), self._hub)
        self._tasks.append(made)
        self.at(self._now, made.switch)
        return task

    def later(self, seconds: float, action: Callable[[], None]) -> VirtualTimer:
        """See `Clock`."""
        timer = VirtualTimer()
        self.at(self._now + seconds, lambda: timer.is_cancelled or self.start(action))
        return timer

    def sleep(self, seconds: float) -> None:
        """Wait."""
        Waiter(self).wait(seconds)

    def lock(self) -> VirtualLock:
        """See `Clock`."""
        return VirtualLock(self)

    def condition(self) -> VirtualCondition:
        """See `Clock`."""
        return VirtualCondition(self)

    def suspend(self) -> None:
        """Let events happen until one goes on with this task."""
        self._hub.switch()

    def run(self, main: Callable[[], T], limit: float) -> T:
        """Run ``main`` as a task, and all others beside it, until it ends.

        Args:
            main: what to run.
            limit: virtual time that it may take [s].

        Raises:
            TimeIsUpError, DeadlockError: it does not end.
            Exception: whatever a task raised.
        """
        self._hub = greenlet.getcurrent()
        end = self._now + limit
        outcome: list[T] = []
        self.start(lambda: outcome.append(main()))
        while not outcome:
            if not self._events:
                raise DeadlockError(f"everybody waits for ever from t = {self._now:.6f} s on")
            time, _, action = heappop(self._events)
            if time > end:
                raise TimeIsUpError(f"it is not over after {limit:g} s")
            self._now = time
            action()
            if len(self._tasks) > 200:
                self._tasks = [task for task in self._tasks if not task.dead]
        return outcome[0]

    def close(self) -> None:
        """End all tasks where they are."""
        self._hub = greenlet.getcurrent()
        for task in self._tasks:
            task.parent = self._hub
            if task:  # started and not ended
                task.throw(greenlet.GreenletExit)
        self._tasks.clear()
        self._events.clear()


class Waiter:
    """One wait of the present task."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._task = greenlet.getcurrent()
        self._is_over = False
        self._is_woken = False

    def wait(self, timeout: float | None = None) -> bool:
        """Until ``wake``, or for ``timeout`` seconds; whether it was woken."""
        if timeout is not None:
            self._clock.at(self._clock.monotonic() + max(timeout, 0.0), self._end)
        self._clock.suspend()
        return self._is_woken

    def wake(self) -> None:
        """Let the task go on."""
        if not self._is_over:
            self._is_woken = self._is_over = True
            self._clock.at(self._clock.monotonic(), self._task.switch)

    def _end(self) -> None:
        if not self._is_over:
            self._is_over = True
            self._task.switch()


class VirtualTask:
    """Task that `VirtualClock.start` started."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._is_over = False
        self._waiters: list[Waiter] = []

    def run(self, action: Callable[[], object]) -> None:
        """Do it, and tell those who wait for that."""
        action()
        self._is_over = True
        for waiter in self._waiters:
            waiter.wake()

    def join(self, timeout: float) -> None:
        """See `Task`."""
        if not self._is_over:
            self._waiters.append(Waiter(self._clock))
            self._waiters[-1].wait(timeout)


class VirtualLock:
    """Given from one task to the next in the order in which they came."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._is_locked = False
        self._waiters: deque[Waiter] = deque()

    def locked(self) -> bool:
        """See `Lock`."""
        return self._is_locked

    def __enter__(self) -> bool:
        if self._is_locked:
            self._waiters.append(Waiter(self._clock))
            self._waiters[-1].wait()
        self._is_locked = True
        return True

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._waiters:
            self._waiters.popleft().wake()  # it stays locked, for that one
        else:
            self._is_locked = False


class VirtualCondition:
    """Tasks do not interrupt each other, so a critical section needs no lock."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._waiters: list[Waiter] = []

    def __enter__(self) -> bool:
        return True

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        pass

    def wait(self, timeout: float | None = None) -> bool:
        """See `Condition`."""
        self._waiters.append(Waiter(self._clock))
        return self._waiters[-1].wait(timeout)

    def wait_for(self, predicate: Callable[[], object], timeout: float | None = None) -> bool:
        """Waits like `threading.Condition.wait_for`."""
        end = None if timeout is None else self._clock.monotonic() + timeout
        while not predicate():
            left = None if end is None else end - self._clock.monotonic()
            if left is not None and left <= 0.0:
                return False
            self.wait(left)
        return True

    def notify_all(self) -> None:
        """See `Condition`."""
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            waiter.wake()
