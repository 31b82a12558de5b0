"""Death of a process that held a model, as an error, and whether the model did it.

A step is rejected, and tried smaller, only for a death that is known to be the model's own doing.
Any other one, and one of which nothing is known, changes nothing: the slave is restored.
"""

from __future__ import annotations

import signal

from protocol.errors import SlaveCrashedError, SlaveKilledError

OWN_FAILURE = 70
"""Exit code (EX_SOFTWARE of ``sysexits.h``) of a process that ends because code of ours failed."""

_OF_A_MODEL = frozenset(
    int(getattr(signal, name))
    for name in ("SIGSEGV", "SIGABRT", "SIGFPE", "SIGILL", "SIGBUS", "SIGTRAP", "SIGSYS")
    if hasattr(signal, name)
)
"""Signals that a process gets by what it does."""


def death(exit_code: int | None) -> SlaveCrashedError:
    """The error for a process that died while the model was called.

    Args:
        exit_code: as `multiprocessing.Process.exitcode`, -N for signal N; None: not known.

    Returns:
        `SlaveCrashedError` where the model is known to have ended it, by a signal that a process
        gets by what it does or by leaving it; else `SlaveKilledError`.
    """
    is_of_model = exit_code is not None and (
        -exit_code in _OF_A_MODEL if exit_code < 0 else exit_code != OWN_FAILURE
    )
    kind = SlaveCrashedError if is_of_model else SlaveKilledError
    return kind(f"the process that held the model {how_ended(exit_code)}")


def how_ended(exit_code: int | None) -> str:
    """End of a process with this exit code, in a few words."""
    if exit_code is None:
        return "is gone, and nothing tells why"
    if exit_code >= 0:
        return f"ended with exit code {exit_code}"
    return f"died by {_name(-exit_code)}"


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # a real-time signal
        return f"signal {number}"
