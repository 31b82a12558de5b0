"""Ctrl-C comes between steps that are written down, never into one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_ENDING = (signal.SIGINT, signal.SIGTERM)


class Interrupts:
    """Signals that wait within ``with interrupts:`` until its end.

    What handles them stays as it was set, and is only called later. Python handles signals in its
    main thread, so elsewhere there is nothing to wait for.
    """

    def __init__(self) -> None:
        self._handlers: dict[int, Any] = {}
        self._holders = 0
        self._is_patient = False
        self._waiting: list[int] = []

    @contextmanager
    def deferrable(self) -> Iterator[None]:
        """While this lasts signals can be made to wait."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        for number in _ENDING:
            handler = signal.getsignal(number)
            if callable(handler):
                self._handlers[number] = handler
                signal.signal(number, self._handle)
        try:
            yield
        finally:
            for taken, handler in self._handlers.items():
                if signal.getsignal(taken) == self._handle:  # else a handler has replaced it
                    signal.signal(taken, handler)
            self._handlers.clear()

    @contextmanager
    def until_step_ends(self) -> Iterator[None]:
        """Signals wait while this lasts; a second one of the same kind does not."""
        self._is_patient = True
        try:
            with self:
                yield
        finally:
            self._is_patient = False

    def __enter__(self) -> None:
        """From here on signals wait."""
        self._holders += 1

    def __exit__(self, *_: object) -> None:
        """Those that came meanwhile come now."""
        self._holders -= 1
        while self._waiting and not self._holders:
            self._handle(self._waiting.pop(), None)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        is_second = self._is_patient and self._holders == 1 and number in self._waiting
        if self._holders and not is_second:
            self._waiting.append(number)
        else:
            self._handlers[number](number, frame)
