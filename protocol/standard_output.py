"""The standard output of a command, which a reader may leave and a disk may not hold."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any, TextIO

from protocol.errors import ResultsError


class _StandardOutput:
    """A stream that is silent when its reader has left: the command goes on to its own end."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._failure: ResultsError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """See `io.TextIOBase.write`; raises `ResultsError`."""
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """See `io.TextIOBase.flush`; raises `ResultsError`."""
        if self._failure is None:  # else it was told, and nothing is left to flush
            self._try(self._stream.flush)

    def _try(self, action: Callable[[], object]) -> None:
        try:
            action()
        except OSError as error:
            self._discard()
            if not isinstance(error, BrokenPipeError):
                self._failure = ResultsError(
                    f"cannot write to the standard output: {error.strerror}"
                )
        if self._failure is not None:  # and again, as who tries a stream may pass over it
            raise self._failure

    def _discard(self) -> None:
        """All that follows, and what is left in the buffer when the process ends."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)


def guard_standard_output() -> None:
    """Let no ``| head`` end this command or change its exit code; a full disk is a `ResultsError`.

    Once for a process, before anything is written.
    """
    if sys.stdout is not None:  # closed by who started the command
        sys.stdout = _StandardOutput(sys.stdout)
