"""Ctrl-C and its like in a command that has something to end before it ends."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import NoReturn

from protocol.errors import InterruptedRunError
from protocol.host.processes import ending_signals


@dataclass
class Interruption:
    """Interruption of a command.

    Attributes:
        number: of the signal that came; None: none has come.
    """

    number: int | None = None

    @property
    def is_ctrl_c(self) -> bool:
        """True if the user pressed Ctrl-C; a service manager sends other signals."""
        return self.number == signal.SIGINT


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Ctrl-C, SIGTERM and SIGHUP end the command with exit code 130; the first two also where a
    shell ignores them.

    A second one kills it: what it launched ends with it.

    Yields:
        What came, for what the command still does behind it.

    Raises:
        InterruptedRunError: one came.
    """
    ending = ending_signals()
    interruption = Interruption()

    def interrupt(number: int, _: FrameType | None) -> NoReturn:
        interruption.number = number
        for each in ending:
            signal.signal(each, signal.SIG_DFL)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ending}
    try:
        yield interruption
        for number, handler in before.items():
            signal.signal(number, handler)
    except KeyboardInterrupt:
        raise InterruptedRunError("interrupted") from None
