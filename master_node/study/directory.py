"""The directory of a study: one sub-directory for each run, one table, one lock.

::

    STUDY/study.csv              the table of results
    STUDY/study.lock             held by the sweep that is working here; holds its token
    STUDY/runs/0001/             a run that has ended: its results, case.toml, run.log, run.json
    STUDY/runs/0001.part-TOKEN/  a run that is under way

A run is put in its place when it has ended, in one move: what is in ``0001`` is whole.
"""

from __future__ import annotations

import errno
import re
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from secrets import token_hex
from types import TracebackType
from typing import BinaryIO, Self

from master_node.study.plan import Plan, PlannedRun
from master_node.study.records import RECORD_FILE, RunRecord, read_record
from protocol.errors import ResultsError
from protocol.host.new_files import open_old, own_folder

TABLE_FILE = "study.csv"
LOCK_FILE = "study.lock"
_RUNS = "runs"
_RUN_NAME = re.compile(r"\d{4,6}")
_PART_NAME = re.compile(r"\d{4,6}\.(part|old)-[0-9a-f]{8}")


class StudyDirectory:
    """Held by one sweep at a time, as a context manager.

    Args:
        path: is made where it is missing.

    Raises:
        ResultsError: from ``with``: it cannot be written, or another sweep works in it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self.runs = self.path / _RUNS
        self.token = token_hex(8)
        self._lock: BinaryIO | None = None

    def __enter__(self) -> Self:
        try:
            own_folder(self.runs)
            self._lock = _opened_lock(self.path / LOCK_FILE)
            _lock_alone(self._lock)
            self._write_token(self.token)
            for entry in self.runs.iterdir():
                if _PART_NAME.fullmatch(entry.name):
                    shutil.rmtree(entry, ignore_errors=True)
        except BlockingIOError:
            self._close()
            raise ResultsError(
                f"another sweep is working in {self.path}",
                remedy="wait for its end, or choose another --output",
            ) from None
        except OSError as error:
            self._close()
            raise ResultsError(
                f"cannot write {self.path}: {error.strerror or error}",
                remedy="choose an --output that you may write to",
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, _: TracebackType | None
    ) -> None:
        with suppress(OSError):
            self._write_token("")
        self._close()

    def _write_token(self, token: str) -> None:
        assert self._lock is not None
        self._lock.truncate(0)
        self._lock.seek(0)
        self._lock.write(token.encode("ascii"))

    def release_runs(self) -> None:
        """Let runs on other hosts that still work for this sweep end themselves."""
        with suppress(OSError):
            self._write_token("")

    def _close(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def directory_of(self, run: PlannedRun) -> Path:
        """Where the results of a run are once it has ended."""
        return self.runs / run_name(run.number)

    def records(self, plan: Plan, *, replace: bool) -> dict[int, RunRecord]:
        """The runs of a plan that have ended already, by their numbers.

        Args:
            plan: what is wanted.
            replace: remove runs that are of another study, instead of an error.

        Raises:
            ResultsError: there are runs of another study.
        """
        runs = {run_name(run.number): run for run in plan.runs}
        found = {}
        for entry in sorted(self.runs.iterdir()):
            if not _RUN_NAME.fullmatch(entry.name) or not entry.is_dir():
                continue
            record = read_record(entry)
            run = runs.get(entry.name)
            if record is not None and run is not None and record.fingerprint == run.fingerprint:
                found[run.number] = record
            elif replace:
                self._remove(entry)
            else:
                raise ResultsError(
                    f"{entry} is not a run of this study: the study, the system, a model or "
                    "Doublestep has changed since",
                    remedy="choose another --output, or say --replace to lose what is there",
                )
        return found

    def _remove(self, entry: Path) -> None:
        if not (entry / RECORD_FILE).is_file():
            raise ResultsError(f"{entry} is in the way and is not a run", remedy="move it away")
        shutil.rmtree(entry)


def run_name(number: int) -> str:
    """The name of a run's directory."""
    return f"{number:04d}"


def put_in_place(part: Path, directory: Path) -> None:
    """Move a run that has ended to where it belongs; one that was there before goes.

    Raises:
        OSError: it cannot be moved; ``part`` is left as it is.
    """
    old = directory.with_name(f"{directory.name}.old-{token_hex(4)}")
    with suppress(FileNotFoundError):
        directory.rename(old)
    part.rename(directory)
    shutil.rmtree(old, ignore_errors=True)


def is_wanted(path: Path, token: str) -> bool:
    """True if the sweep with this token still works in the directory of a study."""
    try:
        return (path / LOCK_FILE).read_text(encoding="ascii") == token
    except (OSError, UnicodeDecodeError):
        return False


def _opened_lock(path: Path) -> BinaryIO:
    with suppress(FileExistsError):
        path.open("xb").close()
    return open_old(path, buffering=0)


def _lock_alone(file: BinaryIO) -> None:
    """Raises BlockingIOError when another process holds it. Windows has no such lock."""
    if sys.platform != "win32":
        import fcntl  # noqa: PLC0415  not on Windows

        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # a file system without locks
                raise
