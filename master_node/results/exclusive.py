"""One run at a time writes into a results directory."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from protocol.errors import ResultsError
from protocol.host.directory_locks import lock_directory


@contextmanager
def exclusive(directory: Path) -> Iterator[None]:
    """Keep other runs out of a results directory, in this process and in others of this host.

    Where the file system has no locks, or the directory is not there, no other process is kept out.

    Raises:
        ResultsError: another run is writing into it.
    """
    try:
        lock = lock_directory(directory)
    except BlockingIOError as error:
        raise ResultsError(
            f"another run is writing into {directory}",
            remedy="wait for its end, or choose another results directory",
        ) from error
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)
