"""Results that are kept, and their files: all formats hold the same, whatever ends the run."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat, savemat
from typer.testing import CliRunner

from master_node import Result, load_system, simulate
from master_node.cli.app import app, main
from master_node.observing.observers import (
    Attempt,
    DiscreteValue,
    Outcome,
    Point,
    RunEnd,
    RunStart,
    Statistics,
)
from master_node.results import (
    Recording,
    ResultsWriter,
    SelectedResults,
    check_variables,
    formats,
    parquet_file,
)
from master_node.results import writer as writer_module
from master_node.results.patterns import chosen
from protocol.errors import ConfigurationError, ResultsError
from tests.support.places import ROOT
from tests.support.waiting import BOUND, wait_until

CAR = ROOT / "examples" / "quarter_car" / "displacement_python.toml"

TEXTS = ("gear", "label")
START = RunStart(
    output_names=("wheel.x", "wheel.k[1]"),
    output_units=("m", ""),
    start_time=0.0,
    stop_time=4.0,
    outputs=np.array([0.5, -0.0]),
    discrete_names=("box.ratio", "box.gear", "box.on", "box.label", "box.blob"),
    discrete_types=("float", "integer", "boolean", "string", "binary"),
    discrete_units=("1/min", "", "", "", ""),
    discrete=(1.5, 1, False, "a", b"\0"),
)
FORMATS = tuple(formats.FORMATS)
FILES = {name: f"results.{name}" for name in FORMATS}


def settings(*formats: str) -> dict[str, Any]:
    """Those of a run with a parameter, for these formats."""
    return {
        "slaves": {
            "wheel": {"parameters": {"m": 40, "on": True, "name": "x", "x": 7.0}},
            "box": {},
        },
        "results": {"formats": formats},
    }


def attempt(*points: Point) -> Attempt:
    """An accepted attempt that reached some points."""
    return Attempt(0.0, 0.5, 1, 0, 0.5, True, "wheel.x", points)


def end(*points: Point) -> RunEnd:
    """A run that got to its end."""
    return RunEnd(Outcome.COMPLETED, Statistics(), "", points)


def write(directory: Path, points: Sequence[Point], *formats: str, start: RunStart = START) -> Path:
    """A whole run into a directory."""
    writer = ResultsWriter(directory, settings(*formats))
    writer.started(start)
    for i in range(0, len(points), 2):
        writer.attempted(attempt(*points[i : i + 2]))
    writer.ended(end())
    return directory


def some_points(n: int) -> list[Point]:
    """Computed from their number alone."""
    return [
        Point(
            i / 4,
            np.array([math.sin(i), math.exp(-i)]),
            (i / 3, i * 10**15, i % 2 == 0, f'{i}, "quoted"\r\nline', bytes([i % 256]) * i),
        )
        for i in range(1, n + 1)
    ]


def bits(values: np.ndarray) -> bytes:
    """The bytes of the numbers, which tell -0.0 from 0.0 and one NaN from another."""
    return np.ascontiguousarray(values).tobytes()


def rows_of(start: RunStart, points: Sequence[Point]) -> tuple[np.ndarray, np.ndarray]:
    """Times and outputs, the first point included."""
    return (
        np.array([start.start_time, *(point.time for point in points)]),
        np.array([start.outputs, *(point.outputs for point in points)]),
    )


def holds(result: Result, start: RunStart, points: Sequence[Point]) -> None:
    """The result is exactly this run."""
    time_, outputs = rows_of(start, points)
    assert result.names == start.output_names
    assert bits(result.time) == bits(time_)
    number = ~np.isnan(outputs)
    assert bits(result.outputs[number]) == bits(outputs[number])
    assert np.isnan(result.outputs[~number]).all()
    values = zip(start.discrete, *(point.discrete for point in points), strict=True)
    wanted = {"float": "f8", "integer": "i8", "boolean": "?", "string": "O", "binary": "O"}
    assert tuple(result.discrete) == start.discrete_names
    for name, type_, column in zip(start.discrete_names, start.discrete_types, values, strict=True):
        assert result[name].dtype == np.dtype(wanted[type_])
        if type_ == "float":
            assert np.array_equal(result[name], column, equal_nan=True)
            assert str(result[name].tolist()) == str(list(column))  # -0.0 is not 0.0
        else:
            assert result[name].tolist() == list(column)


# --- The same in every format -------------------------------------------------------------------

FLOATS = st.floats(width=64)
INTEGERS = st.integers(-(2**63), 2**63 - 1)
POINTS = st.lists(
    st.tuples(
        st.tuples(FLOATS, FLOATS),
        st.tuples(FLOATS, INTEGERS, st.booleans(), st.text(), st.binary()),
    ),
    max_size=8,
)


@pytest.mark.parametrize("format_", ["csv", "arrow", "parquet"])
@given(rows=POINTS)
def test_values_come_back_as_they_were(
    tmp_path_factory: pytest.TempPathFactory,
    format_: str,
    rows: list[tuple[tuple[float, float], tuple[DiscreteValue, ...]]],
) -> None:
    """Every float with its bits, every integer of 64 bits, every text and every byte, with types.

    A NaN comes back as a NaN.
    """
    points = [Point(float(i), np.array(y), discrete) for i, (y, discrete) in enumerate(rows, 1)]
    directory = write(tmp_path_factory.mktemp("round"), points, format_)
    result = Result.load(directory)
    holds(result, START, points)
    assert result.units == {
        "wheel.x": "m",
        "wheel.k[1]": "",
        "box.ratio": "1/min",
        **dict.fromkeys(START.discrete_names[1:], ""),
    }
    assert {path.name for path in directory.iterdir()} == {
        f"results.{format_}",
        "steps.csv",
        "summary.json",
    }


@pytest.mark.parametrize("format_", ["arrow", "parquet"])
def test_binary_formats_keep_every_nan(tmp_path: Path, format_: str) -> None:
    """The bits of a NaN are kept too, and -0.0 stays apart from 0.0 in one row group."""
    odd = np.frombuffer(np.uint64([0x7FF8000000000001, 0xFFF8000000000002]).tobytes(), np.float64)
    values = [odd, np.array([0.0, -0.0]), np.array([-0.0, 0.0]), np.array([np.nan, 5e-324])]
    points = [Point(i + 1.0, y, START.discrete) for i, y in enumerate(values)]
    result = Result.load(write(tmp_path, points, format_))
    assert bits(result.outputs[1:]) == bits(np.array(values))


def test_all_formats_hold_the_same_and_equal_what_is_recorded(tmp_path: Path) -> None:
    """One run in all formats, read from each alone; MAT without texts and binary values."""
    points = some_points(50)
    recording = Recording(settings(*FORMATS))
    recording.started(START)
    for i in range(0, 50, 2):
        recording.attempted(attempt(*points[i : i + 2]))
    recording.ended(end())
    recorded = recording.result()
    holds(recorded, START, points)
    write(tmp_path, points, *FORMATS)
    for name in FORMATS:
        alone = tmp_path / name
        alone.mkdir()
        (tmp_path / FILES[name]).rename(alone / FILES[name])
        (alone / "summary.json").write_bytes((tmp_path / "summary.json").read_bytes())
        result = Result.load(alone)
        assert result.summary == recorded.summary
        if name != "mat":
            holds(result, START, points)
            continue
        assert bits(result.outputs) == bits(recorded.outputs)
        assert list(result.discrete) == ["box.ratio", "box.gear", "box.on"]
        for variable in result.discrete:
            assert result[variable].dtype == recorded[variable].dtype
            assert result[variable].tolist() == recorded[variable].tolist()


def test_the_summary_names_the_formats_and_what_mat_cannot_hold(tmp_path: Path) -> None:
    """Formats, types and the texts that are left out, in the summary of files and of memory."""
    summary = json.loads((write(tmp_path / "a", [], *FORMATS) / "summary.json").read_text())
    assert summary["formats"] == list(FORMATS)
    assert summary["not_in_mat"] == ["box.label", "box.blob"]
    assert summary["discrete_types"] == dict(
        zip(START.discrete_names, START.discrete_types, strict=True)
    )
    summary = json.loads((write(tmp_path / "b", [], "csv") / "summary.json").read_text())
    assert (summary["formats"], summary["not_in_mat"]) == (["csv"], [])


def test_the_text_of_discrete_values(tmp_path: Path) -> None:
    """Texts of discrete values are as documented: repr, digits, true, quotation marks, base64."""
    point = Point(0.25, np.array([1.0, 2.0]), (2.0, -7, True, 'say "x", y', b"\xff\x00"))
    lines = (write(tmp_path, [point], "csv") / "results.csv").read_text().splitlines()
    assert lines == [
        "time,wheel.x,wheel.k[1],box.ratio,box.gear,box.on,box.label,box.blob",
        '0.0,0.5,-0.0,1.5,1,false,"a",AA==',
        '0.25,1.0,2.0,2.0,-7,true,"say ""x"", y",/wA=',
    ]


def test_long_texts_come_back_from_csv(tmp_path: Path) -> None:
    """A text of a megabyte is beyond the limit that Python's reader has by default."""
    point = Point(0.25, np.array([1.0, 2.0]), (0.0, 0, True, "x" * 10**6, bytes(10**6)))
    holds(Result.load(write(tmp_path, [point], "csv")), START, [point])


def test_an_unfinished_line_is_left_out_also_within_a_text(tmp_path: Path) -> None:
    """Cut anywhere in its last row, whose text has line ends, a CSV file gives all rows before."""
    points = some_points(3)
    path = write(tmp_path, points, "csv") / "results.csv"
    whole = path.read_bytes()
    begin = whole.index(b"\n0.75,") + 1
    assert whole.count(b"\r\n", begin) == 1
    for cut in range(begin, len(whole)):
        path.write_bytes(whole[:cut])
        holds(Result.load(tmp_path), START, points[:2])


@pytest.mark.parametrize(
    ("field", "wrong", "words"),
    [
        ("1,", "1.5,", r"results\.csv, line 2: box\.gear is of type integer, found '1\.5'"),
        ("1,", "9223372036854775808,", r"box\.gear is of type integer"),
        ("false", "no", r"box\.on is of type boolean, found 'no'"),
        ("AA==", "A*==", r"box\.blob is of type binary"),
        ("0.5", "x", r"wheel\.x is of type float"),
        ("AA==", "AA==,1", "expected 8 fields, found 9"),
        ('"a"', '"a"b', r"results\.csv, line 2"),
    ],
)
def test_values_of_another_type_are_named(
    tmp_path: Path, field: str, wrong: str, words: str
) -> None:
    """File, line, variable and type."""
    path = write(tmp_path, some_points(3), "csv") / "results.csv"
    head, first, *rest = path.read_text().splitlines(keepends=True)
    path.write_text("".join([head, first.replace(f",{field}", f",{wrong}", 1), *rest]))
    with pytest.raises(ResultsError, match=words):
        Result.load(tmp_path)


def test_a_value_that_does_not_fit_its_type_is_an_error(tmp_path: Path) -> None:
    """An integer of more than 64 bits is refused with the name of the variable."""
    writer = ResultsWriter(tmp_path, settings("arrow"))
    with pytest.raises(ResultsError, match=r"results\.arrow: box\.gear is of type integer"):
        writer.started(replace(START, discrete=(0.0, 2**63, True, "", b"")))


# --- Arrow --------------------------------------------------------------------------------------


def test_the_schema_tells_units_and_where_it_comes_from(tmp_path: Path) -> None:
    """Read with pyarrow alone."""
    write(tmp_path, some_points(3), "arrow", "parquet")
    with pa.ipc.open_stream(tmp_path / "results.arrow") as stream:
        schema = stream.schema
        assert stream.read_all().num_rows == 4
    about = {field.name: field.metadata for field in schema}
    assert about["time"] == {b"unit": b"s"}
    assert about["wheel.x"] == {b"unit": b"m", b"variability": b"continuous"}
    assert about["box.ratio"] == {b"unit": b"1/min", b"variability": b"discrete"}
    assert [str(field.type) for field in schema] == [
        *("double", "double", "double", "double", "int64", "bool", "string", "binary")
    ]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert schema.metadata[b"settings_sha256"].decode() == summary["settings_sha256"]
    assert b"doublestep" in schema.metadata
    assert pq.read_schema(tmp_path / "results.parquet").equals(schema, check_metadata=True)


def test_rows_reach_the_stream_twice_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first batch is T_0, at once; after 0.5 s the next attempt takes all rows with it."""
    now = 100.0
    monkeypatch.setattr(writer_module, "monotonic", lambda: now)
    writer = ResultsWriter(tmp_path, settings("arrow"))
    writer.started(START)
    points = some_points(6)

    def batches() -> list[int]:
        with pa.ipc.open_stream(tmp_path / "results.arrow") as stream:
            return [batch.num_rows for batch in stream]

    assert batches() == [1]
    now = 100.49
    writer.attempted(attempt(*points[:2]))
    assert batches() == [1]
    now = 100.5
    writer.attempted(attempt(*points[2:4]))
    assert batches() == [1, 4]
    writer.ended(end(*points[4:]))
    assert batches() == [1, 4, 2]
    assert (tmp_path / "results.arrow").read_bytes().endswith(b"\xff\xff\xff\xff\0\0\0\0")


def test_an_unfinished_batch_is_left_out_and_a_broken_one_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cut anywhere in its last batch, a stream gives all batches before it.

    A stream with an end that cannot be read is malformed instead: nothing is left out silently.
    """
    monkeypatch.setattr(writer_module, "FLUSH_INTERVAL", 0.0)
    points = some_points(6)
    path = write(tmp_path, points, "arrow") / "results.arrow"
    whole = path.read_bytes()
    short = write(tmp_path / "short", points[:4], "arrow") / "results.arrow"
    begin = len(short.read_bytes()) - 8
    assert whole.startswith(short.read_bytes()[:begin])
    for cut in range(begin, len(whole) - 8, 7):
        path.write_bytes(whole[:cut])
        holds(Result.load(tmp_path), START, points[:4])
    path.write_bytes(whole[:begin] + whole[begin + 16 :])
    with pytest.raises(ResultsError, match=r"results\.arrow: "):
        Result.load(tmp_path)


KILLED = """
import os, signal, sys
from pathlib import Path
from master_node.results import ResultsWriter, writer
from tests.master_node.results.test_result_formats import START, attempt, settings, some_points
writer.FLUSH_INTERVAL = 0.0
results = ResultsWriter(Path(sys.argv[1]), settings(*sys.argv[2:]))
results.started(START)
points = some_points(40)
for i in range(0, 30, 2):
    results.attempted(attempt(*points[i:i + 2]))
writer.FLUSH_INTERVAL = 1e9
results._next_flush = 1e9
for i in range(30, 40, 2):
    results.attempted(attempt(*points[i:i + 2]))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
@pytest.mark.parametrize("formats", [("csv",), ("arrow",), ("parquet",), ("mat",), FORMATS])
def test_a_killed_writer_leaves_every_flushed_row(tmp_path: Path, formats: tuple[str, ...]) -> None:
    """Killed with rows in its hands, it leaves exactly those that it had flushed, with types.

    Without CSV and Arrow the stream that Parquet and MAT are made from is read.
    """
    process = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path), *formats],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
    )
    assert process.returncode == -signal.SIGKILL, process.stderr
    result = Result.load(tmp_path)
    holds(result, START, some_points(30))
    assert result.units["wheel.x"] == "m"
    assert result.summary == {}
    assert not (tmp_path / "results.parquet").exists()
    again = write(tmp_path, some_points(3), "csv")
    assert {path.name for path in again.iterdir()} == {"results.csv", "steps.csv", "summary.json"}


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_a_master_killed_in_mid_run_leaves_a_readable_stream(
    tmp_path: Path, no_process_left: None
) -> None:
    """A real run over a real quarter car, killed after some flushes: plain pyarrow reads the rest.

    Its rows are those of results.csv, bit for bit, but for a batch that only one of the two got.
    """
    log = tmp_path / "log"
    with log.open("wb") as out:
        master = subprocess.Popen(
            [
                *(sys.executable, "-m", "master_node", "run", str(CAR), "--in-process"),
                *("--output", str(tmp_path / "out"), "--stop-time", "1e6", "--quiet"),
                *("--output-format", "arrow", "--output-format", "csv"),
            ],
            cwd=ROOT,
            stdout=out,
            stderr=out,
        )
    path = tmp_path / "out" / "results.arrow"
    sizes: set[int] = set()

    def has_grown() -> bool:
        assert master.poll() is None, log.read_text()
        if path.exists():
            sizes.add(path.stat().st_size)
        return len(sizes) == 4

    try:
        wait_until(has_grown, log.read_text)
    finally:
        master.kill()
        master.wait(BOUND)
    with pa.ipc.open_stream(path) as stream:
        batches = list(stream)
    assert len(batches) >= 3
    arrow = pa.Table.from_batches(batches)
    flushed = Result.load(tmp_path / "out" / "results.csv")
    assert abs(arrow.num_rows - len(flushed.time)) <= batches[-1].num_rows
    n = min(arrow.num_rows, len(flushed.time))
    for name in ("time", *flushed.names):
        assert bits(arrow[name].to_numpy()[:n]) == bits(flushed[name][:n])
    assert not (tmp_path / "out" / "summary.json").exists()


# --- Parquet ------------------------------------------------------------------------------------


def test_row_groups_do_not_depend_on_the_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Equal numbers give equal Parquet and MAT files, in as many groups as the size asks for."""
    points = some_points(50)
    monkeypatch.setattr(parquet_file, "_CELLS", 8 * 20)
    write(tmp_path / "a", points, "parquet", "mat")
    monkeypatch.setattr(writer_module, "FLUSH_INTERVAL", 0.0)
    write(tmp_path / "b", points, "parquet", "mat")
    for name in ("results.parquet", "results.mat"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    about = pq.read_metadata(tmp_path / "a" / "results.parquet")
    groups = [about.row_group(i).num_rows for i in range(about.num_row_groups)]
    assert groups == [20, 20, 11]
    holds(Result.load(tmp_path / "a"), START, points)


@pytest.mark.parametrize("format_", ["parquet", "mat"])
def test_what_cannot_be_made_at_the_end_leaves_the_stream(tmp_path: Path, format_: str) -> None:
    """The error names the file and a remedy; nothing half is left, and the results can be read."""
    writer = ResultsWriter(tmp_path, settings(format_))
    writer.started(START)
    points = some_points(4)
    writer.attempted(attempt(*points))
    (tmp_path / FILES[format_]).mkdir()
    with pytest.raises(ResultsError, match=rf"cannot write .*results\.{format_}: .*; ") as caught:
        writer.ended(end())
    assert caught.value.exit_code == 7
    assert not list(tmp_path.glob("*.part"))
    assert not list(tmp_path.glob(".*.part"))
    result = Result.load(tmp_path)
    holds(result, START, points)
    assert (result.summary["outcome"], result.summary["message"]) == ("failed", str(caught.value))


FULL = """
import resource, sys
from pathlib import Path
from master_node.results import ResultsWriter, writer
from protocol.errors import ResultsError
from tests.master_node.results.test_result_formats import START, attempt, end, settings, some_points
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
writer.FLUSH_INTERVAL = 0.0
results = ResultsWriter(Path(sys.argv[1]), settings(*sys.argv[2:]))
results.started(START)
points = some_points(1000)
try:
    for i in range(0, 1000, 2):
        results.attempted(attempt(*points[i:i + 2]))
except ResultsError as error:
    print(error.exit_code, error)
results.ended(end())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="the limit on file sizes is POSIX")
@pytest.mark.parametrize(
    ("formats", "first"),
    [(("arrow",), "results.arrow"), (("parquet",), ".results.arrow"), (FORMATS, "results.arrow")],
)
def test_full_disk_leaves_whole_batches(
    tmp_path: Path, formats: tuple[str, ...], first: str
) -> None:
    """The stream is cut back to its last whole batch, the error says so once, with exit code 7."""
    process = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path), *formats],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert process.stdout.startswith("7 cannot write")
    assert f"{tmp_path / first}: File too large; choose" in process.stdout
    assert process.stdout.count("cannot write") == 1
    result = Result.load(tmp_path)
    n = len(result.time) - 1
    assert n > 50
    holds(result, START, some_points(n))
    assert result.summary["outcome"] == "failed"


# --- MAT ----------------------------------------------------------------------------------------


def matrices(path: Path) -> dict[str, Any]:
    """Matrices as SciPy reads them, characters one by one."""
    return dict(loadmat(path, chars_as_strings=False))


def transposed_texts(characters: np.ndarray) -> list[str]:
    """Texts as DyMat and OpenModelica read names: a column of characters each."""
    return ["".join(column).rstrip() for column in zip(*characters, strict=True)]


def test_mat_is_laid_out_as_dymola_does(tmp_path: Path) -> None:
    """Order, shapes and contents of the six matrices, read by SciPy alone."""
    points = some_points(7)
    path = write(tmp_path, points, "mat") / "results.mat"
    found = matrices(path)
    order = ["Aclass", "name", "description", "dataInfo", "data_1", "data_2"]
    assert [name for name in found if not name.startswith("__")] == order
    assert ["".join(row).rstrip() for row in found["Aclass"]] == [
        "Atrajectory",
        "1.1",
        "",
        "binTrans",
    ]
    names = [
        "time",
        "wheel.m",
        "wheel.on",
        "wheel.x",
        "wheel.k[1]",
        "box.ratio",
        "box.gear",
        "box.on",
    ]
    assert transposed_texts(found["name"]) == names
    assert transposed_texts(found["description"]) == [
        *("Simulation time [s]", "", "", "[m]", "", "[1/min]", "", "")
    ]
    assert found["dataInfo"].dtype == np.int32
    assert found["dataInfo"].T.tolist() == [
        [0, 1, 0, -1],
        [1, 2, 0, 0],
        [1, 3, 0, 0],
        *([2, row, 0, -1] for row in range(2, 7)),
    ]
    assert found["data_1"].tolist() == [[0.0, points[-1].time], [40.0, 40.0], [1.0, 1.0]]
    time_, outputs = rows_of(START, points)
    assert bits(found["data_2"][0]) == bits(time_)
    assert bits(found["data_2"][1:3].T) == bits(outputs)
    for row, position in ((3, 0), (4, 1), (5, 2)):
        values = [START.discrete[position], *(point.discrete[position] for point in points)]
        assert found["data_2"][row].tolist() == values


def test_a_mat_file_of_a_run_without_variables_and_parameters(tmp_path: Path) -> None:
    """The time alone is a valid file, too."""
    start = RunStart((), (), 0.0, 1.0, np.zeros(0))
    writer = ResultsWriter(tmp_path, {"results": {"formats": ["mat"]}})
    writer.started(start)
    writer.ended(end(Point(1.0, np.zeros(0))))
    found = matrices(tmp_path / "results.mat")
    assert found["data_1"].tolist() == found["data_2"].tolist() == [[0.0, 1.0]]
    assert Result.load(tmp_path).time.tolist() == [0.0, 1.0]


def test_names_beyond_ascii(tmp_path: Path) -> None:
    """UTF-8 in all files."""
    start = RunStart(("s.k·ø", "s.x"), ("Ω", ""), 0.0, 1.0, np.zeros(2))
    writer = ResultsWriter(tmp_path, {"results": {"formats": list(FORMATS)}})
    writer.started(start)
    writer.ended(end())
    for name in FORMATS:
        result = Result.load(tmp_path / FILES[name])
        assert result.names == ("s.k·ø", "s.x")
        assert name == "csv" or result.units["s.k·ø"] == "Ω"


@pytest.mark.parametrize("kind", ["binTrans", "binNormal"])
def test_files_of_dymola_are_read(tmp_path: Path, kind: str) -> None:
    """Both layouts, single precision, an alias with another sign, units, and no constants."""

    def characters(texts: Sequence[str]) -> np.ndarray:
        width = max(map(len, texts))
        return np.array([list(text.ljust(width)) for text in texts])

    names = ["Time", "body.m", "body.x", "body.minus_x", "body.on"]
    about = ["Time in [s]", "Mass [kg]", "Place [m|mm]", "Minus [m]", "State [:#(type=Boolean)]"]
    information = np.array(
        [[0, 1, 0, -1], [1, 2, 0, 0], [2, 2, 0, -1], [2, -2, 0, -1], [2, 3, 0, -1]], np.int32
    )
    one = np.array([[0.0, 40.0], [1.0, 40.0]], np.float32)
    two = np.array([[0.0, 0.25, 0.0], [0.5, -0.5, 1.0], [1.0, 4.0, 1.0]], np.float32)
    turn = (lambda a: np.ascontiguousarray(a.T)) if kind == "binTrans" else (lambda a: a)
    path = tmp_path / "reference.mat"
    savemat(
        path,
        {
            "Aclass": characters(["Atrajectory", "1.1", "", kind]),
            "name": turn(characters(names)),
            "description": turn(characters(about)),
            "dataInfo": turn(information),
            "data_1": turn(one),
            "data_2": turn(two),
        },
        format="4",
    )
    result = Result.load(path)
    assert result.names == ("body.x", "body.minus_x", "body.on")
    assert result.units == {"body.x": "m", "body.minus_x": "m", "body.on": ""}
    assert result.time.tolist() == [0.0, 0.5, 1.0]
    assert result["body.x"].tolist() == [0.25, -0.5, 4.0]
    assert result["body.minus_x"].tolist() == [-0.25, 0.5, -4.0]
    assert result["body.on"].tolist() == [0.0, 1.0, 1.0]


# --- Files of others ----------------------------------------------------------------------------


def test_parquet_of_other_tools(tmp_path: Path) -> None:
    """Single floats, small integers and large texts without any metadata; a gap is NaN."""
    table = pa.table(
        {
            "Time": pa.array([0.0, 1.0]),
            "x": pa.array([1.5, None], pa.float32()),
            "n": pa.array([1, 2], pa.int8()),
            "s": pa.array(["a", "b"], pa.large_string()),
        }
    )
    pq.write_table(table, tmp_path / "other.parquet")
    result = Result.load(tmp_path / "other.parquet")
    assert result.names == ("x",)
    assert np.array_equal(result["x"], [1.5, np.nan], equal_nan=True)
    assert (result["n"].dtype, result["n"].tolist()) == (np.int64, [1, 2])
    assert result["s"].tolist() == ["a", "b"]


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"x": [1.0], "time": [0.0]}, "the first column must be time"),
        ({"time": ["0"]}, "time must be a number"),
        ({"time": [0.0], "x": [[1.0]]}, r"x: values of type list.* are no results"),
        (
            {"time": [0.0], "n": pa.array([None], pa.int64())},
            "n: a value of type integer is missing",
        ),
        ({"time": [0.0], "n": pa.array([2**63], pa.uint64())}, "n: "),
    ],
)
def test_columns_that_are_no_results_are_refused(
    tmp_path: Path, columns: Mapping[str, Any], words: str
) -> None:
    """In Parquet and in Arrow files alike, with the name of the file."""
    table = pa.table(dict(columns))
    pq.write_table(table, tmp_path / "a.parquet")
    with pa.ipc.new_stream(tmp_path / "a.arrow", table.schema) as stream:
        stream.write_table(table)
    for name in ("a.parquet", "a.arrow"):
        with pytest.raises(ResultsError, match=f"{name}: {words}"):
            Result.load(tmp_path / name)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """A small file of each format."""
    directory = write(tmp_path_factory.mktemp("samples"), some_points(4), *FORMATS)
    return {name: (directory / FILES[name]).read_bytes() for name in FORMATS}


@pytest.mark.parametrize("name", FORMATS)
@given(data=st.data())
def test_broken_bytes_load_or_are_refused(
    tmp_path_factory: pytest.TempPathFactory,
    samples: dict[str, bytes],
    name: str,
    data: st.DataObject,
) -> None:
    """Whatever is in the file, the only error is a ``ResultsError``."""
    content = bytearray(samples[name])
    place = st.integers(0, len(content) - 1)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(place)] = data.draw(st.integers(0, 255))
    kept = data.draw(st.one_of(st.just(len(content)), place))
    path = tmp_path_factory.mktemp("broken") / FILES[name]
    path.write_bytes(content[:kept])
    with suppress(ResultsError):
        Result.load(path)


def test_a_file_that_would_fill_the_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few kilobytes of a stranger's can be hundreds of millions of equal values."""
    table = pa.table({"time": np.zeros(10**6), "a.x": np.zeros(10**6)})
    pq.write_table(table, tmp_path / "a.parquet", compression="zstd")
    savemat(tmp_path / "a.mat", {"data_2": np.zeros((2, 10**6))}, do_compression=True)
    assert len(Result.load(tmp_path / "a.parquet").time) == 10**6
    monkeypatch.setattr("master_node.results.files._GROWTH_FREE_BYTES", 0)
    for name in ("a.parquet", "a.mat"):
        assert (tmp_path / name).stat().st_size < 16_000
        with pytest.raises(ResultsError, match="it says that it holds 2000000 values"):
            Result.load(tmp_path / name)


@pytest.mark.parametrize("suffix", [".arrow", ".parquet", ".mat", ".csv"])
def test_a_missing_file_is_an_error_with_a_remedy(tmp_path: Path, suffix: str) -> None:
    """The system's own words, whoever reads."""
    path = tmp_path / f"nowhere{suffix}"
    with pytest.raises(ResultsError, match=r"cannot read .*nowhere.*: No such file.*; name a res"):
        Result.load(path)


def test_a_directory_in_place_of_any_file_is_refused(tmp_path: Path) -> None:
    """``prepare`` finds it before the run."""
    for name in ("results.arrow", "results.parquet", "results.mat", ".results.arrow"):
        directory = tmp_path / name.strip(".")
        (directory / name).mkdir(parents=True)
        with pytest.raises(ResultsError, match=f"{name}: Is a directory"):
            ResultsWriter(directory, settings("csv")).prepare()


# --- Which variables, which points --------------------------------------------------------------

NAMES = ("wheel.x", "wheel.v", "wheel.X", "chassis.x[1]", "chassis.x[2]", "chassis.x1")


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [
        (("*",), NAMES),
        (("wheel.*",), ("wheel.x", "wheel.v", "wheel.X")),
        (("*.x",), ("wheel.x",)),
        (("wheel.?",), ("wheel.x", "wheel.v", "wheel.X")),
        (("chassis.x[1]",), ("chassis.x[1]",)),
        (("chassis.x[*]",), ("chassis.x[1]", "chassis.x[2]")),
        (("!wheel.*",), ("chassis.x[1]", "chassis.x[2]", "chassis.x1")),
        (("wheel.*", "!*.v"), ("wheel.x", "wheel.X")),
        (("!*.v", "wheel.*"), ("wheel.x", "wheel.X")),
        (("chassis.x1", "wheel.v"), ("wheel.v", "chassis.x1")),
    ],
)
def test_patterns(patterns: tuple[str, ...], expected: tuple[str, ...]) -> None:
    """Case counts, brackets are no classes, what is excluded stays out, the order is the run's."""
    found = chosen(patterns, NAMES)
    assert tuple(np.array(NAMES)[found].tolist()) == expected
    check_variables(patterns, NAMES, "car.toml")


@pytest.mark.parametrize(
    ("patterns", "words"),
    [
        (("whel.x",), r"'whel\.x' matches no variable; did you mean 'wheel\.x'"),
        (("*", "!wheel.w"), r"'!wheel\.w' matches no variable; did you mean 'wheel\.[xv]'"),
        (("Wheel.*",), r"'Wheel\.\*' matches no variable"),
        (("wheel.x", "!wheel.*"), "leaves no variable"),
    ],
)
def test_patterns_that_match_nothing_are_mistakes(patterns: tuple[str, ...], words: str) -> None:
    """With the system, the table, the pattern and the nearest names."""
    with pytest.raises(ConfigurationError, match=rf"car\.toml: \[results\] variables.*{words}"):
        check_variables(patterns, NAMES, "car.toml")


@given(
    sizes=st.lists(st.integers(0, 4), max_size=12),
    every=st.integers(1, 7),
    patterns=st.sampled_from([("*",), ("wheel.*",), ("box.*",), ("*.x", "box.on"), ("!*k[1]",)]),
)
def test_what_is_kept_is_every_nth_point_and_the_last(
    sizes: list[int], every: int, patterns: tuple[str, ...]
) -> None:
    """Law: kept = full[::n] and the last, and of each point the chosen columns; all attempts stay.

    The points are spread over attempts in any way, attempts without points among them.
    """
    points = iter(some_points(sum(sizes)))
    attempts = [attempt(*(next(points) for _ in range(size))) for size in sizes]
    full, kept = Recording(), Recording()
    selected = SelectedResults(kept, patterns, every)
    for observer in (full, selected):
        observer.started(START)
        for one in attempts:
            observer.attempted(one)
        observer.ended(end())
    everything, some = full.result(), kept.result()
    n = len(everything.time)
    rows = sorted({*range(0, n, every), n - 1})
    assert bits(some.time) == bits(everything.time[rows])
    assert list(some) == [name for name in everything if chosen(patterns, [name])[0]]
    for name in some:
        assert some[name].tolist() == everything[name][rows].tolist()
        assert some.units[name] == everything.units[name]
    assert some.steps.tolist() == everything.steps.tolist()


def test_a_run_is_the_same_whatever_is_kept(tmp_path: Path) -> None:
    """Choice changes the results, and neither steps, nor counters, nor what other observers see."""
    car = load_system(CAR).with_simulation(stop_time=0.5)

    class Times:
        def __init__(self) -> None:
            self.times: list[float] = []

        def started(self, start: RunStart) -> None:
            self.times = [start.start_time]

        def attempted(self, one: Attempt) -> None:
            self.times += [point.time for point in one.points]

        def ended(self, _: RunEnd) -> None:
            pass

    watcher = Times()
    full = simulate(car, in_process=True, output=tmp_path / "full")
    less = car.with_results(variables=("wheel.*",), every=5, formats=FORMATS)
    kept = simulate(less, in_process=True, output=tmp_path / "kept", observers=[watcher])
    rows = sorted({*range(0, len(full.time), 5), len(full.time) - 1})
    assert kept.names == ("wheel.x", "wheel.v")
    for name in ("time", *kept.names):
        assert bits(kept[name]) == bits(full[name][rows])
    for format_ in FORMATS:
        read = Result.load(tmp_path / "kept" / FILES[format_])
        assert bits(read.time) == bits(kept.time)
        assert bits(read.outputs) == bits(kept.outputs)
    steps = [(tmp_path / name / "steps.csv").read_bytes() for name in ("full", "kept")]
    assert steps[0] == steps[1]
    assert watcher.times == full.time.tolist()
    for key in ("communication_steps", "rejected_double_steps", "round_trips", "do_steps"):
        assert kept.summary[key] == full.summary[key]
    assert kept.summary["formats"] == list(FORMATS)
    assert matrices(tmp_path / "kept" / "results.mat")["data_1"].tolist() == [
        [0.0, 0.5],
        [0.1, 0.1],
    ]


# --- At the prompt ------------------------------------------------------------------------------


def test_the_options_of_a_run(tmp_path: Path) -> None:
    """No results.csv without CSV; ``plot`` and ``compare`` read what there is, whatever it is."""
    runner = CliRunner()
    common = ["run", str(CAR), "--in-process", "--quiet", "--stop-time", "0.2"]
    chosen_ = ["--output-variables", "wheel.*", "--output-variables", "!*.v", "--output-every", "3"]
    runs = {"csv": [], "arrow": [], "parquet": ["--no-plot"], "mat": ["--no-plot"]}
    for format_, more in runs.items():
        output = tmp_path / format_
        done = runner.invoke(
            app, [*common, *chosen_, *more, "--output-format", format_, "--output", str(output)]
        )
        assert done.exit_code == 0, done.output
        files = {FILES[format_], "steps.csv", "summary.json"} | ({"results.png"} - set(more))
        files -= {"results.png"} if more else set()
        assert {path.name for path in output.iterdir()} == files
        assert Result.load(output).names == ("wheel.x",)
        done = runner.invoke(app, ["plot", str(output)])
        assert done.exit_code == 0, done.output
        assert (output / "results.png").read_bytes().startswith(b"\x89PNG")
        done = runner.invoke(app, ["compare", str(output), str(tmp_path / "csv")])
        assert done.exit_code == 0, done.output
        assert "equal bit for bit" in done.output
    both = ["--output-format", "csv", "--output-format", "mat", "--output", str(tmp_path / "both")]
    assert runner.invoke(app, [*common, *both]).exit_code == 0
    assert (tmp_path / "both" / "results.csv").exists()
    assert (tmp_path / "both" / "results.mat").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--output-variables", "whel.x"], "'whel.x' matches no variable; did you mean 'wheel.x'"),
        (["--output-format", "xls"], "'csv', 'arrow', 'parquet' or 'mat'"),
        (["--output-every", "0"], "every = 0: input should be greater than or equal to 1"),
    ],
)
def test_wrong_options_are_mistakes_before_the_first_step(
    tmp_path: Path,
    options: list[str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Exit code 2, the sentence, and no result files."""
    output = tmp_path / "out"
    command = ["master-node", "run", str(CAR), "--in-process", "--output", str(output), *options]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as info:
        main()
    assert info.value.code == 2
    assert words in capsys.readouterr().err
    assert not output.exists() or not list(output.iterdir())


def test_formats_are_imported_when_they_are_asked_for(tmp_path: Path) -> None:
    """A run with CSV, plot included, imports neither pyarrow nor SciPy's files."""
    script = (
        "import sys\n"
        "from master_node import Result, load_system, simulate\n"
        "import master_node.cli.app\n"
        "system = load_system(__import__('pathlib').Path(sys.argv[1]))\n"
        "simulate(system, in_process=True, output=sys.argv[2], stop_time=0.05)\n"
        "Result.load(sys.argv[2])\n"
        "print(sorted({'pyarrow', 'scipy.io'} & sys.modules.keys()))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(CAR), str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
    )
    assert done.stdout == "[]\n", done.stderr


# --- The example --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def example(fmu_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the results of the example, whose FMUs run in processes of their own."""
    folder = tmp_path_factory.mktemp("example")
    (folder / "quarter_car").symlink_to(fmu_dir)
    (folder / "example").mkdir()
    shutil.copy(ROOT / "examples" / "results" / "all_formats.toml", folder / "example")
    system = load_system(folder / "example" / "all_formats.toml")
    simulate(system, output=folder / "results")
    return folder


READERS = re.findall(
    r"^```python\n(.*?)^```$",
    (ROOT / "examples" / "results" / "README.md").read_text(encoding="utf-8"),
    re.MULTILINE | re.DOTALL,
)


@pytest.mark.parametrize("script", READERS, ids=[s.split()[1] for s in READERS])
def test_the_readers_of_the_example_run_as_they_stand(example: Path, script: str) -> None:
    """Those of Doublestep, pyarrow and SciPy, and of the others where they are installed."""
    module = re.split(r"[\s.]", script, maxsplit=2)[1]
    if module in ("pandas", "polars", "DyMat"):
        pytest.importorskip(module)
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=example,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_the_example_keeps_what_it_says(example: Path) -> None:
    """All files, without the variable that is left out, up to the end."""
    result = Result.load(example / "results")
    assert set(FILES.values()) <= {path.name for path in (example / "results").iterdir()}
    assert result.names == ("chassis.x", "wheel.x", "wheel.v")
    assert result.time[-1] == 4.0
    steps = result.summary["communication_steps"]
    assert len(result.time) == 1 + math.ceil(steps / 5)
