"""Processes as the bus speaks of them, a host and a process id; and what asks one to end."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path

_DEAD_STATES = frozenset("ZX")  # a zombie only waits for its parent to look


def ending_signals() -> list[signal.Signals]:
    """Those that ask a command to end; SIGHUP, of a terminal that is gone, not under ``nohup``.

    SIGBREAK is that of Ctrl-Break, and of a window that is closed, on Windows.
    """
    numbers = [signal.SIGINT, signal.SIGTERM]
    if sys.platform == "win32":
        numbers.append(signal.SIGBREAK)
    hang_up = getattr(signal, "SIGHUP", None)  # not on Windows
    if hang_up is not None and signal.getsignal(hang_up) is not signal.SIG_IGN:
        numbers.append(hang_up)
    return numbers


def user_id() -> int:
    """Number of the user of this process; -1 on Windows, which has none."""
    if sys.platform == "win32":
        return -1
    else:  # noqa: RET505  what the type checker sees of a platform
        return os.getuid()


def interrupt_main_thread() -> None:
    """Send SIGINT to the main thread, from any thread; what it waits for is broken off.

    ``os.kill`` would end the process on Windows, and ``raise_signal`` would not wake the main
    thread elsewhere.
    """
    if sys.platform == "win32":
        signal.raise_signal(signal.SIGINT)
    else:
        main = threading.main_thread().ident
        assert main is not None
        signal.pthread_kill(main, signal.SIGINT)


class PeerProcess:
    """A process that spoke to us, and what becomes of it.

    Its host may have our name and see other processes, as containers do: what is not here now is
    never known to have ended.

    Args:
        host, pid: as it says.
    """

    def __init__(self, host: str, pid: int) -> None:
        self._place = host, pid
        self.is_here = is_of_this_host(host, pid) and not has_ended(host, pid)

    @property
    def has_ended(self) -> bool:
        """True when it was here and is no more; False: it may live."""
        return self.is_here and has_ended(*self._place)


def is_of_this_host(host: str, pid: int) -> bool:
    """True if the system can be asked for a process."""
    return host == socket.gethostname() and pid > 0 and os.name == "posix"


def has_ended(host: str, pid: int) -> bool:
    """True when ``pid`` is a process of this host that is no more; False: it may live."""
    if not is_of_this_host(host, pid):
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
