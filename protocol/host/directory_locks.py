"""Locks on directories, which go with the process that holds them, however it ends."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

if sys.platform == "win32":
    _LOCK_FILE = ".lock"

    def _lock(directory: Path) -> int:
        """A file that goes with the process that holds it."""
        flags = os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_TEMPORARY
        return os.open(directory / _LOCK_FILE, flags)

    _TAKEN: tuple[type[OSError], ...] = (FileExistsError, PermissionError)
else:
    import fcntl

    def _lock(directory: Path) -> int:
        """The directory itself."""
        flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW
        descriptor = os.open(directory, flags)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            raise
        return descriptor

    _TAKEN = (BlockingIOError,)


def lock_directory(directory: Path) -> int | None:
    """Keep others out of a directory, in this process and in others of this host.

    Returns:
        A descriptor: to close it is to let the directory go. None: the directory is not there, or
        its file system has no locks, such as network file systems that lock files only.

    Raises:
        BlockingIOError: it is held.
    """
    try:
        with suppress(FileNotFoundError):
            return _lock(directory)
    except _TAKEN as error:
        raise BlockingIOError(str(error)) from error
    except OSError:
        pass
    return None
