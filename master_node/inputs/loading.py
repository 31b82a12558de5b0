"""From ``[inputs]`` to signals: constants, tables from files, functions by their names.

Nothing is started before all of this is read and checked.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from master_node.inputs.continuous import SignalFunction
from master_node.inputs.discrete import HoldRows
from master_node.inputs.text_tables import SUFFIXES, TextTable, is_number, read_text_table
from master_node.numerics.input_tables import InputTableError, Table, make_table
from master_node.system.system import System
from master_node.system.tables import InputRows, InputSettings
from protocol.errors import ConfigurationError
from protocol.host.user_code import load_module, user_context
from protocol.signals import FloatArray
from protocol.text.names import nearest
from protocol.text.references import split_reference
from protocol.variables import StartValue

_READ = {*SUFFIXES, ".npy", ".npz"}
_TIME_UNITS = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0}


def load_signals(system: System) -> dict[str, StartValue | Table | HoldRows | SignalFunction]:
    """Signals that drive the inputs in ``[inputs]``, by ``slave.variable``.

    Loading a function runs the code of its module. Files are read once, whatever the number of
    columns that are used.

    Raises:
        ConfigurationError: with the system's source and the input.
    """
    files: dict[Path, TextTable] = {}
    signals: dict[str, StartValue | Table | HoldRows | SignalFunction] = {}
    for name, setting in system.inputs.items():
        try:
            if not isinstance(setting, InputSettings):
                signals[name] = setting
            elif setting.table is not None:
                signals[name] = _table(setting, setting.table, system, files)
            else:
                signals[name] = _function(setting, system)
        except (ConfigurationError, InputTableError) as error:
            remedy = getattr(error, "remedy", "")
            raise ConfigurationError(
                f"{system.source}: [inputs.{name}] {error.args[0]}", remedy=remedy
            ) from error.__cause__
    return signals


# ---- Tables -------------------------------------------------------------------------------------


def _table(
    setting: InputSettings, table: str | InputRows, system: System, files: dict[Path, TextTable]
) -> Table | HoldRows:
    if isinstance(table, InputRows):
        times, values, place, name, unit = table.times, table.values, "", "value", ""
    else:
        place = f"{Path(table).name}: "
        times, values, name, unit = _rows(setting, system.base / table, files)
    holds = setting.interpolation == "hold"
    numbers = None if holds and not _are_numbers(values) else _numbers(place, name, values)
    span = (float(system.simulation.start_time), system.simulation.end)
    made = make_table(
        times,
        np.zeros(len(times)) if numbers is None else numbers,
        setting.interpolation,
        span,
        extrapolates=setting.extrapolate is not None,
        unit=unit,
    )
    return HoldRows(times, values, None if numbers is None else made, unit) if holds else made


def _are_numbers(column: NDArray[Any]) -> bool:
    if column.dtype.kind == "U":
        return all(map(is_number, column.tolist()))
    return column.dtype.kind != "b"


def _numbers(place: str, name: str, column: NDArray[Any]) -> FloatArray:
    """A column as numbers.

    Raises:
        ConfigurationError: a text is none, or these are truth values.
    """
    remedy = 'a table of a discrete input has interpolation = "hold"'
    if column.dtype.kind == "b":
        raise ConfigurationError(f"{place}{name} is no column of numbers", remedy=remedy)
    if column.dtype.kind == "U":
        for row, text in enumerate(column.tolist(), 1):
            if not is_number(text):
                raise ConfigurationError(
                    f"{place}row {row}: {name} = {text!r} is not a number", remedy=remedy
                )
    return column.astype(float)


def _rows(
    setting: InputSettings, path: Path, files: dict[Path, TextTable]
) -> tuple[FloatArray, NDArray[Any], str, str]:
    """Times, values, the name of their column, and their unit."""
    if path not in files:
        files[path] = _read(path)
    columns, units = files[path]
    names = list(columns)
    time = setting.time if setting.time is not None else names[0]
    others = [name for name in names if name != time]
    column = setting.column
    if column is None:
        if len(others) != 1:
            raise ConfigurationError(
                f"{path.name} has {len(others)} columns beside the times; say which: column = ..."
            )
        column = others[0]
    for key, name in (("time", time), ("column", column)):
        if name not in columns:
            raise ConfigurationError(
                f"{key} = {name!r}: {path.name} has no such column{nearest(name, names)}"
            )
    times, values = columns[time], columns[column]
    if len(times) != len(values):
        raise ConfigurationError(
            f"{path.name}: {len(times)} times in {time!r} and {len(values)} values in {column!r}"
        )
    seconds = _TIME_UNITS.get(units[time])
    if seconds is None:
        raise ConfigurationError(
            f"{path.name}: the times {time!r} have the unit {units[time]!r}",
            remedy="give them in s, ms, us, min or h",
        )
    numbers = _numbers(f"{path.name}: ", time, times)
    return numbers if seconds == 1.0 else numbers * seconds, values, column, units[column]


def _read(path: Path) -> TextTable:
    """A file as columns.

    Raises:
        ConfigurationError: it is missing, or not what its suffix says.
    """
    suffix = path.suffix.lower()
    if suffix not in _READ:
        raise ConfigurationError(f"{path.name}: a table is a file {', '.join(sorted(_READ))}")
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))
        raise ConfigurationError(f"no file {path}{nearest(path.name, beside)}")
    try:
        return read_text_table(path) if suffix in SUFFIXES else _read_numpy(path)
    except OSError as error:
        raise ConfigurationError(f"{path.name}: cannot be read: {error.strerror}") from error


def _read_numpy(path: Path) -> TextTable:
    try:
        loaded = np.load(path, allow_pickle=False)
        is_zip = path.suffix.lower() == ".npz"
        arrays = {name: loaded[name] for name in loaded.files} if is_zip else loaded
    except (ValueError, EOFError, AttributeError, BadZipFile, MemoryError) as error:
        raise ConfigurationError(
            f"{path.name}: not a NumPy file of numbers, truth values or texts"
        ) from error
    if isinstance(arrays, np.ndarray):
        if arrays.dtype.names is not None:
            arrays = {name: arrays[name] for name in arrays.dtype.names}
        elif arrays.ndim == 2 and arrays.shape[1] == 2:
            arrays = {"time": arrays[:, 0], "value": arrays[:, 1]}
        else:
            raise ConfigurationError(
                f"{path.name}: an array of shape {arrays.shape} is neither structured nor of two "
                "columns, times and values"
            )
    for name, array in arrays.items():
        if array.ndim != 1 or array.dtype.kind not in "fiubU":
            raise ConfigurationError(
                f"{path.name}: {name} is an array of {array.dtype} of shape {array.shape}, not a "
                "column of numbers, truth values or texts"
            )
    if not arrays:
        raise ConfigurationError(f"{path.name}: is empty")
    return TextTable(dict(arrays), dict.fromkeys(arrays, ""))


# ---- Functions ----------------------------------------------------------------------------------


def _function(setting: InputSettings, system: System) -> SignalFunction:
    given = setting.function
    function = _load_function(given, system.base) if isinstance(given, str) else given
    assert function is not None
    start = float(system.simulation.start_time)
    try:
        value = function(start)
        is_finite = isinstance(value, str | bytes) or isfinite(float(value))
    except Exception as error:
        raise ConfigurationError(
            f"the function fails at t={start!r} s: {type(error).__name__}: {error}"
        ) from error
    if not is_finite:
        raise ConfigurationError(f"the function is {value!r} at t={start!r} s")
    breakpoints = tuple(sorted(set(map(float, setting.breakpoints))))
    run = user_context().run
    return SignalFunction(lambda time: run(function, time), breakpoints, setting.order)


def _load_function(reference: str, base: Path) -> Callable[[float], Any]:
    place, name = split_reference(reference) or ("", "")
    if not (place and name):
        raise ConfigurationError(
            f"{reference!r} does not name a function",
            remedy="write package.module:name or path/to/file.py:name",
        )
    module = load_module(place, base)
    function = getattr(module, name, None)
    if not callable(function):
        names = [key for key, value in vars(module).items() if callable(value)]
        raise ConfigurationError(f"{reference!r}: no function {name!r} there{nearest(name, names)}")
    return function  # type: ignore[no-any-return]
