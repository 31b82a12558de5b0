"""The last messages of an FMU, which explain its errors."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from fmpy.fmi1 import FMICallException, fmi1CallbackLoggerTYPE
from fmpy.fmi2 import fmi2CallbackLoggerTYPE
from fmpy.logging import addLoggerProxy

_LINES = 20
_SHOWN = 5
_FATAL = 4
UNNAMED = ""
_ERROR_CATEGORIES = {
    *("logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal"),
    UNNAMED,
}


class FmuLog:
    """The last messages of one FMU."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque(maxlen=_LINES)

    def add(self, category: bytes | None, text: bytes | None) -> None:
        """Keep a message."""
        self._lines.append(
            f"[{(category or b'').decode(errors='replace')}] "
            f"{(text or b'').decode(errors='replace').strip()}"
        )

    def explain(self, text: str) -> str:
        """``text`` with the last messages behind it, which are used up by that."""
        lines = " | ".join(list(self._lines)[-_SHOWN:])
        self._lines.clear()
        return f"{text}; the FMU's log: {lines}" if lines else text


def wanted_categories(names: list[str], *, log_all: bool) -> list[str]:
    """Those of an FMU's log categories that are asked for: all, or those of its errors."""
    return [name for name in names if log_all or name in _ERROR_CATEGORIES]


def choose_categories(choose: Callable[..., object], *arguments: object) -> None:
    """Call fmiSetDebugLogging; an FMU that refuses goes on with the log that it has.

    Raises:
        FMICallException: the FMU cannot go on.
    """
    try:
        choose(*arguments)
    except FMICallException as error:
        if error.status == _FATAL:
            raise


# ---- FMI 1.0 and 2.0: messages with arguments, formatted by fmpy's proxy -----------------------

_logs: dict[int, FmuLog] = {}
"""By the first argument of the logger: the environment of FMI 2.0, the component of FMI 1.0."""

_instantiating: list[FmuLog] = []
"""Log of the FMU that is being instantiated: one of FMI 1.0 has no component yet."""


def _receive(
    environment: int | None, _name: bytes, _status: int, category: bytes, text: bytes
) -> None:
    log = _logs.get(environment or 0)
    if log is None and _instantiating:
        log = _instantiating[-1]
    elif log is None and len(_logs) == 1:  # an FMU that forgets its environment
        (log,) = _logs.values()
    if log is not None:
        log.add(category, text)


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
