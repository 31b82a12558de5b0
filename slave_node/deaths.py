"""How a process that held a model died, as an error."""

from __future__ import annotations

import signal

from protocol.errors import SlaveCrashedError, SlaveKilledError

_FROM_OUTSIDE = frozenset(
    int(getattr(signal, name))
    for name in ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT")
    if hasattr(signal, name)
)
"""Signals that a model does not get by what it does."""


def death(exit_code: int | None) -> SlaveCrashedError:
    """The error to raise.

    Args:
        exit_code: as `multiprocessing.Process.exitcode`, -N for signal N; None: not known.

    Returns:
        `SlaveKilledError` where a signal from outside ended it, else `SlaveCrashedError`.
    """
    kind, how = SlaveCrashedError, "is gone"
    if exit_code is not None and exit_code >= 0:
        how = f"ended with exit code {exit_code}"
    elif exit_code is not None:
        how = f"died by {_name(-exit_code)}"
        if -exit_code in _FROM_OUTSIDE:
            kind = SlaveKilledError
    return kind(f"the process that held the model {how}")


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # a real-time signal
        return f"signal {number}"
