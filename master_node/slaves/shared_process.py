"""The process that models share with their master: kept as it was when the run began.

A model in a process of its own may change it as it likes. In the master's process the results have
to go where the user said, Ctrl-C has to be heard, and the next model has to find what it would find
in its own process. So what models change is put back when they return:

- *after each request* the working directory, which each model finds again as it left it, the
  handlers of Ctrl-C and SIGTERM, a Ctrl-C that came while a model wrote to its log, and what hangs
  on a context: NumPy's handling of errors, the decimal context. (The floating-point
  environment is put back by ``slave_node/execution/executor.py``, in every process.)
- *after loading, initialization and all else but steps* the umask, the standard streams and their
  descriptors, the locale, signal handlers, and what `logging` is told to swallow.
- *after the run* also the module path, environment variables, the filters of warnings and the
  recursion limit, on which a model may rely in between.

Not put back: what only C code sees of the environment, timers, limits of resources, and the state
of random numbers that Python's modules share.
"""

from __future__ import annotations

import ctypes
import locale
import logging
import os
import signal
import sys
import threading
import warnings

# As in `signal`, but for the conversion of numbers to enumerations, which takes ten times as long.
from _signal import getsignal  # type: ignore[import-not-found]
from _signal import signal as set_handler
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, ParamSpec, TypeVar

from protocol.host.descriptors import is_open
from protocol.host.user_code import user_context

P = ParamSpec("P")
T = TypeVar("T")


class SharedProcess:
    """State of the process that one model changes, and finds again.

    Args:
        baseline: to which the process returns.
    """

    def __init__(self, baseline: Baseline) -> None:
        self._baseline = baseline
        self._context = user_context()
        self._directory: str | None = None

    def step(self, action: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
        """Let the model take a step."""
        handlers = [(number, getsignal(number)) for number in _ENDING]
        if self._directory is not None:
            _go_to(self._directory)
        try:
            return self._context.run(action, *arguments, **named)
        finally:
            _handle(handlers)
            here = _directory()
            is_ours = here == self._baseline.directory
            self._directory = None if is_ours else here
            if not is_ours:
                _go_to(self._baseline.directory)
            self._baseline.raise_late()

    def run(self, action: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
        """Let the model do anything else."""
        signals = _Signals()
        try:
            return self.step(action, *arguments, **named)
        finally:
            self._baseline.restore()
            signals.restore()


class Baseline:
    """The process as it is now.

    Attributes:
        directory: where it works; None: nowhere, as the directory was removed.
    """

    def __init__(self) -> None:
        self.directory = _directory()
        self._umask = _umask()
        self._streams = sys.stdin, sys.stdout, sys.stderr
        self._descriptors = [(number, os.dup(number)) for number in range(3) if is_open(number)]
        self._locale = locale.setlocale(locale.LC_ALL)
        self._logging = logging.root.manager.disable, list(logging.root.handlers)
        self._late: list[BaseException] = []

    def note_unraisable(self, unraisable: Any) -> None:
        """Keep a Ctrl-C that came while a model called back: C code hands on no exception."""
        error = unraisable.exc_value
        if error is None or isinstance(error, Exception):
            sys.__unraisablehook__(unraisable)
        else:
            self._late.append(error)

    def raise_late(self) -> None:
        """Raise what was kept, if anything."""
        if self._late:
            error = self._late[0]
            self._late.clear()
            raise error

    def restore(self) -> None:
        """Bring it back."""
        _go_to(self.directory)
        os.umask(self._umask)
        sys.stdin, sys.stdout, sys.stderr = self._streams
        for number, kept in self._descriptors:
            with suppress(OSError):
                if not (is_open(number) and os.path.sameopenfile(number, kept)):
                    os.dup2(kept, number)
        if locale.setlocale(locale.LC_ALL) != self._locale:
            with suppress(locale.Error):
                locale.setlocale(locale.LC_ALL, self._locale)
        disabled, handlers = self._logging
        logging.root.manager.disable = disabled
        logging.root.handlers[:] = handlers

    def close(self) -> None:
        """Give up what is kept of it."""
        for _, kept in self._descriptors:
            os.close(kept)
        self._descriptors.clear()


@contextmanager
def shared_process() -> Iterator[Baseline]:
    """The process as it is at the begin, also after the end."""
    baseline, signals = Baseline(), _Signals()
    path, environment = list(sys.path), dict(os.environ)
    limit, hook = sys.getrecursionlimit(), sys.unraisablehook
    sys.unraisablehook = baseline.note_unraisable
    try:
        with warnings.catch_warnings():
            yield baseline
    finally:
        sys.path[:] = path
        if dict(os.environ) != environment:
            os.environ.clear()
            os.environ.update(environment)
        sys.setrecursionlimit(limit)
        sys.unraisablehook = hook
        baseline.restore()
        signals.restore()
        baseline.close()


class _Signals:
    """The handlers of signals, those of Python and those behind them."""

    def __init__(self) -> None:
        self._handlers = {number: getsignal(number) for number in signal.valid_signals()}
        self._actions = {number: _sigaction(number) for number in self._handlers}

    def restore(self) -> None:
        """Set those again that were changed."""
        _handle(
            (number, handler)
            for number, handler in self._handlers.items()
            if getsignal(number) is not handler
        )
        for number, action in self._actions.items():
            if action is not None and _sigaction(number) != action:
                _sigaction(number, action)


_ENDING = (signal.SIGINT, signal.SIGTERM)


def _handle(handlers: Iterable[tuple[int, Any]]) -> None:
    """Set handlers, also where Python believes that they are set; only its main thread can."""
    if threading.current_thread() is threading.main_thread():
        for number, handler in handlers:
            if handler is not None:
                set_handler(number, handler)


_SIGACTION = 256
"""Bytes: more than a ``struct sigaction`` has anywhere."""


def _sigaction(number: int, action: bytes | None = None) -> bytes | None:
    """Action of the process at a signal, as it was before it is set; None: not to be known."""
    function: Any = getattr(_LIBC, "sigaction", None)
    if function is None:
        return None
    before = ctypes.create_string_buffer(_SIGACTION)
    given = None if action is None else ctypes.create_string_buffer(action, _SIGACTION)
    return before.raw if function(int(number), given, before) == 0 else None


_LIBC = ctypes.CDLL(None) if os.name == "posix" else None


def _directory() -> str | None:
    try:
        return os.getcwd()  # noqa: PTH109  once for each step
    except OSError:
        return None


def _go_to(directory: str | None) -> None:
    if directory is not None:
        with suppress(OSError):
            os.chdir(directory)


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
