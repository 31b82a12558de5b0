"""Waiting for the end of a process that only serves."""

from __future__ import annotations

import threading

_PERIOD = 0.2


def wait_for_end(ending: threading.Event) -> None:
    """Wait in the main thread until ``ending`` is set, such as by a handler of signals.

    The system may give a signal to any thread, above all where the process was stopped meanwhile.
    Python handles it in the main thread, but does not wake that one: so it looks now and then.
    """
    while not ending.wait(_PERIOD):
        pass
