"""``results.csv``: a line for each point, written with the shortest texts that read back the same.

Outputs and discrete variables of type float are written with ``repr``, integers in digits,
booleans as ``true`` and ``false``, strings between quotation marks, binary values in base64.
"""

from __future__ import annotations

import csv
from array import array
from base64 import b64decode, b64encode
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from master_node.observing.observers import DiscreteType, Point
from master_node.results.columns import NOTHING_KNOWN, Columns, Known, Table
from master_node.results.files import LineFile, cannot_read, malformed, one_field


class CsvFile(LineFile):
    """The file while a run goes on.

    Args:
        path: of the file.
        columns: of the run.
        rows: how many rows of it count; None: it is a new one.
    """

    def __init__(self, path: Path, columns: Columns, rows: int | None = None) -> None:
        names = map(one_field, columns.names + columns.discrete_names)
        super().__init__(path, ",".join(("time", *names)) + "\n", rows)
        self._texts = [_WRITE[type_] for type_ in columns.discrete_types]

    def append(self, point: Point) -> None:
        """Hold one row back for the next ``flush``."""
        fields = list(map(repr, [float(point.time), *point.outputs.tolist()]))
        if self._texts:
            values = zip(self._texts, point.discrete, strict=True)
            fields += [text(value) for text, value in values]
        self._add(",".join(fields) + "\n")


def read_csv(path: Path, known: Known = NOTHING_KNOWN, *, complete_lines: bool = True) -> Table:
    """The rows of a file.

    Args:
        path: of the file, ``time`` in its first column.
        known: units and types, which no CSV file tells; a column that is not named there holds
            numbers.
        complete_lines: leave out a last line that does not end.

    Raises:
        ResultsError: it cannot be read or is malformed; names the line.
    """
    try:
        with opened(path) as file, _long_fields():
            lines = finished(file) if complete_lines else iter(file)
            header = csv.reader(lines)
            names = next(header, [])
            if not names or names[0].strip().casefold() != "time":
                raise malformed(path, "the first column must be time", 1)
            if len(set(names)) != len(names):
                raise malformed(path, "two columns have the same name", 1)
            columns = known.columns(names[1:])
            if columns.discrete_names:
                return _read_typed(path, lines, header.line_num, names, columns)
            return Table.of_rows(columns, _read_numbers(path, lines, header.line_num, names), ())
    except csv.Error as error:
        raise malformed(path, str(error), header.line_num) from error
    except OSError as error:
        raise cannot_read(path, error) from error


def opened(path: Path) -> IO[str]:
    """For reading; broken bytes become broken fields, whose line can be named."""
    return path.open(encoding="utf-8-sig", errors="replace", newline="")


def finished(lines: Iterable[str]) -> Iterator[str]:
    """Those with their line end: a writer that was killed may leave half a line."""
    return (line for line in lines if line.endswith(("\n", "\r")))


def _read_numbers(path: Path, lines: Iterator[str], above: int, names: list[str]) -> array[float]:
    rows = array("d")
    for number, line in enumerate(lines, above + 1):
        try:
            row = [float(field) for field in line.split(",")]
        except ValueError:
            if not line.strip():
                continue
            what = f"expected {len(names)} numbers, found {line.strip()[:80]!r}"
            raise malformed(path, what, number) from None
        if len(row) != len(names):
            raise malformed(path, f"expected {len(names)} numbers, found {len(row)}", number)
        rows.extend(row)
    return rows


def _read_typed(
    path: Path, lines: Iterator[str], above: int, names: list[str], columns: Columns
) -> Table:
    types = [columns.types.get(name, "float") for name in names]
    values: list[Any] = [array("d") if type_ == "float" else [] for type_ in types]
    reader = csv.reader(lines, strict=True)
    while True:
        try:
            row = next(reader, None)
        except csv.Error as error:
            if next(lines, None) is None:  # within the quotation marks of the last line
                break
            raise malformed(path, str(error), above + reader.line_num) from error
        if row is None:
            break
        if not row:
            continue
        if len(row) != len(names):
            what = f"expected {len(names)} fields, found {len(row)}"
            raise malformed(path, what, above + reader.line_num)
        for name, type_, field, column in zip(names, types, row, values, strict=True):
            try:
                column.append(_READ[type_](field))
            except (ValueError, KeyError):
                what = f"{name} is of type {type_}, found {field[:80]!r}"
                raise malformed(path, what, above + reader.line_num) from None
    column_of = dict(zip(names, values, strict=True))
    rows = [column_of[name] for name in (names[0], *columns.names)]
    discrete = [column_of[name] for name in columns.discrete_names]
    return Table.of_rows(columns, np.column_stack(rows), discrete)


@contextmanager
def _long_fields() -> Iterator[None]:
    """Without the limit of 128 KiB, which texts and binary values may pass."""
    limit = csv.field_size_limit(2**31 - 1)
    try:
        yield
    finally:
        csv.field_size_limit(limit)


def _integer(text: str) -> int:
    value = int(text)
    if not -(2**63) <= value < 2**63:
        raise ValueError(text)
    return value


_WRITE: Mapping[DiscreteType, Callable[[Any], str]] = {
    "float": lambda value: repr(float(value)),
    "integer": lambda value: str(int(value)),
    "boolean": lambda value: "true" if value else "false",
    "string": lambda value: '"' + value.replace('"', '""') + '"',
    "binary": lambda value: b64encode(value).decode(),
}
_READ: Mapping[DiscreteType, Callable[[str], Any]] = {
    "float": float,
    "integer": _integer,
    "boolean": {"true": True, "false": False}.__getitem__,
    "string": str,
    "binary": lambda text: b64decode(text, validate=True),
}
