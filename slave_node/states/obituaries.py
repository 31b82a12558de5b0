"""Obituaries: how processes died that hold a model, written into a pipe."""

from __future__ import annotations

import os
from contextlib import suppress
from struct import Struct

OBITUARY = Struct("<qq")
"""Process id, and how it ended as `os.waitpid` tells."""


def report(obituaries: int, pid: int, status: int) -> None:
    """Write down how a process died, unless it ended as it should."""
    if status:
        with suppress(OSError):  # they are no longer read
            os.write(obituaries, OBITUARY.pack(pid, status))
