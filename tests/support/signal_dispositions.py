"""Signals as a login shell leaves them, also under ``nohup`` and behind ``&``.

A shell starts background jobs with SIGINT ignored, ``nohup`` its command with SIGHUP ignored, and
processes hand this on to those that they start.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGHUP") if hasattr(signal, name)]
"""Those that a shell ignores for what it starts; Windows has no SIGHUP."""


def _ignore(number: int, frame: object) -> None:
    """Handle a signal as if it were ignored; unlike SIG_IGN, a handler is not inherited."""


@contextmanager
def default_dispositions() -> Iterator[None]:
    """Commands that are started meanwhile end on SIGINT and SIGHUP, as a user's commands do.

    This process takes SIGINT as Python does, and outlives the terminal if it was to outlive it.
    """
    handlers = {signal.SIGINT: signal.default_int_handler}
    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number, handler in before.items():
        if handler is signal.SIG_IGN:
            signal.signal(number, handlers.get(number, _ignore))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
