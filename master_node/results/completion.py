"""Completion of the results of a run that has ended: Parquet, MAT, and the summary.

To make Parquet and MAT can take long. Until they are there ``.end.json`` holds the summary of a run
that got to its end, and all its rows are on the disk: `complete` needs nothing else, and can begin
anew at any time.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from master_node.observing.observers import Outcome
from master_node.results.files import (
    CHECKPOINT_FOLDER,
    END_FILE,
    START_FILE,
    STREAM_FILE,
    SUMMARY_FILE,
    synchronize_folder,
)
from master_node.results.formats import FORMATS, is_made_at_the_end, stream_of
from master_node.results.summary import formats_of, read_json, write_json
from protocol.errors import InterruptedRunError, ResultsError


def complete(directory: Path, summary: Mapping[str, Any]) -> None:
    """Complete the results of a run that got to its end, and say so on the disk.

    Args:
        directory: holds all rows of the run, on the disk.
        summary: of the run.

    Raises:
        ResultsError: a file cannot be written; the rows stay, and ``summary.json`` says that the
            run failed. `finish` tries again.
        InterruptedRunError: Ctrl-C; the rows stay, and `finish` goes on.
    """
    try:
        if is_made_at_the_end(formats_of(summary["settings"])):
            write_json(directory / END_FILE, summary)
            synchronize_folder(directory)
            convert(directory, summary["settings"])
        write_json(directory / SUMMARY_FILE, summary)
        synchronize_folder(directory)
    except KeyboardInterrupt:
        raise InterruptedRunError(
            "interrupted while the results were completed; all rows are there",
            remedy=_how_to_go_on(directory),
        ) from None
    except ResultsError as error:
        error.remedy = "; then ".join(filter(None, (error.remedy, _how_to_go_on(directory))))
        with suppress(ResultsError):
            write_json(directory / SUMMARY_FILE, failed(summary, error))
        raise
    _tidy(directory)


def finish(directory: Path) -> bool:
    """Complete the results of a run that got to its end and no further.

    Returns:
        Whether there are such.

    Raises:
        ResultsError, InterruptedRunError: as `complete`.
    """
    summary = read_json(directory / END_FILE)
    if summary:
        complete(directory, summary)
    return bool(summary)


def is_complete(directory: Path) -> bool:
    """True if the run in the directory got to its end, and nothing lacks in its results.

    Raises:
        ResultsError: the summary is malformed.
    """
    outcome = read_json(directory / SUMMARY_FILE).get("outcome")
    return outcome in [str(o) for o in Outcome if o.is_complete]


def convert(directory: Path, settings: Mapping[str, Any]) -> None:
    """Make the formats that are made at the end, each that can be made.

    Raises:
        ResultsError: one of them cannot.
    """
    formats = formats_of(settings)
    stream = stream_of(directory, formats)
    errors: list[ResultsError] = []
    for name, result_format in FORMATS.items():
        if name in formats and result_format.convert is not None:
            try:
                result_format.convert(directory / result_format.file_name, stream, settings)
            except ResultsError as error:
                errors.append(error)
    if errors:
        raise errors[0]


def failed(summary: Mapping[str, Any], error: ResultsError) -> dict[str, Any]:
    """Summary changed to that of a run whose results cannot be completed now."""
    return {**summary, "outcome": str(Outcome.FAILED), "message": str(error)}


def _how_to_go_on(directory: Path) -> str:
    """The remedy for results that are not complete; "" where there is none."""
    files = (directory / name for name in (END_FILE, CHECKPOINT_FOLDER))
    return (
        f"`master-node resume {directory}` completes them"
        if any(file.exists() for file in files)
        else ""
    )


def _tidy(directory: Path) -> None:
    """Remove files that are no longer needed; ``.end.json`` first, as it needs the others."""
    for name in (END_FILE, STREAM_FILE, START_FILE):
        with suppress(OSError):
            (directory / name).unlink(missing_ok=True)
