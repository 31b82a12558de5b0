"""Results written while the run goes on, and turned into other formats when it has ended."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from time import monotonic

from master_node.observing.observers import Attempt, Point, Points, RunEnd, RunStart
from master_node.results.columns import Columns
from master_node.results.completion import (
    complete,
    convert,
    failed,
)
from master_node.results.files import (
    CHECKPOINT_FOLDER,
    PLOT_FILE,
    START_FILE,
    STEPS_FILE,
    STREAM_FILE,
    SUMMARY_FILE,
    ResultsFile,
    cannot_write,
)
from master_node.results.formats import FILES, MADE_AT_THE_END, growing_files, is_made_at_the_end
from master_node.results.steps_file import StepsFile
from master_node.results.summary import (
    about_columns,
    formats_of,
    plain_mapping,
    settings_sha256,
    summarize,
    write_json,
)
from protocol.errors import ResultsError
from protocol.host.new_files import remove_folder

FLUSH_INTERVAL = 0.5
"""Shortest time between two writes [s]: what a killed master loses at most of a fast run."""

_OF_THE_END = (SUMMARY_FILE, *MADE_AT_THE_END, PLOT_FILE)


class ResultsWriter:
    """An observer that streams a run into a directory, with constant memory.

    Rows are held back for ``FLUSH_INTERVAL`` and then written whole with one write per file, so
    whoever kills the master leaves readable files. When a write fails, the file is cut back to
    the last batch that is complete. Parquet and MAT are made from the stream at the end.

    Args:
        directory: see the package's docstring for the files in it.
        settings: what the run was asked for; goes into the summary. ``settings["simulation"]``
            names ``estimator`` and ``order``, ``settings["results"]`` the ``formats``, by default
            ``csv``.
        resumed: how many rows of results and of steps in the directory count, where a run is
            resumed; None: a new run.
        can_resume: whether a run that does not get to its end may be resumed: files of which the
            results would be made then stay.
    """

    def __init__(
        self,
        directory: Path,
        settings: Mapping[str, object],
        resumed: tuple[int, int] | None = None,
        *,
        can_resume: bool = False,
    ) -> None:
        self._directory = directory
        self._settings = plain_mapping(settings)
        self._formats = formats_of(self._settings)
        self._start: RunStart | None = None
        self._results: list[ResultsFile] = []
        self._steps: StepsFile | None = None
        self._next_flush = 0.0
        self._broken = False
        self._resumed = resumed
        self._can_resume = can_resume
        self._points, self._attempts = resumed or (0, 0)

    @property
    def rows(self) -> tuple[int, int]:
        """Number of rows of results, and of steps, that were told so far."""
        return self._points, self._attempts

    def synchronize(self) -> None:
        """Bring what was told to the disk.

        Raises:
            ResultsError: a file cannot be written.
        """
        self._flush()
        self._each(lambda file: file.synchronize())

    def prepare(self) -> None:
        """Create the directory and try whether it can be written; old results stay for now.

        Raises:
            ResultsError: it cannot, or a file is in its place.
        """
        path = self._directory
        try:
            path.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path):
                pass
            for path in map(self._directory.joinpath, FILES):
                if path.is_dir():
                    raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        except OSError as error:
            raise cannot_write(path, error) from error

    def started(self, start: RunStart) -> None:
        """Replace old results by new files with the row of T_0, or go on where a run stood.

        Raises:
            ResultsError: a file cannot be written.
        """
        self.prepare()
        columns = Columns.of(start)
        try:
            self._open_files(columns)
            if self._resumed is None:
                self._append((Point(start.start_time, start.outputs, start.discrete),))
            self._flush()
            about = about_columns(columns, self._settings)
            write_json(self._directory / START_FILE, plain_mapping(about))
        except ResultsError:
            with suppress(ResultsError):
                self._close()
            raise
        self._start = start

    def attempted(self, attempt: Attempt) -> None:
        """Note the attempt and the points it reached.

        Raises:
            ResultsError: a file cannot be written; what it held before stays readable.
        """
        if self._steps is not None:
            self._steps.append(attempt)
        self._attempts += 1
        self._append(attempt.points)
        if monotonic() >= self._next_flush:
            self._flush()

    def cut(self, points: int, attempts: int) -> None:
        """Keep only so many rows of results and of steps.

        Raises:
            ResultsError: a file cannot be written.
        """
        if self._start is None or (points, attempts) == self.rows:
            return
        self._flush()
        self._close()
        self._resumed = self._points, self._attempts = points, attempts
        self._open_files(Columns.of(self._start))

    def ended(self, end: RunEnd) -> None:
        """Write what is left, the formats that are made at the end, and the summary.

        Raises:
            ResultsError: a file cannot be written, and that was not raised before.
        """
        if self._start is None:
            return
        told = self._broken
        summary = summarize(self._start, end, self._settings)
        self._append(end.points)
        errors = _errors_of(self._flush, self._close)
        if end.outcome.is_complete and not errors:
            complete(self._directory, summary)
            return
        if end.outcome.is_complete:
            summary = failed(summary, errors[0])
        errors += _errors_of(self._convert, lambda: self._write_summary(summary))
        if errors and not told:
            raise errors[0]

    def _open_files(self, columns: Columns) -> None:
        path = self._directory
        points, attempts = self._resumed or (None, None)
        try:
            if self._resumed is None:
                self._remove_old()
            hash_ = settings_sha256(self._settings)
            for path, open_file in growing_files(self._directory, self._formats):
                self._results.append(open_file(path, columns, hash_, points))
            path = self._directory / STEPS_FILE
            self._steps = StepsFile(path, columns.names, attempts)
            if self._resumed is not None:
                for path in map(self._directory.joinpath, _OF_THE_END):
                    path.unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(path, error) from error

    def _remove_old(self) -> None:
        """All of an earlier run; first where it stood, as that means nothing without the rest."""
        remove_folder(self._directory / CHECKPOINT_FOLDER)
        for name in FILES:
            path = self._directory / name
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise cannot_write(path, error) from error

    def _append(self, points: Points) -> None:
        self._points += len(points)
        for file in self._results:
            for point in points:
                file.append(point)

    def _flush(self) -> None:
        self._each(lambda file: file.flush())
        self._next_flush = monotonic() + FLUSH_INTERVAL

    def _close(self) -> None:
        try:
            self._each(lambda file: file.close())
        finally:
            self._results, self._steps = [], None

    def _each(self, action: Callable[[ResultsFile | StepsFile], None]) -> None:
        errors: list[ResultsError] = []
        for file in (*self._results, self._steps):
            if file is None:
                continue
            try:
                action(file)
            except OSError as error:
                errors.append(cannot_write(file.path, error))
            except ResultsError as error:
                errors.append(error)
        if errors:
            self._broken = True
            raise errors[0]

    def _convert(self) -> None:
        """Parquet and MAT of a run that did not get to its end; where one fails, the stream stays
        in their place.
        """
        if not is_made_at_the_end(self._formats):
            return
        convert(self._directory, self._settings)
        if not self._can_resume:
            with suppress(OSError):
                (self._directory / STREAM_FILE).unlink(missing_ok=True)

    def _write_summary(self, summary: Mapping[str, object]) -> None:
        write_json(self._directory / SUMMARY_FILE, summary)
        with suppress(OSError):
            (self._directory / START_FILE).unlink(missing_ok=True)


def _errors_of(*actions: Callable[[], None]) -> list[ResultsError]:
    """Errors of actions, which are all tried: the disk may have room for one of them only."""
    errors = []
    for action in actions:
        try:
            action()
        except ResultsError as error:
            errors.append(error)
    return errors
