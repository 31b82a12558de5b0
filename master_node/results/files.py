"""The files of a results directory: their names, how they grow, and what is said of failures."""

from __future__ import annotations

import errno
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Protocol

from master_node.observing.observers import Point
from protocol.errors import ResultsError
from protocol.host.new_files import open_new, open_old

STEPS_FILE = "steps.csv"
SUMMARY_FILE = "summary.json"
PLOT_FILE = "results.png"

START_FILE = ".start.json"
"""The columns with their units and types, while there is no summary."""

STREAM_FILE = ".results.arrow"
"""Stands in for results.arrow while a run without it goes on that ends with Parquet or MAT."""

END_FILE = ".end.json"
"""The summary of a run that got to its end, while its results are not complete."""

CHECKPOINT_FOLDER = "checkpoint"
"""Where a run stood that can be resumed, see ``resuming/files.py``."""

UNFINISHED = "{}.part"
_MAX_GROWTH = 1000
_GROWTH_FREE_BYTES = 2**30

_REMEDIES = {
    errno.ENOSPC: "free space on that disk or choose a results directory on another one",
    errno.EDQUOT: "free space within your quota or choose a results directory elsewhere",
    errno.EEXIST: "a file is in the way; choose another name for the results directory",
    errno.ENOTDIR: "part of the path is a file; choose another results directory",
    errno.ELOOP: "a link is in the way, which is not followed: remove it",
}


class ResultsFile(Protocol):
    """A file that gets the points of a run while it goes on."""

    path: Path

    def append(self, point: Point) -> None:
        """Hold one point back for the next ``flush``."""
        ...

    def flush(self) -> None:
        """Write what is held back, or leave the file as it was; OSError."""
        ...

    def synchronize(self) -> None:
        """Make sure that what was written is on the disk; OSError."""
        ...

    def close(self) -> None:
        """Make sure that it is on the disk; OSError."""
        ...


class BatchFile(ABC):
    """A file that only ever grows by whole batches.

    Args:
        path: of the file.
        size: how many bytes of it count; None: it is a new one.
    """

    def __init__(self, path: Path, size: int | None = None) -> None:
        self.path = path
        self._file = path.open("xb", buffering=0) if size is None else open_old(path, buffering=0)
        self._size = size or 0
        if size is not None:
            self._file.truncate(size)

    @abstractmethod
    def _batch(self) -> bytes:
        """Bytes to be written next."""

    @abstractmethod
    def _written(self) -> None:
        """Forget the batch, which is in the file."""

    def flush(self) -> None:
        """Write the batch, or leave the file as it was; both can be repeated after an error."""
        self._write(self._batch())
        self._written()

    def synchronize(self) -> None:
        """To the disk; OSError."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """To the disk, and no more."""
        with self._file:
            os.fsync(self._file.fileno())

    def _write(self, batch: bytes) -> None:
        rest = memoryview(batch)
        try:
            self._file.seek(self._size)
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            with suppress(OSError):
                self._file.truncate(self._size)
            raise
        self._size += len(batch)


class LineFile(BatchFile):
    """Batches of lines.

    Args:
        path: of the file.
        head: the first line.
        rows: how many rows behind it count; None: the file is a new one.

    Raises:
        ResultsError: the file does not begin with ``head``, or has fewer rows.
    """

    def __init__(self, path: Path, head: str, rows: int | None = None) -> None:
        super().__init__(path, None if rows is None else _end_of(path, head, rows))
        self._lines = [] if rows is not None else [head]
        self._add = self._lines.append

    def _batch(self) -> bytes:
        return "".join(self._lines).encode(errors="replace")

    def _written(self) -> None:
        self._lines.clear()


def _end_of(path: Path, head: str, rows: int) -> int:
    """Where the last of ``rows`` rows ends [bytes]; lines within quotation marks go on."""
    with path.open("rb") as file:
        first = file.readline()
        if first != head.encode(errors="replace"):
            raise malformed(path, "its columns are not those of the run", 1)
        size, found, is_quoted = len(first), 0, False
        while found < rows:
            line = file.readline()
            if not line.endswith(b"\n"):
                raise malformed(path, f"{found} rows instead of {rows}, which the checkpoint names")
            size += len(line)
            is_quoted ^= bool(line.count(b'"') % 2)
            found += not is_quoted
    return size


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file beside ``path`` that takes its place when all went well, and else is removed.

    Raises:
        OSError: it cannot be written; ``path`` is as it was.
    """
    unfinished = path.with_name(UNFINISHED.format(path.name))
    try:
        with open_new(unfinished) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except BaseException:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise


def synchronize_folder(folder: Path) -> None:
    """Bring the names of its files to the disk: after a power failure they are there only then.

    Raises:
        ResultsError: the disk refuses.
    """
    if os.name != "posix":
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise cannot_write(folder, error) from error


def one_field(text: str) -> str:
    """One CSV field on one line."""
    text = text.replace("\r", " ").replace("\n", " ")
    return '"' + text.replace('"', '""') + '"' if "," in text or '"' in text else text


def cannot_write(path: Path, error: OSError) -> ResultsError:
    """For whoever has to write there."""
    return ResultsError(
        f"cannot write {path}: {error.strerror or error}",
        remedy=_REMEDIES.get(error.errno or 0, "choose a results directory that you may write to"),
    )


def cannot_read(path: Path, error: OSError) -> ResultsError:
    """For whoever has to read there; without a number it is a library's word for broken bytes."""
    if error.errno is None:
        return malformed(path, str(error))
    return ResultsError(
        f"cannot read {path}: {error.strerror or error}",
        remedy="name a results directory, or one of the files with results in it",
    )


def check_is_file(path: Path) -> None:
    """Refuse a device or a pipe under the name of a file, of which there may be no end.

    Raises:
        ResultsError: it is one.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise malformed(path, "it is no file")


def check_growth(path: Path, cells: int) -> None:
    """Refuse a file that becomes far more in memory than it is: results do not.

    Args:
        path: of a compressed file.
        cells: how many values it says that it holds.

    Raises:
        ResultsError: they would take more than 1 GiB and a thousand times the length of the file.
    """
    if 8 * cells > _GROWTH_FREE_BYTES + _MAX_GROWTH * path.stat().st_size:
        raise malformed(path, f"it says that it holds {cells} values, which it is too short for")


def malformed(path: Path, what: str, line: int | None = None) -> ResultsError:
    """A file that is there and makes no sense."""
    place = f"{path}, line {line}" if line else str(path)
    return ResultsError(f"{place}: {what}")
