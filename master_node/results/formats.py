"""Formats of results by the names that users give them. A new format is a file and a row here.

pyarrow and scipy.io take a tenth of a second to import, so the functions of a format import them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from master_node.results.columns import Columns, Known, Table
from master_node.results.csv_file import CsvFile, read_csv
from master_node.results.files import (
    END_FILE,
    PLOT_FILE,
    START_FILE,
    STEPS_FILE,
    STREAM_FILE,
    SUMMARY_FILE,
    UNFINISHED,
    ResultsFile,
)

Opener: TypeAlias = Callable[[Path, Columns, str, int | None], ResultsFile]
"""Path, columns, hash of the settings, number of rows that count or None for a new file."""

Converter: TypeAlias = Callable[[Path, Path, Mapping[str, Any]], None]
"""Path of the new file, path of the stream with all rows, settings of the run."""


@dataclass(frozen=True, kw_only=True)
class ResultFormat:
    """Format of results. It is written while the run goes on, or made of a stream at its end.

    Attributes:
        file_name: name of its file in a results directory.
        read: table in a file, with what is known of units and types; True: the file may be one
            that a run still writes, so an unfinished end is left out. Raises `ResultsError`.
        open: file that grows while a run goes on; None: ``convert`` makes it at the end.
        convert: maker of the file from a stream; None: it is written while the run goes on.
        holds_texts: False where strings and binary values are left out.
    """

    file_name: str
    read: Callable[[Path, Known, bool], Table]
    open: Opener | None = None
    convert: Converter | None = None
    holds_texts: bool = True


def _open_csv(path: Path, columns: Columns, _settings_sha256: str, rows: int | None) -> ResultsFile:
    return CsvFile(path, columns, rows)


def _read_csv(path: Path, known: Known, is_growing: bool) -> Table:
    return read_csv(path, known, complete_lines=is_growing)


def _open_arrow(
    path: Path, columns: Columns, settings_sha256: str, rows: int | None
) -> ResultsFile:
    from master_node.results.arrow_file import ArrowFile  # noqa: PLC0415

    return ArrowFile(path, columns, settings_sha256, rows)


def _read_arrow(path: Path, _known: Known, _is_growing: bool) -> Table:
    from master_node.results.arrow_file import read_arrow  # noqa: PLC0415

    return read_arrow(path)


def _make_parquet(path: Path, stream: Path, _settings: Mapping[str, Any]) -> None:
    from master_node.results.parquet_file import write_parquet  # noqa: PLC0415

    write_parquet(path, stream)


def _read_parquet(path: Path, _known: Known, _is_growing: bool) -> Table:
    from master_node.results.parquet_file import read_parquet  # noqa: PLC0415

    return read_parquet(path)


def _make_mat(path: Path, stream: Path, settings: Mapping[str, Any]) -> None:
    from master_node.results.dymola_mat import constants_of, write_mat  # noqa: PLC0415

    write_mat(path, stream, constants_of(settings))


def _read_mat(path: Path, known: Known, _is_growing: bool) -> Table:
    from master_node.results.dymola_mat import read_mat  # noqa: PLC0415

    return read_mat(path, known)


FORMATS: Mapping[str, ResultFormat] = {
    "csv": ResultFormat(file_name="results.csv", read=_read_csv, open=_open_csv),
    "arrow": ResultFormat(file_name="results.arrow", read=_read_arrow, open=_open_arrow),
    "parquet": ResultFormat(file_name="results.parquet", read=_read_parquet, convert=_make_parquet),
    "mat": ResultFormat(
        file_name="results.mat", read=_read_mat, convert=_make_mat, holds_texts=False
    ),
}
"""Formats by name. Of several in a directory the first is read."""

MADE_AT_THE_END = tuple(f.file_name for f in FORMATS.values() if f.convert is not None)
_OWN_FILES = tuple(f.file_name for f in FORMATS.values())

FILES = (
    END_FILE,  # first, as it needs the others
    SUMMARY_FILE,
    *_OWN_FILES,
    STEPS_FILE,
    PLOT_FILE,
    START_FILE,
    STREAM_FILE,
    *map(UNFINISHED.format, (*_OWN_FILES, STREAM_FILE, SUMMARY_FILE, START_FILE, END_FILE)),
)
"""Files that a run may leave and the next one in the same directory replaces."""


def is_made_at_the_end(formats: Iterable[str]) -> bool:
    """True where one of ``formats`` is made of a stream when the run has ended."""
    return any(FORMATS[name].convert is not None for name in formats)


def stream_of(directory: Path, formats: Iterable[str]) -> Path:
    """Path of the Arrow stream that other formats are made from."""
    return directory / (FORMATS["arrow"].file_name if "arrow" in formats else STREAM_FILE)


def growing_files(directory: Path, formats: Iterable[str]) -> list[tuple[Path, Opener]]:
    """Files to be written while a run goes on, each with the function that opens it."""
    formats = tuple(formats)
    grown = {
        directory / FORMATS[name].file_name: opener
        for name in formats
        if (opener := FORMATS[name].open) is not None
    }
    if is_made_at_the_end(formats):
        grown[stream_of(directory, formats)] = _open_arrow
    return list(grown.items())


def read_results(directory: Path, known: Known) -> Table:
    """Table of the best results file in a directory: one that holds texts comes first.

    Raises:
        ResultsError: there is none, or it is malformed.
    """
    whole = [f for f in FORMATS.values() if f.holds_texts]
    lossy = [f for f in FORMATS.values() if not f.holds_texts]
    stream = (STREAM_FILE, _read_arrow)
    candidates = [(f.file_name, f.read) for f in whole] + [stream]
    candidates += [(f.file_name, f.read) for f in lossy]
    name, read = next((one for one in candidates if (directory / one[0]).is_file()), candidates[0])
    return read(directory / name, known, True)


def read_results_file(path: Path, known: Known) -> Table:
    """Table of a single file, read by its suffix, and as CSV where no format has that suffix.

    Raises:
        ResultsError: it cannot be read or is malformed.
    """
    suffix = path.suffix.lower()
    found = (f for f in FORMATS.values() if Path(f.file_name).suffix == suffix)
    return next(found, FORMATS["csv"]).read(path, known, False)
