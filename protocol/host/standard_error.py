"""The standard error of a process, and of the models in it: what cannot be written there is lost.

It may lead to a file on a disk that is full, or to a reader that has left. That must not change
what a process does or how it ends: there is no place left to tell it.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import Any, TextIO


class _Forgiving:
    """A stream that loses what cannot be written; what comes later may be written again."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """See `io.TextIOBase.write`."""
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """See `io.TextIOBase.flush`."""
        with suppress(OSError):
            self._stream.flush()


def forgive_standard_error() -> None:
    """Let no full disk behind the standard error end this process. Once, before anything else."""
    if sys.stderr is not None:  # closed by who started it
        sys.stderr = _Forgiving(sys.stderr)


def forgive_models() -> None:
    """Let none end a model that prints: in a process whose standard output is no data."""
    forgive_standard_error()
    if sys.stdout is not None:
        sys.stdout = _Forgiving(sys.stdout)
