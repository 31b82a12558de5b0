"""One run at a time writes into a results directory."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from protocol.errors import ResultsError

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
        """The directory itself, by a lock that goes with the process that holds it."""
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            raise
        return descriptor

    _TAKEN = (BlockingIOError,)


@contextmanager
def exclusive(directory: Path) -> Iterator[None]:
    """Keep other runs out of a results directory, in this process and in others of this host.

    Where the file system has no locks, or the directory is not there, nobody is kept out.

    Raises:
        ResultsError: another run is writing into it.
    """
    descriptor = None
    try:
        with suppress(FileNotFoundError):
            descriptor = _lock(directory)
    except _TAKEN as error:
        raise ResultsError(
            f"another run is writing into {directory}",
            remedy="wait for its end, or choose another results directory",
        ) from error
    except OSError:  # such as network file systems that lock files only
        pass
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)
