"""Room for requests that wait or are being served: bounded in bytes, as a message may be large."""

from __future__ import annotations

import threading
from typing import Final

SMALL_ROOM: Final = 4 * 2**20
"""Bytes for who takes short messages only."""


class Room:
    """Bytes that requests may hold, for one key or for several together. From any thread.

    Args:
        size: of all of it [bytes].
        requests: how many may be in it at once.
    """

    def __init__(self, size: int, requests: int = 256) -> None:
        self._left = size
        self._requests = requests
        self._lock = threading.Lock()

    def take(self, size: int) -> bool:
        """Make room for a request of ``size`` bytes; False where there is none."""
        with self._lock:
            if size > self._left or not self._requests:
                return False
            self._left -= size
            self._requests -= 1
            return True

    def give(self, size: int) -> None:
        """A request of ``size`` bytes is done with."""
        with self._lock:
            self._left += size
            self._requests += 1
