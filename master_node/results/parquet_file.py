"""``results.parquet``: written from a stream when the run has ended."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from master_node.results.arrow_file import BROKEN, Stream, columns_of, table_of
from master_node.results.columns import Table
from master_node.results.files import cannot_read, cannot_write, check_growth, malformed, replacing
from protocol.errors import ResultsError

_CELLS = 1_000_000
"""Numbers in a row group, which is what is held in memory."""


def write_parquet(path: Path, source: Path) -> None:
    """Write all rows of the stream ``source``, in row groups that do not depend on its batches.

    Raises:
        ResultsError: the stream cannot be read or the file cannot be written; an old file is as
            it was.
    """
    with Stream(source) as stream:
        rows = max(1, _CELLS // len(stream.schema))
        texts = [f.name for f in stream.schema if not pa.types.is_floating(f.type)]
        try:
            with (
                replacing(path) as file,
                # a dictionary of floats would not tell -0.0 from 0.0
                pq.ParquetWriter(file, stream.schema, use_dictionary=texts) as writer,
            ):
                for group in _groups(stream, rows):
                    writer.write_table(group, row_group_size=rows)
        except OSError as error:
            raise cannot_write(path, error) from error
        except pa.ArrowException as error:
            raise ResultsError(f"cannot write {path}: {error}") from error


def read_parquet(path: Path) -> Table:
    """All rows of a file.

    Raises:
        ResultsError: it cannot be read or is malformed.
    """
    try:
        with path.open("rb") as raw, pq.ParquetFile(raw) as file:
            columns = columns_of(file.schema_arrow, path)
            check_growth(path, file.metadata.num_rows * file.metadata.num_columns)
            table = file.read()
            table.validate(full=True)
            return table_of(path, table, columns)
    except OSError as error:
        raise cannot_read(path, error) from error
    except BROKEN as error:
        raise malformed(path, str(error)) from error


def _groups(stream: Stream, rows: int) -> Iterator[pa.Table]:
    held: list[pa.RecordBatch] = []
    count = 0
    for batch in stream.batches():
        held.append(batch)
        count += batch.num_rows
        while count >= rows:
            table = pa.Table.from_batches(held, stream.schema)
            yield table.slice(0, rows)
            held = table.slice(rows).to_batches()
            count -= rows
    if held:
        yield pa.Table.from_batches(held, stream.schema)
