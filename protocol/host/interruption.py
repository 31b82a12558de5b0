"""Ctrl-C and its like in a command that has something to end before it ends."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from protocol.errors import InterruptedRunError
from protocol.host.processes import ending_signals


@contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C, SIGTERM and SIGHUP end the command with exit code 130; the first two also where a
    shell ignores them.

    A second one kills it: what it launched ends with it.

    Raises:
        InterruptedRunError: one came.
    """
    ending = ending_signals()

    def interrupt(*_: object) -> NoReturn:
        for number in ending:
            signal.signal(number, signal.SIG_DFL)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ending}
    try:
        yield
        for number, handler in before.items():
            signal.signal(number, handler)
    except KeyboardInterrupt:
        raise InterruptedRunError("interrupted") from None
