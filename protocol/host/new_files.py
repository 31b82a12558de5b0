"""Files that are written into directories of which somebody else may have made a part.

A link that waits there under a name of ours would lead what is written to any file of the user's.
So a new file takes the place of what is there, and an old one is opened only if it is no link.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
from pathlib import Path
from typing import BinaryIO

_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


def open_new(path: Path, *, buffering: int = -1) -> BinaryIO:
    """A new file, in the place of a file or link of that name; raises `OSError`."""
    path.unlink(missing_ok=True)
    return path.open("xb", buffering=buffering)


def open_old(path: Path, *, to_append: bool = False, buffering: int = -1) -> BinaryIO:
    """A file that is there, for reading and writing; ``to_append``: for writing behind its end.

    Raises:
        OSError: it is not there, cannot be written, or is a link or no file.
    """
    flags = os.O_WRONLY | os.O_APPEND if to_append else os.O_RDWR
    descriptor = os.open(path, flags | _NO_LINK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is no file", str(path))
    return os.fdopen(descriptor, "ab" if to_append else "r+b", buffering)


def own_folder(path: Path) -> Path:
    """``path`` itself, made if it is not there.

    Raises:
        OSError: it cannot be made, or is a link.
    """
    if path.is_symlink():
        raise OSError(errno.ELOOP, "it is a link, which is not followed", str(path))
    path.mkdir(parents=True, exist_ok=True)
    return path


def remove_folder(path: Path) -> None:
    """Remove a folder with all that is in it, or the link in its place; what resists stays."""
    try:
        path.unlink()
    except OSError:
        shutil.rmtree(path, ignore_errors=True)
