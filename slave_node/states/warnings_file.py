"""Warnings of a model that other processes hold, as they write them down: a line for each."""

from __future__ import annotations

import os
from pathlib import Path

from protocol.calls import NO_WARNINGS, ModelWarnings


class WarningsFile:
    """A file to which all processes append that hold one model.

    Args:
        path: of a new file.

    Attributes:
        path: as above.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor: int | None = os.open(path, os.O_RDONLY | os.O_CREAT, 0o600)
        self._size = 0

    def take(self) -> ModelWarnings:
        """Warnings since the last call; none once it is closed."""
        if self._descriptor is None:
            return NO_WARNINGS
        size = os.fstat(self._descriptor).st_size
        if size < self._size:  # it was full, and has begun anew
            self._size = 0
        if size == self._size:
            return NO_WARNINGS
        os.lseek(self._descriptor, self._size, os.SEEK_SET)
        data = os.read(self._descriptor, size - self._size)
        data = data[: data.rfind(b"\n") + 1]
        self._size += len(data)
        lines = data.splitlines()
        first = lines[0].decode(errors="replace") if lines else ""
        return ModelWarnings(len(lines), first)

    def close(self) -> None:
        """Give the file up. Idempotent."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
