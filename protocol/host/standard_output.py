"""The standard output of a command: its own data alone, as long as there is a reader and a disk.

Models and other code that users bring write where they like. What a command prints may be data for
another one, so from its start only itself has the way there: descriptor 1 leads to standard error.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


@contextmanager
def guarded_standard_output() -> Iterator[None]:
    """Let no ``| head`` end this command or change its exit code; a full disk is a `ResultsError`.

    Once for a process, before anything is written. Afterwards nothing gets to the standard output
    any more: what models print when the process ends is no data either.
    """
    if sys.stdout is None:  # closed by who started the command
        yield
        return
    given = sys.stdout
    own = _own_way_out(given)
    sys.stdout = _StandardOutput(given if own is None else own)
    try:
        yield
    finally:
        if own is not None:
            sys.stdout.flush()
            sys.stdout = sys.stderr


def _own_way_out(stream: TextIO) -> TextIO | None:
    """A stream to where descriptor 1 leads, which leads to standard error from here on."""
    try:
        if stream.fileno() != 1:
            return None  # of a program that runs the command within itself
        own = os.dup(1)
        os.dup2(2, 1)
    except (OSError, ValueError):
        return None
    return open(own, "w", encoding=stream.encoding, errors=stream.errors)  # noqa: PTH123


@contextmanager
def output_of_others() -> Iterator[None]:
    """While this lasts ``print`` writes to standard error: code of users runs."""
    ours, sys.stdout = sys.stdout, sys.stderr
    try:
        yield
    finally:
        sys.stdout = ours
