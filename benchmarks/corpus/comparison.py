"""Doublestep's results of a run with fixed steps against FMPy's, bit for bit."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isclose, isnan

from master_node.results import Result


@dataclass(frozen=True, slots=True)
class Comparison:
    """Where two runs agree.

    Attributes:
        values: numbers compared.
        difference: the first one that is not the same, in words; "" if there is none.
    """

    values: int
    difference: str


def compare(result: Result, slave: str, columns: Mapping[str, Sequence[object]]) -> Comparison:
    """Compare the outputs of a slave with the columns of `benchmarks.corpus.fmpy_loop`.

    The end of a run that the model itself ended may be written at a time of its own by one of
    them, so each time must be met up to rounding, and each value to the bit. Columns that
    only one of them has are left out: FMPy records no strings.
    """
    times = columns["time"]
    if len(times) != len(result.time):
        return Comparison(0, f"{len(result.time)} points, FMPy has {len(times)}")
    names = [name for name in columns if f"{slave}.{name}" in result]
    values = 0
    for row, (ours, theirs) in enumerate(zip(result.time.tolist(), times, strict=True)):
        if not isclose(ours, float(str(theirs)), rel_tol=1e-12, abs_tol=1e-12):
            return Comparison(values, f"point {row} is at t={ours!r} s, FMPy's at t={theirs!r} s")
        for name in names:
            one, other = result[f"{slave}.{name}"][row].item(), columns[name][row]
            values += 1
            if not is_same(one, other):
                return Comparison(values, f"{name} at t={ours!r} s: {one!r}, FMPy: {other!r}")
    return Comparison(values, "")


def is_same(one: object, other: object) -> bool:
    """Equality of two values to the bit; any NaN equals any other one."""
    if not isinstance(one, float):
        return one == other
    theirs = float(other)  # type: ignore[arg-type]
    both_nan = isnan(one) and isnan(theirs)
    return both_nan or struct.pack("d", one) == struct.pack("d", theirs)
