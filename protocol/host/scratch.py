"""Temporary directories that a killed process does not leave for ever.

A directory is locked as long as its process lives. Whoever makes another one in the same place
removes those of the same user that are not: their processes are gone, killed perhaps.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

from protocol.host.directory_locks import lock_directory
from protocol.host.processes import user_id

PREFIX = "doublestep-scratch-"
"""With which the names of all of them begin, in ``TMPDIR``."""


class ScratchDirectory:
    """A new directory for temporary files, removed by `close`. A context manager for its path.

    Attributes:
        path: absolute.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self) -> None:
        parent = Path(tempfile.gettempdir())
        _remove_abandoned(parent)
        self._lock: int | None = None
        while True:
            self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
            with suppress(BlockingIOError):  # somebody takes it for abandoned, and removes it
                self._lock = lock_directory(self.path)
                if self.path.exists():
                    break
                self._let_go()

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove it with all that is in it, as far as that is possible. Idempotent."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._let_go()

    def _let_go(self) -> None:
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)


def _remove_abandoned(parent: Path) -> None:
    """Elsewhere than on POSIX systems a process leaves nothing that is locked."""
    if os.name != "posix":
        return
    with suppress(OSError):
        for entry in list(os.scandir(parent)):
            with suppress(OSError):  # another process was there first, or it is held
                is_ours = entry.stat(follow_symlinks=False).st_uid == user_id()
                if entry.name.startswith(PREFIX) and is_ours:
                    _remove_if_abandoned(Path(entry.path))


def _remove_if_abandoned(directory: Path) -> None:
    lock = lock_directory(directory)
    if lock is not None:
        try:
            shutil.rmtree(directory, ignore_errors=True)
        finally:
            os.close(lock)
