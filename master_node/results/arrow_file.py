"""``results.arrow``: an Arrow IPC stream that grows by record batches.

Each batch is a message of its own, so a writer that is killed leaves all batches that were
flushed. Fields carry ``unit`` and ``variability`` (continuous or discrete) as metadata, the schema
the version and the hash of the settings.
"""

from __future__ import annotations

import json
import os
from array import array
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa

from master_node.observing.observers import DiscreteType, DiscreteValue, Point
from master_node.results.columns import DTYPES, Columns, Table
from master_node.results.files import BatchFile, cannot_read, malformed, replacing
from protocol.errors import ResultsError

_TYPES: Mapping[DiscreteType, pa.DataType] = {
    "float": pa.float64(),
    "integer": pa.int64(),
    "boolean": pa.bool_(),
    "string": pa.string(),
    "binary": pa.binary(),
}
BROKEN = (pa.ArrowException, OSError, UnicodeDecodeError)
"""Exceptions of Arrow for bytes that it cannot read."""

_END = b"\xff\xff\xff\xff\x00\x00\x00\x00"
"""A continuation mark and no metadata: the end of a stream (Arrow columnar format, IPC)."""


class ArrowFile(BatchFile):
    """The file while a run goes on.

    Args:
        path: of the file.
        columns: of the run.
        settings_sha256: of the run.
        rows: how many rows of it count; None: it is a new one.

    Raises:
        ResultsError: the file cannot be read, is of another run, or has fewer rows.
    """

    def __init__(
        self, path: Path, columns: Columns, settings_sha256: str, rows: int | None = None
    ) -> None:
        self._types = columns.discrete_types
        self._schema = _schema(columns, settings_sha256)
        head: bytes = self._schema.serialize().to_pybytes()
        super().__init__(path, None if rows is None else _cut(path, self._schema, head, rows))
        self._head = head if rows is None else b""
        self._rows = array("d")
        self._discrete: list[tuple[DiscreteValue, ...]] = []

    def append(self, point: Point) -> None:
        """Hold one row back for the next ``flush``."""
        self._rows.append(point.time)
        self._rows.extend(point.outputs.tolist())
        if self._types:
            self._discrete.append(point.discrete)

    def close(self) -> None:
        """End the stream and bring it to the disk."""
        try:
            if self._size:
                self._write(_END)
        finally:
            super().close()

    def _batch(self) -> bytes:
        if not self._rows:
            return self._head
        width = len(self._schema) - len(self._types)
        numbers = np.ascontiguousarray(np.array(self._rows).reshape(-1, width).T)
        columns = [pa.array(column) for column in numbers]
        by_column = zip(*self._discrete, strict=True) if self._types else ()
        for type_, name, values in zip(
            self._types, self._schema.names[width:], by_column, strict=True
        ):
            columns.append(self._discrete_column(name, type_, values))
        batch = pa.record_batch(columns, schema=self._schema)
        return self._head + bytes(batch.serialize().to_pybytes())

    def _written(self) -> None:
        self._head = b""
        del self._rows[:]
        self._discrete.clear()

    def _discrete_column(
        self, name: str, type_: DiscreteType, values: tuple[DiscreteValue, ...]
    ) -> pa.Array:
        plain: list[Any] = list(values)
        if type_ == "string":  # surrogates have no bytes
            plain = [str(value).encode(errors="replace").decode() for value in values]
        try:
            return pa.array(plain, _TYPES[type_])
        except (pa.ArrowException, OverflowError) as error:
            raise ResultsError(
                f"cannot write {self.path}: {name} is of type {type_}: {error}"
            ) from error


class Stream:
    """A stream that is read batch by batch. A context manager.

    Args:
        path: of the file. Where it has no end, a last batch that is not whole is left out.

    Attributes:
        schema: of every batch.
        columns: the same in our words.

    Raises:
        ResultsError: it cannot be read, or is no stream of results.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._has_end = _ends(path)
            self._file = pa.memory_map(str(path))
        except OSError as error:
            raise cannot_read(path, error) from error
        try:
            self._reader = pa.ipc.open_stream(self._file)
            self.schema: pa.Schema = self._reader.schema
            self.columns = columns_of(self.schema, path)
        except BROKEN as error:
            self._file.close()
            raise malformed(path, str(error)) from error
        except ResultsError:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()
        self._file.close()

    def batches(self) -> Iterator[pa.RecordBatch]:
        """All of them, once.

        Raises:
            ResultsError: one of them is malformed.
        """
        while True:
            try:
                batch = self._reader.read_next_batch()
                batch.validate(full=True)
            except StopIteration:
                return
            except BROKEN as error:
                if not self._has_end:
                    return
                raise malformed(self._path, str(error)) from error
            yield batch


def read_arrow(path: Path) -> Table:
    """All rows of a stream.

    Raises:
        ResultsError: it cannot be read or is malformed.
    """
    with Stream(path) as stream:
        return table_of(
            path, pa.Table.from_batches(list(stream.batches()), stream.schema), stream.columns
        )


def _cut(path: Path, schema: pa.Schema, head: bytes, rows: int) -> int:
    """Leave the first ``rows`` rows in a stream that has no end then; its size [bytes]."""
    left = rows
    with Stream(path) as stream, replacing(path) as file:
        if not stream.schema.equals(schema):
            raise malformed(path, "its columns are not those of the run")
        file.write(head)
        for batch in stream.batches():
            if not left:
                break
            part = batch.slice(0, left)
            file.write(part.serialize().to_pybytes())
            left -= part.num_rows
        if left:
            found = rows - left
            raise malformed(path, f"{found} rows instead of {rows}, which the checkpoint names")
        return file.tell()


def columns_of(schema: pa.Schema, path: Path) -> Columns:
    """Columns that a schema describes.

    Floats are outputs unless they are said to be discrete; everything else is discrete.

    Raises:
        ResultsError: time is not the first column, two have the same name, or one holds what is
            no result.
    """
    fields = [schema.field(i) for i in range(len(schema))]
    names = [field.name for field in fields]
    if not names or names[0].strip().casefold() != "time":
        raise malformed(path, "the first column must be time")
    if len(set(names)) != len(names):
        raise malformed(path, "two columns have the same name")
    types = [_type_of(field, path) for field in fields]
    if types[0] not in ("float", "integer"):
        raise malformed(path, "time must be a number")
    outputs: dict[str, str] = {}
    discrete: dict[str, tuple[str, DiscreteType]] = {}
    for field, type_ in zip(fields[1:], types[1:], strict=True):
        unit = _told(field, b"unit")
        if type_ == "float" and _told(field, b"variability") != "discrete":
            outputs[field.name] = unit
        else:
            discrete[field.name] = (unit, type_)
    return Columns(
        tuple(outputs),
        tuple(outputs.values()),
        tuple(discrete),
        tuple(unit for unit, _ in discrete.values()),
        tuple(type_ for _, type_ in discrete.values()),
        {field.name: items for field in schema if (items := _items(field))},
    )


def table_of(path: Path, table: pa.Table, columns: Columns) -> Table:
    """An Arrow table as arrays of their own; a number that is missing is NaN.

    Raises:
        ResultsError: another value is missing, or an integer needs more than 64 bits.
    """
    outputs = np.empty((table.num_rows, len(columns.names)), order="F")
    for j, name in enumerate(columns.names):
        outputs[:, j] = _floats(table.column(name))
    discrete = []
    for name, type_ in columns.types.items():
        column = table.column(name)
        if column.null_count and type_ != "float":
            raise malformed(path, f"{name}: a value of type {type_} is missing")
        try:
            values = column.cast(_TYPES[type_]).to_numpy()
        except pa.ArrowException as error:
            raise malformed(path, f"{name}: {error}") from error
        discrete.append(np.array(values, DTYPES[type_]))
    time = _floats(table.column(0)).copy()
    return Table(columns, time, outputs, tuple(discrete))


def _floats(column: pa.ChunkedArray) -> np.ndarray[Any, np.dtype[np.float64]]:
    values: np.ndarray[Any, np.dtype[np.float64]] = column.cast(pa.float64(), safe=False).to_numpy()
    return values


def _schema(columns: Columns, settings_sha256: str) -> pa.Schema:
    fields = [pa.field("time", pa.float64(), nullable=False, metadata={"unit": "s"})]
    for name, unit in zip(columns.names, columns.units, strict=True):
        about = {"unit": unit, "variability": "continuous"}
        fields.append(pa.field(name, pa.float64(), nullable=False, metadata=about))
    for name, unit, type_ in zip(
        columns.discrete_names, columns.discrete_units, columns.discrete_types, strict=True
    ):
        about = {"unit": unit, "variability": "discrete"}
        if name in columns.items:
            about["items"] = json.dumps(columns.items[name])
        fields.append(pa.field(name, _TYPES[type_], nullable=False, metadata=about))
    about = {"doublestep": _version(), "settings_sha256": settings_sha256}
    return pa.schema(fields, metadata=about)


def _version() -> str:
    try:
        return version("doublestep")
    except PackageNotFoundError:  # run from its sources
        return ""


def _told(field: pa.Field, key: bytes) -> str:
    about: Mapping[bytes, bytes] = field.metadata or {}
    return about.get(key, b"").decode(errors="replace")


def _items(field: pa.Field) -> dict[str, int]:
    """Numbers of an enumeration's items by their names; empty for other types."""
    try:
        items = json.loads(_told(field, b"items") or "{}")
    except ValueError:
        return {}
    known = isinstance(items, dict) and all(type(number) is int for number in items.values())
    return items if known else {}


def _type_of(field: pa.Field, path: Path) -> DiscreteType:
    kind = field.type
    if pa.types.is_floating(kind):
        return "float"
    if pa.types.is_integer(kind):
        return "integer"
    if pa.types.is_boolean(kind):
        return "boolean"
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return "string"
    if pa.types.is_binary(kind) or pa.types.is_large_binary(kind):
        return "binary"
    raise malformed(path, f"{field.name}: values of type {kind} are no results")


def _ends(path: Path) -> bool:
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - len(_END)))
        return file.read() == _END
