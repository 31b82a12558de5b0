"""``results.mat``: MAT version 4 in the layout of Dymola, which Modelica tools and DyMat read.

Six matrices, all but ``Aclass`` transposed (``binTrans``): ``name`` and ``description`` with a
column of UTF-8 characters for each variable, ``dataInfo`` with the column [data set, row,
interpolation, extrapolation], ``data_1`` with the constants at the first and the last time,
``data_2`` with a column for each point. The time is the first row of both data sets.
OpenModelica User's Guide, "The MATv4 Result File Format".
"""

from __future__ import annotations

import math
import re
import struct
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.io import loadmat, savemat, whosmat

from master_node.results.arrow_file import Stream
from master_node.results.columns import DTYPES, NOTHING_KNOWN, Columns, Known, Table
from master_node.results.files import (
    cannot_read,
    cannot_write,
    check_growth,
    malformed,
    replacing,
)
from protocol.errors import ResultsError
from protocol.signals import FloatArray

_CLASS = ("Atrajectory", "1.1", "", "binTrans")
_TIME = "Simulation time [s]"
_NEITHER = 0  # linear interpolation; a constant is kept outside of the time range
_UNDEFINED = -1  # a variable is not defined outside of the time range
_LARGEST = 2**31 - 1  # columns of a matrix


def write_mat(path: Path, source: Path, constants: Mapping[str, float]) -> None:
    """Write the numbers of the stream ``source``, in two passes over its batches.

    Integers and booleans become floats; strings and binary values are left out.

    Args:
        path: of the new file.
        source: of the stream.
        constants: by name; one that has the name of a variable is left out.

    Raises:
        ResultsError: the stream cannot be read or the file cannot be written; an old file is as
            it was.
    """
    rows, first, last = _extent(source)
    if rows > _LARGEST:
        raise ResultsError(
            f"cannot write {path}: MAT version 4 holds {_LARGEST} points at most, there are {rows}",
            remedy="choose another format, or fewer points with [results] every",
        )
    with Stream(source) as stream:
        columns = stream.columns
        units = {name: columns.all_units[name] for name in _numeric(columns)}
        kept = {name: value for name, value in constants.items() if name not in units}
        try:
            with replacing(path) as file:
                _write_head(file, units, kept, (first, last))
                _write_header(file, "data_2", 1 + len(units), rows)
                for batch in stream.batches():
                    file.write(_block(batch, list(units)).tobytes())
        except OSError as error:
            raise cannot_write(path, error) from error


def read_mat(path: Path, known: Known = NOTHING_KNOWN) -> Table:
    """The variables of a file in this layout, ours or Dymola's; constants are left out.

    Args:
        path: of the file.
        known: types that the numbers had; units are in the file.

    Raises:
        ResultsError: it cannot be read or is malformed.
    """
    wanted = ["Aclass", "name", "description", "dataInfo", "data_2"]
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("error")
            check_growth(path, sum(math.prod(shape) for _, shape, _ in whosmat(file)))
            file.seek(0)
            matrices = loadmat(file, chars_as_strings=False, variable_names=wanted)
        names, descriptions, information, data = _normal(matrices)
        return _table(names, descriptions, information, data, known)
    except OSError as error:
        raise cannot_read(path, error) from error
    except ResultsError:
        raise
    except Exception as error:  # SciPy raises all kinds for bytes that it cannot read
        raise malformed(path, f"not a result in the layout of Dymola: {error}") from error


def constants_of(settings: Mapping[str, Any]) -> dict[str, float]:
    """The parameters that were given to the slaves, ``slave.parameter``; texts are left out."""
    slaves = settings.get("slaves") or {}
    return {
        f"{slave}.{name}": float(value)
        for slave, table in slaves.items()
        for name, value in (table.get("parameters") or {}).items()
        if isinstance(value, int | float)
    }


def _numeric(columns: Columns) -> list[str]:
    types = columns.types
    names = columns.names + columns.discrete_names
    return [name for name in names if types.get(name) not in ("string", "binary")]


def _extent(source: Path) -> tuple[int, float, float]:
    """Number of points, first and last time [s]; NaN where there is none."""
    rows, first, last = 0, float("nan"), float("nan")
    with Stream(source) as stream:
        for batch in stream.batches():
            time = batch.column(0)
            if not rows:
                first = time[0].as_py()
            rows, last = rows + len(time), time[-1].as_py()
    return rows, first, last


def _write_head(
    file: BinaryIO,
    units: Mapping[str, str],
    constants: Mapping[str, float],
    ends: tuple[float, float],
) -> None:
    """All matrices but the last."""
    names = ["time", *constants, *units]
    about = [_TIME, *("" for _ in constants), *(f"[{u}]" if u else "" for u in units.values())]
    information = [
        (0, 1, _NEITHER, _UNDEFINED),
        *((1, row, _NEITHER, _NEITHER) for row, _ in enumerate(constants, 2)),
        *((2, row, _NEITHER, _UNDEFINED) for row, _ in enumerate(units, 2)),
    ]
    values = [ends, *((value, value) for value in constants.values())]
    matrices = {
        "Aclass": _characters(_CLASS),
        "name": np.ascontiguousarray(_characters(names).T),
        "description": np.ascontiguousarray(_characters(about).T),
        "dataInfo": np.array(information, np.int32).T,
        "data_1": np.array(values, np.float64),
    }
    savemat(file, matrices, appendmat=False, format="4")


def _characters(texts: Sequence[str]) -> NDArray[np.bytes_]:
    """A row of bytes for each text, filled up with spaces."""
    lines = [text.encode(errors="replace").replace(b"\0", b" ") for text in texts]
    width = max(1, *map(len, lines))
    return np.frombuffer(b"".join(line.ljust(width) for line in lines), "S1").reshape(-1, width)


def _write_header(file: BinaryIO, name: str, rows: int, columns: int) -> None:
    """Header of a full matrix of doubles, whose numbers follow column by column.

    SciPy would want all of them at once.
    """
    kind = 0 if sys.byteorder == "little" else 1000
    text = name.encode() + b"\0"
    file.write(struct.pack("=5i", kind, rows, columns, 0, len(text)) + text)


def _block(batch: pa.RecordBatch, names: Sequence[str]) -> FloatArray:
    """Time and variables of a batch, shape (points, 1 + variables)."""
    columns = [batch.column(name).cast(pa.float64(), safe=False) for name in ("time", *names)]
    return np.column_stack([column.to_numpy(zero_copy_only=False) for column in columns])


def _normal(
    matrices: Mapping[str, NDArray[Any]],
) -> tuple[list[str], list[str], NDArray[np.int64], FloatArray]:
    """Names, descriptions, [data set, row] of each, and the second data set row by row."""
    class_ = list(_texts(matrices["Aclass"]))
    if class_[1] != "1.1" or class_[3] not in ("binTrans", "binNormal"):
        raise ValueError(f"Aclass is {class_}")
    name, about, information, data = (
        matrices[key] for key in ("name", "description", "dataInfo", "data_2")
    )
    if class_[3] == "binTrans":
        name, about, information = name.T, about.T, information.T
    else:
        data = data.T
    return (
        list(_texts(name)),
        list(_texts(about)),
        np.asarray(information, np.int64),
        np.asarray(data, np.float64),
    )


def _texts(characters: NDArray[np.str_]) -> Iterator[str]:
    for line in characters.tolist():
        text = "".join(line).rstrip(" \0")
        yield text.encode("latin-1").decode(errors="replace")


def _table(
    names: list[str],
    descriptions: list[str],
    information: NDArray[np.int64],
    data: FloatArray,
    known: Known,
) -> Table:
    if not names or names[0].casefold() != "time":
        raise ValueError("the first variable must be time")
    found: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for name, about, (data_set, row) in zip(
        names[1:], descriptions[1:], information[1:, :2].tolist(), strict=True
    ):
        if data_set != 2:
            continue
        if name in found:
            raise ValueError(f"{name} is there twice")
        if row == 0:
            raise ValueError(f"{name} has no row")
        found[name] = data[row - 1] if row > 0 else -data[-row - 1]
        units[name] = _unit(about)
    columns = Known(units, known.types).columns(list(found))
    outputs = np.empty((data.shape[1], len(columns.names)), order="F")
    for j, name in enumerate(columns.names):
        outputs[:, j] = found[name]
    discrete = (_typed(found[name], DTYPES[type_]) for name, type_ in columns.types.items())
    return Table(columns, data[0].copy(), outputs, tuple(discrete))


def _typed(values: FloatArray, dtype: np.dtype[Any]) -> NDArray[Any]:
    with np.errstate(invalid="ignore"):
        typed = values.astype(dtype)
    if not np.array_equal(typed, values, equal_nan=dtype.kind == "f"):
        raise ValueError(f"{values} are not of type {dtype}")
    return typed


def _unit(description: str) -> str:
    """Unit in the last brackets, without the unit for display and Dymola's marks."""
    found = re.search(r"\[([^\[\]]*)\]$", description.strip())
    return re.split(r"[|:]", found[1])[0].strip() if found else ""
