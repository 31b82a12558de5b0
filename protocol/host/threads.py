"""Threads, and the error of a host that gives no further one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from protocol.errors import HostLimitError

_T = TypeVar("_T", bound=threading.Thread)


def start_thread(action: Callable[[], object], name: str) -> threading.Thread:
    """Run ``action`` beside all else; it does not keep the process from ending.

    Raises:
        HostLimitError: there is no thread for it.
    """
    return started(threading.Thread(target=action, name=name, daemon=True))


def started(thread: _T) -> _T:
    """A thread, begun.

    Raises:
        HostLimitError: there is none.
    """
    try:
        thread.start()
    except RuntimeError as error:
        raise HostLimitError(
            f"the host gives this process no further thread: {error}", remedy=LIMITS
        ) from error
    return thread


LIMITS = "raise its limits of memory and processes (ulimit -v and -u, or those of its container)"
"""The remedy for a process that gets no more memory, threads or processes."""
