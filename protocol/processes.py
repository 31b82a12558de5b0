"""Processes as the bus speaks of them, a host and a process id; and what asks one to end."""

from __future__ import annotations

import os
import signal
import socket
from contextlib import suppress
from pathlib import Path

_DEAD_STATES = frozenset("ZX")  # a zombie only waits for its parent to look


def ending_signals() -> list[signal.Signals]:
    """Those that ask a command to end; SIGHUP, of a terminal that is gone, not under ``nohup``."""
    numbers = [signal.SIGINT, signal.SIGTERM]
    hang_up = getattr(signal, "SIGHUP", None)  # not on Windows
    if hang_up is not None and signal.getsignal(hang_up) is not signal.SIG_IGN:
        numbers.append(hang_up)
    return numbers


def has_ended(host: str, pid: int) -> bool:
    """True when ``pid`` is a process of this host that is no more; False: it may live."""
    if host != socket.gethostname() or pid <= 0 or os.name != "posix":
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):
        return False  # somebody else's, or no process id of this platform
    with suppress(OSError):  # no such file on other platforms than Linux
        status = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        return status.rpartition(")")[2].strip()[:1] in _DEAD_STATES
    return False
