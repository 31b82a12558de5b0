"""Messages of an FMU: where they are written, which ones it gives, and what explains its errors."""

from __future__ import annotations

import ctypes
import logging
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from fmpy.fmi1 import FMICallException, fmi1CallbackLoggerTYPE
from fmpy.fmi2 import fmi2CallbackLoggerTYPE
from fmpy.logging import addLoggerProxy

from protocol.calls import NO_WARNINGS, ModelWarnings
from protocol.errors import ModelError
from protocol.host.log_files import (
    NOWHERE,
    SILENT,
    STANDARD_ERROR,
    LogFileHandler,
    LogOutput,
    append,
)
from protocol.host.logs import formatter
from protocol.text.names import nearest

_LINES = 20
_SHOWN = 5
_LENGTH = 2000
"""Characters of a message that are kept."""

STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
OK, WARNING, DISCARD, ERROR, FATAL = range(5)
"""The numbers of the statuses, the same in all versions."""

_LEVELS = {WARNING: logging.WARNING, ERROR: logging.ERROR, FATAL: logging.CRITICAL}
UNNAMED = ""
_ERROR_CATEGORIES = {
    *("logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal"),
    UNNAMED,
}


class FmuLog:
    """The messages of one FMU.

    Args:
        name: of the slave.
        output: where they go.
        prefix: of FMI's names, such as ``fmi2``.
    """

    def __init__(self, name: str, output: LogOutput = SILENT, prefix: str = "fmi") -> None:
        self.output = output
        self._prefix = prefix
        self._lines: deque[str] = deque(maxlen=_LINES)
        self._warnings = NO_WARNINGS
        self._logger = _logger(name, output)

    def add(self, status: int, category: bytes | None, text: bytes | None) -> None:
        """Keep a message, and write it down."""
        words = (text or b"").decode(errors="replace").strip()[:_LENGTH]
        line = f"[{(category or b'').decode(errors='replace')[:_LENGTH]}] {words}"
        self._lines.append(line)
        known = 0 <= status < len(STATUS)
        name = f"{self._prefix}{STATUS[status]}" if known else f"status {status}"
        if self._logger is not None:
            self._logger.log(_LEVELS.get(status, logging.INFO), "%s %s", name, line)
        if status == WARNING:
            self._warned(words)

    def returned_warning(self, function: str) -> None:
        """Note that a function returned the status Warning."""
        text = f"{function} returned {self._prefix}Warning"
        if self._logger is not None:
            self._logger.warning("%s", text)
        self._warned(text)

    def _warned(self, text: str) -> None:
        if self.output.warnings:
            with suppress(OSError):
                append(self.output.warnings, " ".join(text.split()))
        else:
            self._warnings = self._warnings.after(text)

    def take_warnings(self) -> ModelWarnings:
        """Warnings since the last call."""
        taken, self._warnings = self._warnings, NO_WARNINGS
        return taken

    def explain(self, text: str) -> str:
        """``text`` with the last messages behind it, which are used up by that."""
        lines = " | ".join(list(self._lines)[-_SHOWN:])
        self._lines.clear()
        return f"{text}; the FMU's log: {lines}" if lines else text

    @property
    def is_wanted(self) -> bool:
        """True if messages are asked for beyond those of warnings and errors."""
        return bool(self.output.categories)

    def wanted_categories(self, names: Sequence[str]) -> list[str]:
        """Those of an FMU's log categories that are asked for.

        Raises:
            ModelError: a pattern fits none of them.
        """
        patterns = self.output.categories
        if not patterns:
            return [name for name in names if name in _ERROR_CATEGORIES]
        for pattern in patterns:
            if names and not any(fnmatchcase(name, pattern) for name in names):
                raise ModelError(
                    f"it has no log category {pattern!r}{nearest(pattern, names)}; it has "
                    f"{', '.join(names)}",
                    remedy='correct fmi_logging; ["*"] stands for all',
                )
        return [name for name in names if any(fnmatchcase(name, p) for p in patterns)]


def _logger(name: str, output: LogOutput) -> logging.Logger | None:
    """A logger of this FMU alone, whatever loggers its process has."""
    if output.file == NOWHERE:
        return None
    handler: logging.Handler
    if output.file == STANDARD_ERROR:
        handler = logging.StreamHandler(sys.stderr)
    else:
        handler = LogFileHandler(Path(output.file))
    handler.setFormatter(formatter(output.style, f"%(asctime)s {name}: %(message)s", slave=name))
    logger = logging.Logger("slave_node.fmu", logging.INFO)
    logger.addHandler(handler)
    return logger


def choose_categories(choose: Callable[..., object], *arguments: object) -> None:
    """Call fmiSetDebugLogging; an FMU that refuses goes on with the log that it has.

    Raises:
        FMICallException: the FMU cannot go on.
    """
    try:
        choose(*arguments)
    except FMICallException as error:
        if error.status == FATAL:
            raise


# ---- FMI 1.0 and 2.0: messages with arguments, formatted by fmpy's proxy -----------------------

_logs: dict[int, FmuLog] = {}
"""By the first argument of the logger: the environment of FMI 2.0, the component of FMI 1.0."""

_instantiating: list[FmuLog] = []
"""Log of the FMU that is being instantiated: one of FMI 1.0 has no component yet."""


def _receive(
    environment: int | None, _name: bytes, status: int, category: bytes, text: bytes
) -> None:
    log = _logs.get(environment or 0)
    if log is None and _instantiating:
        log = _instantiating[-1]
    elif log is None and len(_logs) == 1:  # an FMU that forgets its environment
        (log,) = _logs.values()
    if log is not None:
        log.add(status, category, text)


LOGGER_2 = fmi2CallbackLoggerTYPE(_receive)
"""Logger callback of FMI 2.0, for all FMUs: the proxy that formats messages knows one logger."""

LOGGER_1 = ctypes.cast(LOGGER_2, fmi1CallbackLoggerTYPE)
"""Logger callback of FMI 1.0."""


def add_proxy(callbacks: Any) -> None:
    """Put the proxy between an FMU and the logger in its callback functions."""
    addLoggerProxy(ctypes.byref(callbacks))


def register(key: int, log: FmuLog) -> None:
    """Give ``log`` what comes with ``key`` as first argument."""
    _logs[key] = log


def unregister(log: FmuLog) -> None:
    """Let ``log`` get nothing any more."""
    for key in [key for key, value in _logs.items() if value is log]:
        del _logs[key]


@contextmanager
def instantiating(log: FmuLog) -> Iterator[None]:
    """Let ``log`` get what comes with no known argument in between."""
    _instantiating.append(log)
    try:
        yield
    finally:
        _instantiating.remove(log)
