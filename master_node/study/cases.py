"""From a study to its cases: the values of all parameters, run by run, in a fixed order."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from itertools import islice, product
from math import isfinite, prod
from pathlib import Path

import numpy as np

from master_node.numerics.samples import latin_hypercube, spaced
from master_node.study.case import Case
from master_node.study.configuration import (
    MAX_RUNS,
    Cases,
    Range,
    SameValue,
    Sample,
    Study,
)
from master_node.system.fields import Scalar
from protocol.errors import ConfigurationError
from protocol.host.toml_text import toml_value

_MOST_RATIOS = 64
"""More equal ratios do not lie between two different integers of 64 bits."""


def cases_of(study: Study) -> tuple[Case, ...]:
    """All cases of a study, in the order of their numbers; equal studies give equal cases.

    In a grid the last parameter varies fastest.

    Raises:
        ConfigurationError: the file of the cases is wrong, or there are too many.
    """
    if study.cases is not None:
        return _from_file(study, study.cases)
    cases = _grid(study) if study.sample is None else _sampled(study, study.sample)
    sources = {
        name: values.same_as if isinstance(values, SameValue) else name
        for name, values in study.parameters.items()
    }
    return tuple({name: case[source] for name, source in sources.items()} for case in cases)


def _grid(study: Study) -> tuple[Case, ...]:
    values = {
        name: _values(given)
        for name, given in study.parameters.items()
        if not isinstance(given, SameValue)
    }
    number = prod(map(len, values.values()))
    if number > MAX_RUNS:
        raise ConfigurationError(
            f"{study.source}: [parameters] make {number} runs, more than {MAX_RUNS}"
        )
    return tuple(dict(zip(values, row, strict=True)) for row in product(*values.values()))


def _whole_numbers(given: Range, row: Sequence[float]) -> tuple[int, ...]:
    """The values of a range as integers, if its ends and all values between them are whole.

    Exactly: floating-point numbers miss them now and then, as 10 between 1 and 100. Empty if not.
    """
    first, last, parts = given.begin, given.end, len(row) - 1
    if not (isinstance(first, int) and isinstance(last, int)):
        return ()
    is_logarithmic = given.spacing == "logarithmic"
    if is_logarithmic and parts > _MOST_RATIOS:
        return ()
    numbers = tuple(map(round, row))
    for i, number in enumerate(numbers):
        if is_logarithmic:
            is_met = first ** (parts - i) * last**i == number**parts
        else:
            is_met = first * (parts - i) + last * i == number * parts
        if not is_met:
            return ()
    return numbers


def _values(given: Scalar | tuple[Scalar, ...] | Range) -> tuple[Scalar, ...]:
    if isinstance(given, Range):
        assert given.number is not None
        is_logarithmic = given.spacing == "logarithmic"
        row = spaced(given.begin, given.end, given.number, logarithmic=is_logarithmic).tolist()
        return _whole_numbers(given, row) or tuple(row)
    return given if isinstance(given, tuple) else (given,)


def _sampled(study: Study, sample: Sample) -> tuple[Case, ...]:
    if sample.number > MAX_RUNS:
        raise ConfigurationError(
            f"{study.source}: [sample] makes {sample.number} runs, more than {MAX_RUNS}"
        )
    ranges = {name: v for name, v in study.parameters.items() if isinstance(v, Range)}
    rows = latin_hypercube(
        sample.number,
        sample.seed,
        np.array([v.begin for v in ranges.values()], dtype=float),
        np.array([v.end for v in ranges.values()], dtype=float),
        np.array([v.spacing == "logarithmic" for v in ranges.values()]),
    )
    fixed = {
        name: values
        for name, values in study.parameters.items()
        if not isinstance(values, Range | tuple | SameValue)
    }
    return tuple(fixed | dict(zip(ranges, row, strict=True)) for row in rows.tolist())


# ---- Cases in a file ----------------------------------------------------------------------------


def _from_file(study: Study, cases: Cases) -> tuple[Case, ...]:
    path = study.base / cases.file
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.reader(file, strict=True)
            names = _names(path, next(rows, []))
            found = tuple(islice(_rows(path, rows, names), MAX_RUNS + 1))
    except OSError as error:
        raise ConfigurationError(
            f"{study.source}: [cases] {path} cannot be read: {error.strerror}"
        ) from error
    except (csv.Error, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: not a CSV file: {error}") from error
    if not found:
        raise ConfigurationError(f"{path}: there is no row with a case")
    if len(found) > MAX_RUNS:
        raise ConfigurationError(f"{path}: there are more than {MAX_RUNS} cases")
    return found


def _names(path: Path, header: list[str]) -> list[str]:
    names = [name.strip() for name in header]
    for name in names:
        before, dot, after = name.partition(".")
        if not (before and dot and after):
            raise ConfigurationError(
                f"{path}, line 1: {name!r}: write slave.variable or simulation.key"
            )
        if names.count(name) > 1:
            raise ConfigurationError(f"{path}, line 1: two columns are called {name!r}")
    if not names:
        raise ConfigurationError(f"{path}, line 1: there is no column")
    return names


def _rows(path: Path, rows: Iterator[list[str]], names: list[str]) -> Iterator[Case]:
    for number, row in enumerate(rows, start=2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(names):
            raise ConfigurationError(
                f"{path}, line {number}: {len(row)} cells for {len(names)} columns"
            )
        cells = dict(zip(names, map(str.strip, row), strict=True))
        yield {name: _cell(path, number, name, text) for name, text in cells.items() if text}


def _cell(path: Path, number: int, name: str, text: str) -> Scalar:
    """The value in TOML's notation; what is none is a string."""
    value = toml_value(text)
    if not isinstance(value, bool | int | float | str):
        raise ConfigurationError(
            f"{path}, line {number}: {name} = {text}: must be a number, a boolean or a string"
        )
    if isinstance(value, float) and not isfinite(value):
        raise ConfigurationError(f"{path}, line {number}: {name} = {text}: must be finite")
    return value
