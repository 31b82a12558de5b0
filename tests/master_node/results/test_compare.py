"""Comparing results: every difference is found, named and measured."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from master_node.observing.observers import Attempt, Outcome, Point, RunEnd, RunStart, Statistics
from master_node.results import ResultsWriter
from master_node.results.compare import compare
from protocol.errors import ResultsError

Columns = Mapping[str, Sequence[float]]
Write = Callable[[str, Columns], Path]


def write_csv(path: Path, columns: Columns) -> Path:
    """A results file with these columns."""
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(repr(float(v)) for v in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """``write_csv`` by name, in a fresh directory."""
    return lambda name, columns: write_csv(tmp_path / name, columns)


def grid(n: int, function: Callable[[float], float]) -> Columns:
    """A function at n points from 0 to 2 s."""
    time = np.linspace(0.0, 2.0, n)
    return {"time": time.tolist(), "s.x": [function(t) for t in time]}


def test_equal_files_are_equal_in_bits(write: Write) -> None:
    """Files with equal numbers, NaN and inf included, have no difference at any tolerance."""
    columns = {"time": [0.0, 1.0, 2.0], "s.x": [math.nan, math.inf, 1e-310]}
    comparison = compare(write("a", columns), write("b", columns), 0.0, 0.0)
    assert comparison.equal_bits
    assert comparison.within_tolerance
    assert comparison.variables[0].largest_difference == 0.0
    assert comparison.interpolation == "no interpolation"


def test_one_bit_is_a_difference_in_bits(write: Write) -> None:
    """-0.0 and 0.0 are no difference in value, but one in bits."""
    a = write("a", {"time": [0.0, 1.0], "s.x": [0.0, 1.0]})
    b = write("b", {"time": [0.0, 1.0], "s.x": [-0.0, 1.0]})
    comparison = compare(a, b, 0.0, 0.0)
    assert comparison.within_tolerance
    assert not comparison.equal_bits


def test_largest_difference_its_time_and_rms(write: Write) -> None:
    """On the same grid the comparison is point by point."""
    a = write("a", {"time": [0.0, 1.0, 2.0, 3.0], "s.x": [1.0, 2.0, 3.0, 4.0], "s.y": [0.0] * 4})
    b = write("b", {"time": [0.0, 1.0, 2.0, 3.0], "s.x": [1.0, 2.5, 1.0, 4.0], "s.y": [0.0] * 4})
    x, y = compare(a, b, 0.0, 0.1).variables
    assert (x.name, x.largest_difference, x.time) == ("s.x", 2.0, 2.0)
    assert x.rms == pytest.approx(math.sqrt((0.25 + 4.0) / 4.0))
    assert not x.within_tolerance
    assert (y.largest_difference, y.rms, y.within_tolerance) == (0.0, 0.0, True)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(-10.0, 10.0), st.floats(-10.0, 10.0))
def test_tolerance_is_relative_to_b(
    tmp_path_factory: pytest.TempPathFactory, rtol: float, atol: float, a: float, b: float
) -> None:
    """Within means |a - b| <= atol + rtol |b|: b is the reference."""
    folder = tmp_path_factory.mktemp("tolerance")
    first = write_csv(folder / "a", {"time": [0.0], "s.x": [a]})
    second = write_csv(folder / "b", {"time": [0.0], "s.x": [b]})
    expected = abs(a - b) <= atol + rtol * abs(b)
    assert compare(first, second, rtol, atol).within_tolerance == expected


def test_shared_points_are_not_interpolated(write: Write) -> None:
    """Where b has a point of a, its own value is used, whatever else it has around it."""
    a = write("a", grid(11, math.sin))
    b = write("b", grid(21, math.sin))
    comparison = compare(a, b, 0.0, 1e-15)
    assert comparison.within_tolerance
    assert comparison.interpolated_points == 0
    assert not comparison.equal_bits


def test_interpolation_error_vanishes_with_the_grid_of_b(write: Write) -> None:
    """Between b's points a cubic is laid: the difference falls faster than the square of h."""
    a = write("a", grid(257, math.exp))
    differences = []
    for n in (11, 21, 41):
        comparison = compare(a, write(f"b{n}", grid(n, math.exp)), 0.0, 1.0)
        differences.append(comparison.variables[0].largest_difference)
        assert comparison.points == 257
        assert "interpolated (PCHIP)" in comparison.interpolation
    assert differences[0] > 4.5 * differences[1] > 4.5**2 * differences[2]


def test_a_jump_is_not_overshot(write: Write) -> None:
    """Between two values the interpolation stays between them."""
    b = write("b", {"time": [0.0, 1.0, 2.0, 3.0], "s.x": [0.0, 0.0, 1.0, 1.0]})
    time = np.linspace(0.0, 3.0, 301)
    a = write("a", {"time": time.tolist(), "s.x": [0.5] * 301})
    assert compare(a, b, 0.0, 0.5).within_tolerance


def test_only_the_common_time_counts(write: Write) -> None:
    """A run that ended early is compared as far as it got."""
    a = write("a", {"time": [0.0, 1.0, 2.0, 3.0], "s.x": [0.0, 1.0, 2.0, 99.0]})
    b = write("b", {"time": [0.5, 1.0, 2.0, 2.5], "s.x": [0.5, 1.0, 2.0, 2.5]})
    comparison = compare(a, b, 0.0, 1e-12)
    assert (comparison.start_time, comparison.stop_time, comparison.points) == (0.5, 2.5, 2)
    assert comparison.within_tolerance
    assert not comparison.equal_bits


def test_rows_at_the_same_time(write: Write) -> None:
    """Tools that write two rows at an event: compared row by row, or after the event."""
    event = {"time": [0.0, 1.0, 1.0, 2.0], "s.x": [0.0, 0.0, 1.0, 1.0]}
    a, b = write("a", event), write("b", event)
    assert compare(a, b, 0.0, 0.0).equal_bits
    after = write("c", {"time": [0.0, 1.0, 1.5, 2.0], "s.x": [0.0, 1.0, 1.0, 1.0]})
    assert compare(after, b, 0.0, 1e-12).within_tolerance


def test_values_that_are_not_finite_are_never_within(write: Write) -> None:
    """NaN against a number is an infinite difference, also where it would be interpolated."""
    a = write("a", {"time": [0.0, 1.0, 2.0], "s.x": [0.0, math.nan, 0.0], "s.y": [0.0, 1.0, 1.0]})
    b = write("b", {"time": [0.0, 1.0, 2.0], "s.x": [0.0, 0.0, 0.0], "s.y": [0.0, math.inf, 1.0]})
    x, y = compare(a, b, 1.0, 1e300).variables
    assert (x.largest_difference, x.time, x.within_tolerance) == (math.inf, 1.0, False)
    assert (y.largest_difference, y.time, y.within_tolerance) == (math.inf, 1.0, False)
    c = write("c", {"time": [0.0, 1.5, 2.0], "s.x": [0.0, 0.0, 0.0], "s.y": [0.0, 0.0, 1.0]})
    assert compare(c, b, 1.0, 1.0).variables[1].time == 1.5


def test_huge_differences_have_an_rms(write: Write) -> None:
    """The squares may overflow, their mean's root need not."""
    a = write("a", {"time": [0.0, 1.0], "s.x": [1e200, 1e200]})
    b = write("b", {"time": [0.0, 1.0], "s.x": [0.0, 0.0]})
    assert compare(a, b, 0.0, 0.0).variables[0].rms == pytest.approx(1e200)


def test_variables_of_one_side_are_named(write: Write) -> None:
    """They do not take part, and the table names them; brackets in names are no markup."""
    a = write("a", {"time": [0.0], "s.x[1]": [0.0], "s.more": [0.0]})
    b = write("b", {"time": [0.0], "s.x[1]": [1.0], "t.z": [0.0]})
    comparison = compare(a, b, 0.0, 0.5)
    assert [variable.name for variable in comparison.variables] == ["s.x[1]"]
    assert (comparison.only_in_a, comparison.only_in_b) == (("s.more",), ("t.z",))
    console = Console(width=200)
    with console.capture() as captured:
        console.print(comparison.table())
    text = captured.get()
    assert "s.x[1]" in text
    assert "only in a: s.more" in text
    assert "only in b: t.z" in text
    assert "1.000e+00" in text


def test_what_cannot_be_compared_says_why(write: Write) -> None:
    """No common variable, no common time, time that goes back, no rows at all."""
    a = write("a", {"time": [0.0, 1.0], "s.x": [0.0, 0.0]})
    others = {
        r"no variable in common: s\.x, and y; .*slave\.variable": {"time": [0.0], "y": [0.0]},
        "no time in common": {"time": [2.0, 3.0], "s.x": [0.0, 0.0]},
        "must not go back": {"time": [1.0, 0.0], "s.x": [0.0, 0.0]},
        "has no rows": {"time": [], "s.x": []},
    }
    for message, columns in others.items():
        with pytest.raises(ResultsError, match=message):
            compare(a, write("b", columns), 0.0, 0.0)
    between = write("b", {"time": [0.25, 0.75], "s.x": [0.0, 0.0]})
    with pytest.raises(ResultsError, match=r"no point from 0\.25 to 0\.75 s"):
        compare(a, between, 0.0, 0.0)


def write_discrete(
    directory: Path, times: Sequence[float], gears: Sequence[int], label: str = "a"
) -> Path:
    """A results directory in Arrow with discrete variables of three types."""
    start = RunStart(
        ("s.x",),
        ("m",),
        times[0],
        9.0,
        np.zeros(1),
        ("s.gear", "s.ratio", "s.label"),
        ("integer", "float", "string"),
        (),
        (gears[0], float(gears[0]), label),
    )
    writer = ResultsWriter(directory, {"results": {"formats": ["arrow"]}})
    writer.started(start)
    for time, gear in zip(times[1:], gears[1:], strict=True):
        point = Point(time, np.zeros(1), (gear, gear + 1e-6, label))
        writer.attempted(Attempt(0.0, 0.1, 0, 0, 0.5, True, "", (point,)))
    writer.ended(RunEnd(Outcome.COMPLETED, Statistics()))
    return directory


def test_discrete_variables_keep_their_value_up_to_the_next_point(tmp_path: Path) -> None:
    """Between the points of b nothing is interpolated; floats have tolerances, the others none."""
    b = write_discrete(tmp_path / "b", [0.0, 1.0, 2.0], [1, 2, 3])
    a = write_discrete(tmp_path / "a", [0.0, 0.5, 1.0, 1.5, 2.0], [1, 1, 2, 2, 3])
    comparison = compare(a, b, 0.0, 1e-3)
    assert comparison.within_tolerance
    assert comparison.interpolated_points == 2
    names = ["s.x", "s.gear", "s.ratio", "s.label"]
    assert [variable.name for variable in comparison.variables] == names
    late = write_discrete(tmp_path / "late", [0.0, 0.5, 1.0, 1.5, 2.0], [1, 1, 1, 2, 3])
    x, gear, ratio, label = compare(late, b, 0.0, 10.0).variables
    assert (gear.within_tolerance, gear.largest_difference, gear.time) == (False, 1.0, 1.0)
    assert x.within_tolerance
    assert ratio.within_tolerance
    assert label.within_tolerance


def test_texts_are_equal_or_not(tmp_path: Path) -> None:
    """A text differs by 1, and that is never within tolerance; equal bits mean equal texts, too."""
    a = write_discrete(tmp_path / "a", [0.0, 1.0], [1, 1])
    same = write_discrete(tmp_path / "same", [0.0, 1.0], [1, 1])
    other = write_discrete(tmp_path / "other", [0.0, 1.0], [1, 1], "b")
    assert compare(a, same, 0.0, 0.0).equal_bits
    comparison = compare(a, other, 0.0, 10.0)
    assert not comparison.equal_bits
    label = comparison.variables[-1]
    assert (label.name, label.largest_difference, label.within_tolerance) == ("s.label", 1.0, False)
