"""An observer that breaks runs off, as Ctrl-C does."""

from __future__ import annotations


class Interrupt:
    """Breaks a run off in one of its attempts.

    Args:
        attempt: its number, from 1 on.
    """

    def __init__(self, attempt: int) -> None:
        self._left = attempt

    def started(self, _: object) -> None:
        """Nothing yet."""

    def attempted(self, _: object) -> None:
        """Count down."""
        self._left -= 1
        if self._left == 0:
            raise KeyboardInterrupt

    def ended(self, _: object) -> None:
        """Nothing any more."""
