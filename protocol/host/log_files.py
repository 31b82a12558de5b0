"""Where a slave's log goes, and log files of a bounded size to which several processes write."""

from __future__ import annotations

import logging
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from protocol.host.logs import LogFormat
from protocol.host.new_files import open_new, own_folder

NOWHERE = ""
STANDARD_ERROR = "-"


class LogOutput(NamedTuple):
    """Where the messages of an FMU go.

    Attributes:
        file: that gets them; `STANDARD_ERROR`, or `NOWHERE`.
        style: of its lines.
        categories: patterns of the FMU's log categories that it is asked for; empty: those of
            warnings and errors.
        warnings: file that gets a line for each warning, for another process to read
            (`slave_node/states/warnings_file.py`); "": this process counts them.
    """

    file: str = NOWHERE
    style: LogFormat = LogFormat.TEXT
    categories: tuple[str, ...] = ()
    warnings: str = ""


SILENT = LogOutput()

MOST_BYTES = 8 * 2**20
"""A log file that is larger becomes ``FILE.1``, in place of the one before [bytes]."""

_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)


def append(file: str | Path, line: str) -> None:
    """Append a line to a file, which is made if it is not there, and leave it closed.

    Raises:
        OSError: it cannot be written, or is a link.
    """
    descriptor = os.open(file, os.O_RDWR | os.O_APPEND | os.O_CREAT | _NO_LINK, 0o666)
    try:
        if os.fstat(descriptor).st_size > MOST_BYTES:
            _move_content(Path(file), descriptor)
        os.write(descriptor, f"{line}\n".encode(errors="replace"))
    finally:
        os.close(descriptor)


def _move_content(file: Path, descriptor: int) -> None:
    """Move it to ``FILE.1``: the file stays the same one, as other processes have it open."""
    with file.open("rb") as content, open_new(file.with_name(f"{file.name}.1")) as kept:
        shutil.copyfileobj(content, kept)
    os.ftruncate(descriptor, 0)


class LogFileHandler(logging.Handler):
    """Appends messages to a file, which is open only meanwhile: a model can be forked with it.

    A file that cannot be written loses messages, and ends nothing.

    Args:
        path: of the file; its folder is made with the first message.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler`."""
        with suppress(OSError):
            own_folder(self._path.parent)
            append(self._path, self.format(record))
