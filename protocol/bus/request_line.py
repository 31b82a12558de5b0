"""The requests to one key, in the order in which they came, bounded in bytes while they wait.

Zenoh bounds the requests that wait by their number, however large they are. The thread that
serves a key takes them one by one, at no cost beyond that. While it is busy with one for long, a
second thread takes those that come and drops what there is no room for (`Line.attend`).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Generic, Protocol, TypeVar

from protocol.bus.room import Room

_Q = TypeVar("_Q")
_T_co = TypeVar("_T_co", covariant=True)


class Source(Protocol[_T_co]):
    """Where requests come from."""

    def recv(self) -> _T_co:
        """Wait for the next one."""
        ...

    def try_recv(self) -> _T_co | None:
        """The next one, if there is one."""
        ...


class Line(Generic[_Q]):
    """Requests to one key.

    Args:
        source: of them.
        room: for those that wait and the one that is being served.
        size: of a request [bytes].
        drop: refuses one.
    """

    def __init__(
        self,
        source: Source[_Q],
        room: Room,
        size: Callable[[_Q], int],
        drop: Callable[[_Q], None],
    ) -> None:
        self._source = source
        self._room = room
        self._size = size
        self._drop = drop
        self._lock = threading.Lock()
        self._waiting: deque[tuple[_Q, int]] = deque()
        self._served: int | None = None
        self._since: float | None = None

    def next(self) -> _Q:
        """Be done with the last request and wait for the next. For the thread that serves."""
        if self._served is not None:
            self._room.give(self._served)
            self._served = None
        with self._lock:
            self._since = None
            waiting = self._waiting.popleft() if self._waiting else None
        request, self._served = self._received() if waiting is None else waiting
        self._since = monotonic()
        return request

    def _received(self) -> tuple[_Q, int]:
        while True:
            request = self._source.recv()
            size = self._size(request)
            if self._room.take(size):
                return request, size
            self._drop(request)

    def attend(self, patience: float) -> bool:
        """Take in what came, if one is being served for longer than ``patience`` [s].

        Returns:
            True when one is.
        """
        since = self._since
        if since is None or monotonic() - since < patience:
            return False
        while True:
            with self._lock:  # who serves may be done: then it is for him to take them
                request = None if self._since is None else self._source.try_recv()
                if request is None:
                    return self._since is not None
                size = self._size(request)
                is_taken = self._room.take(size)
                if is_taken:
                    self._waiting.append((request, size))
            if not is_taken:
                self._drop(request)
