"""Hindrances to forking: what a copy of a process would not have, or would share.

A fork copies memory and one thread. Other threads are missing in the copy; sockets, devices and
files that are written are the same ones in both, and so is memory that is mapped as shared.
Files that are only read are no hindrance: the copy opens them again, where they stand.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Set as AbstractSet
from fcntl import F_GETFL, fcntl
from pathlib import Path

from protocol.errors import SlaveError
from protocol.host.descriptors import is_open

_TASKS = "/proc/self/task"
_DESCRIPTORS = "/proc/self/fd"
_MAPS = "/proc/self/maps"
_HARMLESS_DEVICES = frozenset({"/dev/null", "/dev/zero", "/dev/random", "/dev/urandom"})

Reader = tuple[int, int]
"""A descriptor that is read, and where its file stands."""


class ForkHindrances:
    """Compares what the process has now with what it had before its model was loaded."""

    def __init__(self) -> None:
        self._descriptors = {d for d in _open_descriptors() if is_open(d)}
        self._shared_memory = _shared_memory()
        self._was_checked = False

    def check(self, ours: AbstractSet[int]) -> list[Reader]:
        """True if this process may be forked now.

        Args:
            ours: descriptors that were opened since and that the model does not know.

        Returns:
            The files that the model reads, for `reopen` in the copy.

        Raises:
            SlaveError: it must not be, with what the model has.
        """
        threads = len(os.listdir(_TASKS)) - 1  # noqa: PTH208  names are all that is needed
        if threads:
            raise SlaveError(f"the model runs {threads} more thread{'s' * (threads > 1)}")
        opened = _open_descriptors() - self._descriptors - ours
        readers = [reader for reader in map(_reader, sorted(opened)) if reader is not None]
        if not self._was_checked:  # what is costly to find out, and hardly comes later
            self._check_processes()
            self._check_memory()
            self._was_checked = True
        return readers

    @staticmethod
    def _check_processes() -> None:
        try:
            children = Path(f"{_TASKS}/{os.getpid()}/children").read_text(encoding="ascii").split()
        except OSError:  # this kernel does not tell
            return
        if children:
            raise SlaveError(f"the model started process {children[0]}")

    def _check_memory(self) -> None:
        for area in sorted(_shared_memory() - self._shared_memory):
            raise SlaveError(f"the model shares memory with other processes ({area})")


def _reader(descriptor: int) -> Reader | None:
    """The file behind a descriptor if it is read; None if it does not matter.

    Raises:
        SlaveError: the file is written, or is none.
    """
    try:
        mode = os.fstat(descriptor).st_mode
        target = str(Path(f"{_DESCRIPTORS}/{descriptor}").readlink())
        flags = fcntl(descriptor, F_GETFL)
    except OSError:  # the one of the listing itself
        return None
    if target in _HARMLESS_DEVICES or stat.S_ISDIR(mode):
        return None
    if stat.S_ISSOCK(mode):
        raise SlaveError(f"the model holds a socket ({target})")
    if not stat.S_ISREG(mode):
        raise SlaveError(f"the model holds a device or a pipe ({target})")
    if flags & os.O_ACCMODE != os.O_RDONLY:
        raise SlaveError(f"the model writes to the file {target}")
    return descriptor, os.lseek(descriptor, 0, os.SEEK_CUR)


def reopen(readers: list[Reader]) -> None:
    """In the copy: go on reading these files without moving the original's place in them."""
    for descriptor, place in readers:
        own = os.open(f"{_DESCRIPTORS}/{descriptor}", os.O_RDONLY)
        os.lseek(own, place, os.SEEK_SET)
        os.dup2(own, descriptor, inheritable=os.get_inheritable(descriptor))
        os.close(own)


def _open_descriptors() -> set[int]:
    """All, and the one that the listing itself needed."""
    return {int(name) for name in os.listdir(_DESCRIPTORS)}  # noqa: PTH208  as above


def _shared_memory() -> set[str]:
    """Names of the areas that are mapped as shared and can be written."""
    names = set()
    for line in Path(_MAPS).read_text(encoding="utf-8", errors="replace").splitlines():
        _, permissions, _, _, _, *name = line.split(maxsplit=5)
        if permissions.startswith("rw") and permissions.endswith("s"):
            names.add(name[0] if name else "anonymous")
    return names
