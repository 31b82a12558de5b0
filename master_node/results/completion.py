"""What is made of the rows of a run that has ended: Parquet, MAT, and the summary.

To make Parquet and MAT can take long. Until they are there ``.end.json`` holds the summary of a run
that got to its end, and all its rows are on the disk: `complete` needs nothing else, and can begin
anew at any time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from master_node.observing.observers import Outcome
from master_node.results.files import (
    ARROW_FILE,
    CHECKPOINT_FOLDER,
    END_FILE,
    MAT_FILE,
    PARQUET_FILE,
    START_FILE,
    STREAM_FILE,
    SUMMARY_FILE,
    synchronize_folder,
)
from master_node.results.summary import formats_of, read_json, write_json
from protocol.errors import InterruptedRunError, ResultsError


def stream_of(directory: Path, formats: Iterable[str]) -> Path:
    """The file that Parquet and MAT are made from."""
    return directory / (ARROW_FILE if "arrow" in formats else STREAM_FILE)


def is_made_at_the_end(settings: Mapping[str, Any]) -> bool:
    """Whether a format is asked for that is made from the stream."""
    return not {"parquet", "mat"}.isdisjoint(formats_of(settings))


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
        if is_made_at_the_end(summary["settings"]):
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
    """Whether the run in the directory got to its end, and nothing lacks in its results.

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
    makers: Mapping[str, Callable[[], None]] = {
        "parquet": lambda: _make_parquet(directory / PARQUET_FILE, stream),
        "mat": lambda: _make_mat(directory / MAT_FILE, stream, settings),
    }
    errors: list[ResultsError] = []
    for format_, make in makers.items():
        if format_ in formats:
            try:
                make()
            except ResultsError as error:
                errors.append(error)
    if errors:
        raise errors[0]


def failed(summary: Mapping[str, Any], error: ResultsError) -> dict[str, Any]:
    """The same summary of a run whose results cannot be completed now."""
    return {**summary, "outcome": str(Outcome.FAILED), "message": str(error)}


def _how_to_go_on(directory: Path) -> str:
    """The remedy for results that are not complete; "" where there is none."""
    files = (directory / name for name in (END_FILE, CHECKPOINT_FOLDER))
    return (
        f"`master-node resume {directory}` completes them"
        if any(file.exists() for file in files)
        else ""
    )


def _make_parquet(path: Path, stream: Path) -> None:
    # pyarrow takes a tenth of a second to import, which other runs need not pay
    from master_node.results.parquet_file import write_parquet  # noqa: PLC0415

    write_parquet(path, stream)


def _make_mat(path: Path, stream: Path, settings: Mapping[str, Any]) -> None:
    from master_node.results.dymola_mat import constants_of, write_mat  # noqa: PLC0415  as above

    write_mat(path, stream, constants_of(settings))


def _tidy(directory: Path) -> None:
    """What nothing is made from any more; ``.end.json`` first, as it needs the others."""
    for name in (END_FILE, STREAM_FILE, START_FILE):
        with suppress(OSError):
            (directory / name).unlink(missing_ok=True)
