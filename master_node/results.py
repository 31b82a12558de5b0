"""Results: written while the run goes on, recorded in memory, read back.

A results directory holds

* ``results.csv``: ``time``, then ``slave.variable`` in the order of the run; one row per
  communication point, T_0 first;
* ``steps.csv``: one row per attempted step, the fields of ``Attempt``;
* ``summary.json``: counters and settings, written last. Where it is missing the run did not get
  to its end; the other two are then complete up to the last flush.

Numbers are written with ``repr``, the shortest text that reads back to the same bits: equal
numbers give equal files, byte for byte.
"""

from __future__ import annotations

import csv
import difflib
import errno
import json
import os
import tempfile
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from master_node.observers import Attempt, RunEnd, RunStart
from protocol.errors import ResultsError
from protocol.signals import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULTS_FILE = "results.csv"
STEPS_FILE = "steps.csv"
SUMMARY_FILE = "summary.json"
PLOT_FILE = "results.png"
_UNFINISHED_SUMMARY_FILE = ".summary.json.part"
_FILES = (SUMMARY_FILE, RESULTS_FILE, STEPS_FILE, PLOT_FILE, _UNFINISHED_SUMMARY_FILE)

FLUSH_INTERVAL = 0.5
"""Shortest time between two writes [s]: what a killed master loses at most of a fast run."""

STEPS_DTYPE = np.dtype(
    [
        ("time", np.float64),
        ("step_size", np.float64),
        ("order", np.int64),
        ("derivative_points", np.int64),
        ("error_norm", np.float64),
        ("accepted", np.bool_),
        ("limiting_variable", np.object_),
    ]
)
"""``Result.steps`` and the columns of ``steps.csv``; ``limiting_variable`` holds str."""

_STEPS_COLUMNS = tuple(STEPS_DTYPE.names or ())

_REMEDIES = {
    errno.ENOSPC: "free space on that disk or choose a results directory on another one",
    errno.EDQUOT: "free space within your quota or choose a results directory elsewhere",
    errno.EEXIST: "a file is in the way; choose another name for the results directory",
    errno.ENOTDIR: "part of the path is a file; choose another results directory",
}


class ResultsWriter:
    """An observer that streams a run into a directory, with constant memory.

    Lines are held back for ``FLUSH_INTERVAL`` and then written whole with one write per file, so
    whoever kills the master leaves readable files. When a write fails, the file is cut back to
    the last batch that is complete.

    Args:
        directory: see the module's docstring for the files in it.
        settings: what the run was asked for; goes into the summary. ``settings["simulation"]``
            names ``estimator`` and ``order``.
    """

    def __init__(self, directory: Path, settings: Mapping[str, object]) -> None:
        self._directory = directory
        self._settings = _plain_mapping(settings)
        self._start: RunStart | None = None
        self._files: list[_LineFile] = []
        self._quoted: dict[str, str] = {}
        self._next_flush = 0.0
        self._broken = False

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
            for path in map(self._directory.joinpath, _FILES):
                if path.is_dir():
                    raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        except OSError as error:
            raise _cannot_write(path, error) from error

    def started(self, start: RunStart) -> None:
        """Replace old results by the headers and the row of T_0.

        Raises:
            ResultsError: a file cannot be written.
        """
        self.prepare()
        try:
            self._open_files()
            self._write_headers(start)
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
        results, steps = self._files
        name = attempt.limiting_variable
        steps.append(
            f"{float(attempt.time)!r},{float(attempt.step_size)!r},{attempt.order:d},"
            f"{attempt.derivative_points:d},"
            f"{float(attempt.error_norm)!r},{'true' if attempt.accepted else 'false'},"
            f"{self._quoted.get(name) or _quote(name)}\n"
        )
        for time, outputs in attempt.points:
            results.append(_row(time, outputs))
        if monotonic() >= self._next_flush:
            self._flush()

    def ended(self, end: RunEnd) -> None:
        """Write what is left and the summary.

        Raises:
            ResultsError: a file cannot be written and nobody was told so before.
        """
        if self._start is None:
            return
        told = self._broken
        errors: list[ResultsError] = []
        summary = summarize(self._start, end, self._settings)
        for finish in (self._flush, self._close, lambda: self._write_summary(summary)):
            try:
                finish()
            except ResultsError as error:  # each file gets its chance: the disk may have room
                errors.append(error)
        if errors and not told:
            raise errors[0]

    def _open_files(self) -> None:
        path = self._directory
        try:
            for path in map(self._directory.joinpath, _FILES):
                path.unlink(missing_ok=True)
            for path in (self._directory / RESULTS_FILE, self._directory / STEPS_FILE):
                self._files.append(_LineFile(path))
        except OSError as error:
            raise _cannot_write(path, error) from error

    def _write_headers(self, start: RunStart) -> None:
        self._quoted = {name: _quote(name) for name in start.output_names}
        results, steps = self._files
        results.append(",".join(("time", *self._quoted.values())) + "\n")
        results.append(_row(start.start_time, start.outputs))
        steps.append(",".join(_STEPS_COLUMNS) + "\n")
        self._flush()

    def _flush(self) -> None:
        self._each(_LineFile.flush)
        self._next_flush = monotonic() + FLUSH_INTERVAL

    def _close(self) -> None:
        try:
            self._each(_LineFile.close)
        finally:
            self._files = []

    def _each(self, action: Callable[[_LineFile], None]) -> None:
        errors: list[tuple[Path, OSError]] = []
        for file in self._files:
            try:
                action(file)
            except OSError as error:
                errors.append((file.path, error))
        if errors:
            self._broken = True
            raise _cannot_write(*errors[0]) from errors[0][1]

    def _write_summary(self, summary: Mapping[str, object]) -> None:
        unfinished = self._directory / _UNFINISHED_SUMMARY_FILE
        text = json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
        try:
            with unfinished.open("wb") as file:
                file.write(text.encode(errors="replace"))
                file.flush()
                os.fsync(file.fileno())
            unfinished.replace(self._directory / SUMMARY_FILE)
        except OSError as error:
            with suppress(OSError):
                unfinished.unlink(missing_ok=True)
            raise _cannot_write(self._directory / SUMMARY_FILE, error) from error


class Recording:
    """An observer that keeps the run in memory, for ``result()``.

    Args:
        settings: what the run was asked for, see ``ResultsWriter``.
    """

    def __init__(self, settings: Mapping[str, object] | None = None) -> None:
        self._settings = _plain_mapping(settings or {})
        self._start: RunStart | None = None
        self._end: RunEnd | None = None
        self._rows = array("d")  # time and outputs of one row after the other; grows amortised
        self._steps = _Steps()

    def started(self, start: RunStart) -> None:
        """Forget an earlier run and note the row of T_0."""
        self._start, self._end = start, None
        self._rows = array("d", [start.start_time, *start.outputs.tolist()])
        self._steps = _Steps()

    def attempted(self, attempt: Attempt) -> None:
        """Note the attempt and the points it reached."""
        self._steps.append(attempt)
        for time, outputs in attempt.points:
            self._rows.append(time)
            self._rows.extend(outputs.tolist())

    def ended(self, end: RunEnd) -> None:
        """Note how it went."""
        self._end = end

    def result(self) -> Result:
        """A copy of what is known by now; ``summary`` is empty as long as the run goes on.

        Raises:
            ResultsError: the run has not started.
        """
        start = self._start
        if start is None:
            raise ResultsError("nothing was recorded: the run did not start")
        return _result(
            start.output_names,
            start.output_units,
            self._rows,
            self._steps,
            {} if self._end is None else summarize(start, self._end, self._settings),
        )


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What a run gave. ``result["wheel.x"]`` is a variable over ``result.time``.

    Attributes:
        names: ``slave.variable`` of the m outputs.
        units: of each name, "" where none is known.
        time: the n communication points [s], shape (n,).
        outputs: row i is y at ``time[i]``, shape (n, m); column j belongs to ``names[j]``.
        steps: the attempts, accepted or not; structured array of ``STEPS_DTYPE``.
        summary: as in ``summary.json``; empty when the run did not get to its end.
    """

    names: tuple[str, ...]
    units: Mapping[str, str]
    time: FloatArray
    outputs: FloatArray
    steps: NDArray[np.void]
    summary: Mapping[str, Any]

    def __getitem__(self, name: str) -> FloatArray:
        if name == "time":
            return self.time
        try:
            return self.outputs[:, self._columns[name]]
        except KeyError:
            near = difflib.get_close_matches(name, self.names, n=3, cutoff=0.4)
            near = near or [full for full in self.names if full.endswith("." + name)][:3]
            hint = f"did you mean {' or '.join(near)}?" if near else "see result.names"
            raise KeyError(f"no variable {name}; {hint}") from None

    def __contains__(self, name: object) -> bool:
        return name == "time" or name in self._columns

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __repr__(self) -> str:
        rejected = int(np.count_nonzero(~self.steps["accepted"]))
        shown = [f"{name} [{unit}]" if unit else name for name, unit in self.units.items()]
        more = f", ... ({len(shown)} in all)" if len(shown) > 8 else ""
        span = f" from {self.time[0]:g} to {self.time[-1]:g} s" if len(self.time) else ""
        return (
            f"<Result {self.summary.get('outcome', 'without an end')}: "
            f"{len(self.time)} communication points{span}, "
            f"{len(self.steps)} attempts, {rejected} rejected\n"
            f"  {', '.join(shown[:8])}{more}>"
        )

    def _ipython_key_completions_(self) -> list[str]:
        return ["time", *self.names]

    @cached_property
    def _columns(self) -> dict[str, int]:
        return {name: column for column, name in enumerate(self.names)}

    def to_array(self) -> NDArray[np.void]:
        """All rows as a structured array, shape (n,): ``time`` first, then the names."""
        rows = np.empty(len(self.time), [(name, np.float64) for name in ("time", *self.names)])
        for name in ("time", *self.names):
            rows[name] = self[name]
        return rows

    def plot(
        self,
        path: Path | str | None = None,
        show: bool = False,
        variables: Sequence[str] | None = None,
    ) -> Figure:
        """Draw outputs, step sizes and error norms over time.

        Args:
            path: file to write, its suffix is the format; None writes none.
            show: open a window.
            variables: names to draw; None draws them all.

        Raises:
            KeyError: no such variable.
            ResultsError: the file cannot be written.
        """
        # matplotlib takes half a second to import, which a run without a plot need not pay
        from master_node.plots import plot_result  # noqa: PLC0415

        return plot_result(self, None if path is None else Path(path), show, variables)

    @classmethod
    def load(cls, source: Path | str) -> Result:
        """Read a results directory, or one CSV file with ``time`` in its first column.

        A directory may come from a run that goes on or was killed: an unfinished last line is
        left out, ``steps`` and ``summary`` are empty where their files are missing.

        Raises:
            ResultsError: there are no results, or a file is malformed; names file and line.
        """
        source = Path(source)
        if not source.is_dir():
            return _result(*_read_rows(source, complete_lines=False), _Steps(), {})
        summary = _read_summary(source / SUMMARY_FILE)
        names, units, rows = _read_rows(source / RESULTS_FILE)
        known = summary.get("units")
        if isinstance(known, dict):
            units = [str(known.get(name, "")) for name in names]
        return _result(names, units, rows, _read_steps(source / STEPS_FILE), summary)


def summarize(start: RunStart, end: RunEnd, settings: Mapping[str, object]) -> dict[str, Any]:
    """The summary of a run as plain data for JSON; a number that is not finite is None.

    ``state_kind``, ``do_steps``, ``rollbacks``, ``requests`` and ``compute_time`` [s] are maps by
    slave, ``controlled_by`` is one by the kind of control.
    """
    statistics = end.statistics
    simulation = settings.get("simulation")
    simulation = simulation if isinstance(simulation, Mapping) else {}
    slaves = statistics.slaves.items()
    return _plain_mapping(
        {
            "outcome": str(end.outcome),
            "message": end.message,
            "start_time": start.start_time,
            "stop_time": start.stop_time,
            "simulated_time": statistics.time - start.start_time,
            "estimator": simulation.get("estimator"),
            "order": simulation.get("order"),
            "communication_steps": statistics.communication_steps,
            "rejected_double_steps": statistics.rejected_double_steps,
            "discontinuities": statistics.discontinuities,
            "double_steps_at_discontinuities": statistics.double_steps_at_discontinuities,
            "steps_above_tolerance": statistics.steps_above_tolerance,
            "controlled_by": start.control._asdict(),
            "state_kind": start.state_kinds,
            "smallest_step_size": statistics.smallest_step_size,
            "largest_step_size": statistics.largest_step_size,
            "round_trips": statistics.round_trips,
            "wall_time": statistics.wall_time,
            "wait_time": statistics.wait_time,
            "do_steps": {name: slave.do_steps for name, slave in slaves},
            "rollbacks": {name: slave.rollbacks for name, slave in slaves},
            "requests": {name: slave.requests for name, slave in slaves},
            "compute_time": {name: slave.compute_time for name, slave in slaves},
            "units": dict(zip(start.output_names, start.output_units, strict=True)),
            "settings": settings,
        }
    )


class _LineFile:
    """A new file that only ever grows by whole batches of lines."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("xb", buffering=0)
        self._size = 0
        self._lines: list[str] = []
        self.append = self._lines.append

    def flush(self) -> None:
        """Write the batch, or leave the file as it was; both can be repeated after an error."""
        batch = "".join(self._lines).encode(errors="replace")
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
        self._lines.clear()

    def close(self) -> None:
        with self._file:
            os.fsync(self._file.fileno())


class _Steps:
    """Attempts in growing arrays; 48 bytes each, whatever the text."""

    def __init__(self) -> None:
        self._numbers = array("d")
        self._texts: list[str] = []
        self._known: dict[str, str] = {}

    def append(self, attempt: Attempt) -> None:
        a = attempt
        self._numbers.extend(
            (a.time, a.step_size, a.order, a.derivative_points, a.error_norm, a.accepted)
        )
        self._texts.append(self._known.setdefault(a.limiting_variable, a.limiting_variable))

    def to_array(self) -> NDArray[np.void]:
        numbers = np.array(self._numbers).reshape(-1, len(_STEPS_COLUMNS) - 1)
        steps = np.empty(len(numbers), STEPS_DTYPE)
        for column, name in enumerate(_STEPS_COLUMNS[:-1]):
            steps[name] = numbers[:, column]
        steps[_STEPS_COLUMNS[-1]] = self._texts
        return steps


def _result(
    names: Sequence[str],
    units: Sequence[str],
    rows: array[float],
    steps: _Steps,
    summary: Mapping[str, Any],
) -> Result:
    table = np.array(rows).reshape(-1, 1 + len(names))
    return Result(
        names=tuple(names),
        units=dict(zip(names, units, strict=True)),
        time=table[:, 0].copy(),
        outputs=np.asfortranarray(table[:, 1:]),  # columns are what users take
        steps=steps.to_array(),
        summary=summary,
    )


def _row(time: float, outputs: FloatArray) -> str:
    return ",".join(map(repr, [float(time), *outputs.tolist()])) + "\n"


def _quote(text: str) -> str:
    """One CSV field on one line."""
    text = text.replace("\r", " ").replace("\n", " ")
    return '"' + text.replace('"', '""') + '"' if "," in text or '"' in text else text


def _plain(value: object) -> object:
    """The value as JSON knows it; a snapshot, so later changes do not reach the summary."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return _plain_mapping(value)
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    return str(value)


def _plain_mapping(mapping: Mapping[Any, object]) -> dict[str, Any]:
    return {str(key): _plain(value) for key, value in mapping.items()}


def _cannot_write(path: Path, error: OSError) -> ResultsError:
    return ResultsError(
        f"cannot write {path}: {error.strerror or error}",
        remedy=_REMEDIES.get(error.errno or 0, "choose a results directory that you may write to"),
    )


def _cannot_read(path: Path, error: OSError) -> ResultsError:
    return ResultsError(
        f"cannot read {path}: {error.strerror or error}",
        remedy=f"name a results directory with a {RESULTS_FILE}, or a CSV file",
    )


def _malformed(path: Path, line: int, what: str) -> ResultsError:
    return ResultsError(f"{path}, line {line}: {what}")


def _open(path: Path) -> IO[str]:
    # broken bytes become broken fields, whose line can be named
    return path.open(encoding="utf-8-sig", errors="replace", newline="")


def _finished(lines: Iterable[str]) -> Iterator[str]:
    return (line for line in lines if line.endswith("\n"))


def _read_rows(
    path: Path, *, complete_lines: bool = True
) -> tuple[list[str], list[str], array[float]]:
    """Names, empty units and the numbers of all rows, time first in each."""
    rows = array("d")
    try:
        with _open(path) as file:
            lines = _finished(file) if complete_lines else iter(file)
            header = csv.reader(lines)
            names = next(header, [])
            if not names or names[0].strip().casefold() != "time":
                raise _malformed(path, 1, "the first column must be time")
            if len(set(names)) != len(names):
                raise _malformed(path, 1, "two columns have the same name")
            for number, line in enumerate(lines, header.line_num + 1):
                try:
                    row = [float(field) for field in line.split(",")]
                except ValueError:
                    if not line.strip():
                        continue
                    what = f"expected {len(names)} numbers, found {line.strip()[:80]!r}"
                    raise _malformed(path, number, what) from None
                if len(row) != len(names):
                    what = f"expected {len(names)} numbers, found {len(row)}"
                    raise _malformed(path, number, what)
                rows.extend(row)
    except OSError as error:
        raise _cannot_read(path, error) from error
    return names[1:], [""] * (len(names) - 1), rows


def _read_steps(path: Path) -> _Steps:
    steps = _Steps()
    flags = {"true": True, "false": False}
    try:
        with _open(path) as file:
            reader = csv.reader(_finished(file))
            if next(reader, list(_STEPS_COLUMNS)) != list(_STEPS_COLUMNS):
                raise _malformed(path, 1, f"the columns must be {','.join(_STEPS_COLUMNS)}")
            for row in reader:
                try:
                    time, step_size, order, points, error_norm, accepted, text = row
                    attempt = Attempt(
                        float(time),
                        float(step_size),
                        int(order),
                        int(points),
                        float(error_norm),
                        flags[accepted],
                        text,
                    )
                except (ValueError, KeyError):
                    what = f"expected an attempted step, found {','.join(row)[:80]!r}"
                    raise _malformed(path, reader.line_num, what) from None
                steps.append(attempt)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise _cannot_read(path, error) from error
    return steps


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        summary = json.loads(path.read_text(encoding="utf-8", errors="replace"))
    except FileNotFoundError:
        return {}
    except json.JSONDecodeError as error:
        raise _malformed(path, error.lineno, error.msg) from error
    except OSError as error:
        raise _cannot_read(path, error) from error
    if not isinstance(summary, dict):
        raise _malformed(path, 1, "expected a JSON object")
    return summary
