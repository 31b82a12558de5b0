"""Ends of commands that serve: a signal, or a parent process that is gone."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

from protocol.host.processes import ending_signals
from protocol.host.threads import start_thread


def end_on_signals(end: Callable[[str], None]) -> None:
    """Call ``end`` with the name of a signal that ends processes.

    It is called on a thread, because the one that gets the signal may hold any lock.
    """

    def handle(number: int, _: FrameType | None) -> None:
        start_thread(lambda: end(signal.Signals(number).name), "end")

    for number in ending_signals():
        signal.signal(number, handle)


def end_with_parent(end: Callable[[str], None]) -> None:
    """Call ``end`` when standard input, a pipe from the parent process, closes."""

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        end("the process that started this slave has ended")

    start_thread(watch, "parent")
