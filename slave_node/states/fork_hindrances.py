"""What a forked copy of a process would not have, or would have in common with the original.

A fork copies memory and one thread. Other threads are missing in the copy; sockets, devices and
files that are written are the same ones in both, and so is memory that is mapped as shared.
Files that are only read are no hindrance: the copy opens them again, where they stand.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Set as AbstractSet
from contextlib import suppress
from fcntl import F_GETFL, fcntl
from pathlib import Path

_TASKS = "/proc/self/task"
_DESCRIPTORS = "/proc/self/fd"
_MAPS = "/proc/self/maps"
_HARMLESS_DEVICES = frozenset({"/dev/null", "/dev/zero", "/dev/random", "/dev/urandom"})

Reader = tuple[int, int]
"""A descriptor that is read, and where its file stands."""


class ForkHindrances:
    """Compares what the process has now with what it had before its model was loaded."""

    def __init__(self) -> None:
        self._descriptors = _open_descriptors()
        self._shared_memory = _shared_memory()
        self._was_asked = False

    def find(self, ours: AbstractSet[int]) -> str:
        """Why this process must not be forked now; "" if it may.

        Args:
            ours: descriptors that were opened since and that the model does not know.
        """
        found = self._threads() or self._files(ours)
        if not found and not self._was_asked:
            found = self._processes() or self._memory()
        self._was_asked = True
        return found

    def readers(self, ours: AbstractSet[int]) -> list[Reader]:
        """The files that the model reads, for `reopen` in the copy."""
        readers = []
        for descriptor in _open_descriptors() - self._descriptors - ours:
            with suppress(OSError):  # the one of the listing itself, or a device
                if stat.S_ISREG(os.fstat(descriptor).st_mode):
                    readers.append((descriptor, os.lseek(descriptor, 0, os.SEEK_CUR)))
        return readers

    @staticmethod
    def _threads() -> str:
        threads = len(os.listdir(_TASKS)) - 1  # noqa: PTH208  names are all that is needed
        return f"the model runs {threads} more thread{'s' * (threads > 1)}" if threads else ""

    def _files(self, ours: AbstractSet[int]) -> str:
        for descriptor in sorted(_open_descriptors() - self._descriptors - ours):
            try:
                mode = os.fstat(descriptor).st_mode
                target = os.readlink(f"{_DESCRIPTORS}/{descriptor}")
                writes = fcntl(descriptor, F_GETFL) & os.O_ACCMODE != os.O_RDONLY
            except OSError:  # the one of the listing itself
                continue
            if target in _HARMLESS_DEVICES or stat.S_ISDIR(mode):
                continue
            if stat.S_ISSOCK(mode):
                return f"the model holds a socket ({target})"
            if not stat.S_ISREG(mode):
                return f"the model holds a device or a pipe ({target})"
            if writes:
                return f"the model writes to the file {target}"
        return ""

    @staticmethod
    def _processes() -> str:
        try:
            children = Path(f"{_TASKS}/{os.getpid()}/children").read_text(encoding="ascii").split()
        except OSError:  # this kernel does not tell
            return ""
        return f"the model started process {children[0]}" if children else ""

    def _memory(self) -> str:
        for area in sorted(_shared_memory() - self._shared_memory):
            return f"the model shares memory with other processes ({area})"
        return ""


def reopen(readers: list[Reader]) -> None:
    """In the copy: go on reading these files without moving the original's place in them."""
    for descriptor, place in readers:
        own = os.open(f"{_DESCRIPTORS}/{descriptor}", os.O_RDONLY)
        os.lseek(own, place, os.SEEK_SET)
        os.dup2(own, descriptor, inheritable=os.get_inheritable(descriptor))
        os.close(own)


def _open_descriptors() -> set[int]:
    return {int(name) for name in os.listdir(_DESCRIPTORS)}  # noqa: PTH208  as above


def _shared_memory() -> set[str]:
    """Names of the areas that are mapped as shared and can be written."""
    names = set()
    for line in Path(_MAPS).read_text(encoding="utf-8", errors="replace").splitlines():
        _, permissions, _, _, _, *name = line.split(maxsplit=5)
        if permissions.startswith("rw") and permissions.endswith("s"):
            names.add(name[0] if name else "anonymous")
    return names
