"""Models as both sides name them: by their contents."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from protocol.host.scratch import ScratchDirectory

DESCRIPTION = "modelDescription.xml"

FMU_ENTRIES = frozenset(
    {
        *(DESCRIPTION, "model.png", "binaries", "resources", "sources"),
        *("documentation", "licenses", "terminalsAndIcons", "extra"),
    }
)
"""Entries at the root of an FMU (FMI 2.0, section 2.3; FMI 3.0, section 2.5)."""

_FIRST_TIME = (1980, 1, 1, 0, 0, 0)
_UNIX = 3
_PERMISSIONS = 0o100644 << 16


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, in lower-case hexadecimal digits; raises `OSError`."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_fmu(model: str, base: Path) -> bool:
    """True if a model's name means an FMU: a file ``.fmu``, or the folder of one, unpacked.

    Args:
        model: as in a system file.
        base: directory to which it is relative.
    """
    return model.lower().endswith(".fmu") or (bool(model) and (base / model).is_dir())


class Contents(NamedTuple):
    """A model's file, or the archive that its folder is packed into.

    Attributes:
        sha256: in lower-case hexadecimal digits.
        size: [bytes].
    """

    sha256: str
    size: int

    @staticmethod
    def of(path: Path) -> Contents:
        """Read a file or a folder; raises `OSError`."""
        if not path.is_dir():
            return Contents(file_sha256(path), path.stat().st_size)
        digest, size = hashlib.sha256(), 0

        def write(data: bytes) -> None:
            nonlocal size
            digest.update(data)
            size += len(data)

        pack_folder(path, write)
        return Contents(digest.hexdigest(), size)


def pack_folder(folder: Path, write: Callable[[bytes], object]) -> None:
    """Write the folder of an FMU as an archive; equal folders give equal bytes, on every host.

    Args:
        folder: of the FMU; what has no place at the root of an FMU is left out.
        write: takes the bytes, piece by piece.

    Raises:
        OSError: a file cannot be read or written.
    """
    with zipfile.ZipFile(_Sink(write), "w") as archive:
        for name in sorted(entry_names(folder)):
            source = folder / name
            entry = zipfile.ZipInfo(name, _FIRST_TIME)
            entry.create_system, entry.external_attr = _UNIX, _PERMISSIONS
            entry.file_size = source.stat().st_size
            with source.open("rb") as opened, archive.open(entry, "w") as target:
                shutil.copyfileobj(opened, target)


@contextmanager
def as_file(path: Path) -> Iterator[Path]:
    """The file of a model: itself, or within the ``with`` the archive of a folder.

    Raises:
        OSError: the folder cannot be packed.
    """
    if not path.is_dir():
        yield path
        return
    with ScratchDirectory() as directory:
        packed = directory / f"{path.name}.fmu"
        with packed.open("wb") as file:
            pack_folder(path, file.write)
        yield packed


class _Sink(io.RawIOBase):
    """Sink that an archive is written to and that never goes back."""

    def __init__(self, write: Callable[[bytes], object]) -> None:
        self._write = write

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._write(data)
        return len(data)


def entry_names(folder: Path) -> Iterator[str]:
    """Names of the files in the folder of an FMU, with slashes.

    Raises:
        OSError: it cannot be read, or holds a link, which could lead to any file, as in an archive.
    """

    def fail(error: OSError) -> None:
        raise error

    for entry in FMU_ENTRIES:
        if (folder / entry).is_file():
            yield _no_link(folder, entry)
        elif (folder / entry).is_dir():
            _no_link(folder, entry)
            for parent, folders, files in os.walk(folder / entry, onerror=fail):
                relative = Path(parent).relative_to(folder)
                for name in folders:
                    _no_link(folder, (relative / name).as_posix())
                yield from (_no_link(folder, (relative / name).as_posix()) for name in files)


def _no_link(folder: Path, name: str) -> str:
    if (folder / name).is_symlink():
        raise OSError(errno.ELOOP, f"{name} is a symbolic link")
    return name
