"""Tables in text files as people have them: their separator, comments, decimal sign and units.

The first line names the columns. It is found in a comment too, as NumPy's ``savetxt`` writes it.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.errors import ConfigurationError

SUFFIXES = (".csv", ".txt", ".tsv", ".dat")
_SEPARATORS = (";", "\t", ",")
_COMMENTS = ("#", "%")
_QUOTED = re.compile(r'"(?:[^"]|"")*"')
_EXPONENT = r"(?:[eE][+-]?\d+)?"
_COMMA_NUMBER = re.compile(rf"[+-]?(?:\d+,\d*|,\d+){_EXPONENT}")
_POINT_NUMBER = re.compile(rf"[+-]?(?:\d+\.\d*|\.\d+){_EXPONENT}")
_NO_UNIT = frozenset({"", "-", "1", "none"})


class TextTable(NamedTuple):
    """A table as it stands in a file.

    Attributes:
        columns: texts by the name of the column, in order; numbers with a decimal point.
        units: of the columns, by name; "" for one without.
    """

    columns: Mapping[str, NDArray[Any]]
    units: Mapping[str, str]


def read_text_table(path: Path) -> TextTable:
    """Read a table.

    Columns stand apart by semicolons, tabs or commas, or else by spaces. Lines that begin with
    ``#`` or ``%`` are comments. A row below the names whose first cell is no number has units.
    Decimal commas are read where columns do not stand apart by commas.

    Raises:
        ConfigurationError: it is no such table; names the file and the row.
        OSError: it cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        header, lines = _lines(text)
        if header is None:
            raise ConfigurationError(f"{path.name}: is empty")
        separator = _separator(header, lines)
        names = [name.strip() for name in _split([header], separator)[0]]
        rows = _split(lines, separator)
    except (csv.Error, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path.name}: not a CSV file: {error}") from error
    if all(map(is_number, names)):
        raise ConfigurationError(f"{path.name}: the first line must name the columns")
    if len(set(names)) < len(names):
        raise ConfigurationError(f"{path.name}: two columns of one name in {', '.join(names)}")
    units = dict.fromkeys(names, "")
    if rows and len(rows[0]) == len(names) and not _is_any_number(rows[0][0]):
        units = dict(zip(names, map(_unit, rows.pop(0)), strict=True))
    for number, row in enumerate(rows, 1):
        if len(row) != len(names):
            raise ConfigurationError(
                f"{path.name}: row {number} has {len(row)} values for {len(names)} columns"
            )
    texts = np.array(rows, dtype=np.str_).reshape(-1, len(names))
    columns = dict(zip(names, texts.T, strict=True))
    if separator != ",":
        columns = _with_decimal_points(path.name, columns)
    return TextTable(columns, units)


def is_number(text: str) -> bool:
    """True if a text is a number with a decimal point, as Python reads it."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _lines(text: str) -> tuple[str | None, list[str]]:
    """The line with the names of the columns, and those below it; comments are left out."""
    comment: str | None = None
    lines: list[str] = []
    for line in text.splitlines():
        if line.lstrip().startswith(_COMMENTS):
            comment = line.lstrip().lstrip("".join(_COMMENTS)).strip() if not lines else comment
        elif line.strip():
            lines.append(line)
    if not lines:
        return None, []
    separator = _separator(lines[0], lines[1:])
    first = _split(lines[:1], separator)[0]
    if comment and all(map(_is_any_number, first)):
        names = _split([comment], _separator(comment, lines))[0]
        if len(names) == len(first):
            return comment, lines
    return lines[0], lines[1:]


def _separator(header: str, lines: Sequence[str]) -> str:
    """Separator of the columns; " " for any number of spaces."""
    first = next(iter(lines), header)
    counts = [[_QUOTED.sub("", line).count(s) for line in (header, first)] for s in _SEPARATORS]
    for separator, (in_header, in_first) in zip(_SEPARATORS, counts, strict=True):
        if in_header and in_header == in_first:
            return separator
    return next((s for s, (number, _) in zip(_SEPARATORS, counts, strict=True) if number), " ")


def _split(lines: Sequence[str], separator: str) -> list[list[str]]:
    if separator == " ":
        rows = csv.reader((" ".join(line.split()) for line in lines), delimiter=" ", strict=True)
    else:
        rows = csv.reader(lines, delimiter=separator, strict=True)
    return list(rows)


def _is_any_number(text: str) -> bool:
    """True if a text is a number with a decimal point or a decimal comma."""
    return is_number(text) or _COMMA_NUMBER.fullmatch(text.strip()) is not None


def _unit(text: str) -> str:
    unit = text.strip()
    if len(unit) > 1 and (unit[0], unit[-1]) in (("[", "]"), ("(", ")")):
        unit = unit[1:-1].strip()
    return "" if unit in _NO_UNIT else unit


def _with_decimal_points(file: str, columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The columns of numbers with decimal points for commas.

    Raises:
        ConfigurationError: a column has both.
    """
    found = {}
    for name, column in columns.items():
        texts = [text.strip() for text in column.tolist()]
        commas = [_COMMA_NUMBER.fullmatch(text) is not None for text in texts]
        if not any(commas) or not all(map(_is_any_number, texts)):
            found[name] = column
            continue
        for number, text in enumerate(texts, 1):
            if _POINT_NUMBER.fullmatch(text):
                raise ConfigurationError(
                    f"{file}: row {number}: {name} = {text!r}: other numbers of this column have a "
                    "decimal comma",
                    remedy="write all of them in the same way",
                )
        found[name] = np.array([text.replace(",", ".") for text in texts], dtype=np.str_)
    return found
