"""Differences of two results, variable by variable.

Points of time that both results have are compared as they are. Where only the first one has a
point, the second is interpolated there by ``scipy.interpolate.PchipInterpolator``, a piecewise
cubic that does not overshoot at jumps. (A spline through all points would ring there, and a
straight line would be farther off than most tolerances.) The interpolation has an error of its
own: let b be the one with more points.

Discrete variables keep their value up to the next point, and must be equal unless they are floats.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.interpolate import PchipInterpolator

from master_node.results import Result
from protocol.errors import ResultsError
from protocol.host.tables import lines, plain
from protocol.signals import FloatArray


@dataclass(frozen=True, slots=True)
class VariableComparison:
    """One variable that both results have.

    Attributes:
        name: ``slave.variable``.
        unit: "" where none is known; both, when the results differ in it.
        largest_difference: max |a - b| [unit]; inf where a value on one side only is finite; 1
            where texts or binary values differ.
        time: where that is [s].
        rms: root of the mean of (a - b)**2 [unit].
        within_tolerance: |a - b| <= atol + rtol * |b| at every point, or a = b where they are not
            of type float.
    """

    name: str
    unit: str
    largest_difference: float
    time: float
    rms: float
    within_tolerance: bool


@dataclass(frozen=True, slots=True)
class Comparison:
    """Differences of a and b; b is the reference.

    Attributes:
        a, b: where they were read from.
        rtol, atol: tolerances; ``atol`` in the unit of each variable.
        variables: what both have, in the order of a.
        only_in_a, only_in_b: names that the other one lacks.
        start_time, stop_time: the common range of time [s].
        points: number of points of a in that range.
        interpolated_points: how many of them b lacks.
        equal_bits: same names, same points, same bits in every number.
    """

    a: Path
    b: Path
    rtol: float
    atol: float
    variables: tuple[VariableComparison, ...]
    only_in_a: tuple[str, ...]
    only_in_b: tuple[str, ...]
    start_time: float
    stop_time: float
    points: int
    interpolated_points: int
    equal_bits: bool

    @property
    def within_tolerance(self) -> bool:
        """Every variable that both have is, over the common range of time."""
        return all(variable.within_tolerance for variable in self.variables)

    @property
    def interpolation(self) -> str:
        """Sentence on what was done about different points of time."""
        if not self.interpolated_points:
            return "no interpolation"
        return f"{self.interpolated_points} of them interpolated (PCHIP)"

    def table(self) -> Table:
        """For ``rich.print``: one row per variable; the rest in title and caption."""
        remarks = [
            f"{self.points} points from {self.start_time:g} to {self.stop_time:g} s, "
            + self.interpolation,
            f"tolerance {self.atol:g} + {self.rtol:g} * |b|",
        ]
        if self.equal_bits:
            remarks.append("equal bit for bit")
        for side, names in (("a", self.only_in_a), ("b", self.only_in_b)):
            if names:
                remarks.append(f"only in {side}: {', '.join(names)}")
        table = Table(
            title=lines((f"a = {self.a}", f"b = {self.b}")),
            title_justify="left",
            caption=lines(remarks),
            caption_justify="left",
        )
        table.add_column("variable", overflow="fold")
        table.add_column("unit")
        for heading in ("largest |a - b|", "at time [s]", "RMS"):
            table.add_column(heading, justify="right")
        table.add_column("within")
        for v in self.variables:
            table.add_row(
                plain(v.name),
                plain(v.unit),
                f"{v.largest_difference:.3e}",
                f"{v.time:.6g}",
                f"{v.rms:.3e}",
                plain("yes", "green") if v.within_tolerance else plain("no", "bold red"),
            )
        return table


def compare(a: Path, b: Path, rtol: float, atol: float) -> Comparison:
    """Compare two results directories, or files with ``time`` first; b is the reference.

    Raises:
        ResultsError: one of them cannot be read, they share no variable or no point of time, or
            the time of one goes back.
    """
    first, second = Result.load(a), Result.load(b)
    names = [name for name in first if name in second]
    if not names:
        raise ResultsError(
            f"{a} and {b} have no variable in common: {_some(first)}, and {_some(second)}",
            remedy="in a file of another program, call the columns slave.variable",
        )
    start, stop = _common_range(a, first.time, b, second.time)
    inside = (first.time >= start) & (first.time <= stop)
    time = first.time[inside]
    if not len(time):
        raise ResultsError(f"{a} has no point from {start:g} to {stop:g} s, where {b} has some")
    onto = _Onto(time, second.time)
    discrete = {*first.discrete, *second.discrete}
    return Comparison(
        a=a,
        b=b,
        rtol=rtol,
        atol=atol,
        variables=tuple(
            (_compare_discrete if name in discrete else _compare_variable)(
                name,
                " / ".join(dict.fromkeys(filter(None, (first.units[name], second.units[name])))),
                time,
                a=first[name][inside],
                b=onto.held(second[name]) if name in discrete else onto(second[name]),
                rtol=rtol,
                atol=atol,
            )
            for name in names
        ),
        only_in_a=tuple(name for name in first if name not in second),
        only_in_b=tuple(name for name in second if name not in first),
        start_time=start,
        stop_time=stop,
        points=len(time),
        interpolated_points=int(np.count_nonzero(~onto.shared)),
        equal_bits=first.names == second.names
        and _bits(first.time) == _bits(second.time)
        and _bits(first.outputs) == _bits(second.outputs)
        and list(first.discrete) == list(second.discrete)
        and all(_same(first[name], second[name]) for name in first.discrete),
    )


def _some(result: Result) -> str:
    """The first of its variables, for a message."""
    names = list(result)
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


class _Onto:
    """Takes values on ``nodes``, shape (n,), to ``time``, shape (p,) and within the nodes' range.

    Attributes:
        shared: which points of ``time`` are nodes, shape (p,).
    """

    def __init__(self, time: FloatArray, nodes: FloatArray) -> None:
        self._time = time
        # of rows with the same time, as some tools write at events, the last counts ...
        self._kept = np.append(np.diff(nodes) > 0, True)
        self._nodes = nodes[self._kept]
        self._index = np.searchsorted(self._nodes, time)
        if np.array_equal(time, nodes):  # ... unless both have them
            self._kept = np.ones(len(nodes), np.bool_)
            self._index = np.arange(len(nodes))
        self.shared: NDArray[np.bool_] = nodes[self._kept][self._index] == time

    def __call__(self, values: FloatArray) -> FloatArray:
        values = values[self._kept]
        result = values[self._index]
        if not self.shared.all():
            between = self._time[~self.shared]
            finite = np.isfinite(values).all()  # a cubic cannot be drawn through nan or inf
            result[~self.shared] = (
                PchipInterpolator(self._nodes, values)(between) if finite else np.nan
            )
        return result

    def held(self, values: NDArray[Any]) -> NDArray[Any]:
        """Those of the last node at or before each point."""
        kept: NDArray[Any] = values[self._kept]
        return kept[np.where(self.shared, self._index, self._index - 1)]


def _compare_variable(
    name: str,
    unit: str,
    time: FloatArray,
    *,
    a: FloatArray,
    b: FloatArray,
    rtol: float,
    atol: float,
) -> VariableComparison:
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(invalid="ignore", over="ignore"):
        difference = np.where(same, 0.0, np.abs(a - b))
        difference[np.isnan(difference)] = np.inf
        bound = atol + rtol * np.where(np.isfinite(b), np.abs(b), 0.0)
        worst = int(np.argmax(difference))
        largest = float(difference[worst])
        scale = largest if np.isfinite(largest) and largest > 0.0 else 1.0  # squares of 1e200
        rms = scale * float(np.sqrt(np.mean((difference / scale) ** 2)))
    return VariableComparison(
        name=name,
        unit=unit,
        largest_difference=largest,
        time=float(time[worst]),
        rms=rms,
        within_tolerance=bool(np.all(difference <= bound)),
    )


def _compare_discrete(
    name: str,
    unit: str,
    time: FloatArray,
    *,
    a: NDArray[Any],
    b: NDArray[Any],
    rtol: float,
    atol: float,
) -> VariableComparison:
    if a.dtype.kind == b.dtype.kind == "f":
        return _compare_variable(name, unit, time, a=a, b=b, rtol=rtol, atol=atol)
    equal = np.asarray(a == b, np.bool_)
    if "O" in (a.dtype.kind, b.dtype.kind):
        a, b = ~equal, np.zeros(len(equal))
    compared = _compare_variable(
        name, unit, time, a=a.astype(np.float64), b=b.astype(np.float64), rtol=0.0, atol=0.0
    )
    return replace(compared, within_tolerance=bool(equal.all()))


def _common_range(a: Path, time_a: FloatArray, b: Path, time_b: FloatArray) -> tuple[float, float]:
    for path, time in ((a, time_a), (b, time_b)):
        if not len(time):
            raise ResultsError(f"{path} has no rows")
        if not (np.isfinite(time).all() and np.all(np.diff(time) >= 0.0)):
            raise ResultsError(f"{path}: time must be finite and must not go back")
    start = float(max(time_a[0], time_b[0]))
    stop = float(min(time_a[-1], time_b[-1]))
    if start > stop:
        raise ResultsError(
            f"{a} ({time_a[0]:g} to {time_a[-1]:g} s) and {b} ({time_b[0]:g} to "
            f"{time_b[-1]:g} s) have no time in common"
        )
    return start, stop


def _same(a: NDArray[Any], b: NDArray[Any]) -> bool:
    if a.dtype.kind == "O":
        return bool(a.tolist() == b.tolist())
    return a.dtype == b.dtype and _bits(a) == _bits(b)


def _bits(values: NDArray[Any]) -> bytes:
    return np.asarray(values.shape).tobytes() + values.tobytes()
