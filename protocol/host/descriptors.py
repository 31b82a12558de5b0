"""File descriptors of this process."""

from __future__ import annotations

import os


def is_open(descriptor: int) -> bool:
    """True if a file descriptor of this number is open."""
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True
