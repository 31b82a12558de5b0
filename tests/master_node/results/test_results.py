"""Results: what is written is what happened, and it survives whatever ends the run."""

from __future__ import annotations

import errno
import json
import math
import subprocess
import sys
import textwrap
import tracemalloc
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from master_node.observing.observers import (
    Attempt,
    Observer,
    Outcome,
    Point,
    RunEnd,
    RunStart,
    SlaveStatistics,
    Statistics,
)
from master_node.results import STEPS_DTYPE, Recording, Result, ResultsWriter
from master_node.results import writer as writer_module
from protocol.errors import ResultsError
from tests.support.waiting import BOUND

NAMES = ("wheel.x", "wheel.v", "chassis.x", "chassis.v")
UNITS = ("m", "m/s", "m", "")
SETTINGS = {
    "simulation": {"estimator": "richardson", "order": 2, "largest_step_size": math.inf},
    "slaves": {"wheel": {"fmu": Path("wheel.fmu"), "sha256": "ab" * 32}},
}


def outputs(time: float) -> np.ndarray:
    """Y at a time, computed like everything here from the time alone."""
    return np.array([math.sin(time), math.cos(time), math.exp(-time), time / 3.0])


def start() -> RunStart:
    """A run of two slaves from 0 to 4 s."""
    return RunStart(NAMES, UNITS, 0.0, 4.0, outputs(0.0))


def accepted(time: float, step_size: float, limiting: str = "wheel.v") -> Attempt:
    """A double step to two new points."""
    points = tuple(Point(t, outputs(t)) for t in (time + step_size, time + 2 * step_size))
    return Attempt(time, step_size, 3, 1, 0.25, True, limiting, points)


def rejected(time: float, step_size: float, error_norm: float = 7.5) -> Attempt:
    """An attempt that reached nothing."""
    return Attempt(time, step_size, 3, 1, error_norm, False, "chassis.x")


def end(time: float = 1.0, outcome: Outcome = Outcome.COMPLETED, message: str = "") -> RunEnd:
    """The end of a run, with a different number in each counter."""
    slaves = {
        "wheel": SlaveStatistics(9, 1, 5, 0.25, 0.75),
        "chassis": SlaveStatistics(9, 2, 6, 0.125, 0.125),
    }
    return RunEnd(
        outcome,
        Statistics(
            communication_steps=4,
            rejected_double_steps=1,
            discontinuities=3,
            double_steps_at_discontinuities=7,
            changes_at_smallest_step_size=2,
            round_trips=10,
            wait_time=0.5,
            wall_time=2.0,
            time=time,
            smallest_step_size=0.125,
            largest_step_size=0.25,
            slaves=slaves,
        ),
        message,
    )


ATTEMPTS = (rejected(0.0, 0.5), accepted(0.0, 0.25), accepted(0.5, 0.125))


def drive(observer: Observer, attempts: Iterable[Attempt] = ATTEMPTS) -> None:
    """A whole run."""
    observer.started(start())
    for attempt in attempts:
        observer.attempted(attempt)
    observer.ended(end())


def write(directory: Path, attempts: Iterable[Attempt] = ATTEMPTS) -> Path:
    """A whole run into a directory."""
    writer = ResultsWriter(directory, SETTINGS)
    writer.prepare()
    drive(writer, attempts)
    return directory


def bits(values: np.ndarray) -> bytes:
    """The bytes of the numbers, which tell -0.0 from 0.0."""
    return np.ascontiguousarray(values).tobytes()


def run_python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A second interpreter that has the helpers of this module, and then runs ``code``."""
    preamble = """
        import importlib.util, os, sys
        spec = importlib.util.spec_from_file_location("helpers", sys.argv[1])
        helpers = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(helpers)
        from pathlib import Path
    """
    script = textwrap.dedent(preamble) + textwrap.dedent(code)
    return subprocess.run(
        [sys.executable, "-c", script, __file__, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=BOUND,
    )


# What is in the files


def test_every_communication_point_is_a_row_and_the_first_is_t0(tmp_path: Path) -> None:
    """One row per communication point, T_0 exactly first, columns in the order of the run."""
    lines = (write(tmp_path) / "results.csv").read_text().splitlines()
    assert lines[0] == "time,wheel.x,wheel.v,chassis.x,chassis.v"
    assert lines[1] == "0.0,0.0,1.0,1.0,0.0"
    assert [line.split(",")[0] for line in lines[1:]] == ["0.0", "0.25", "0.5", "0.625", "0.75"]


def test_rejected_attempts_are_steps_but_no_results(tmp_path: Path) -> None:
    """A rejected attempt leaves a line in steps.csv and no trace in results.csv."""
    write(tmp_path)
    assert (tmp_path / "steps.csv").read_text().splitlines() == [
        "time,step_size,order,derivative_points,iterations,error_norm,accepted,limiting_variable",
        "0.0,0.5,3,1,0,7.5,false,chassis.x",
        "0.0,0.25,3,1,0,0.25,true,wheel.v",
        "0.5,0.125,3,1,0,0.25,true,wheel.v",
    ]
    without = write(tmp_path / "without", [a for a in ATTEMPTS if a.accepted])
    assert (tmp_path / "results.csv").read_bytes() == (without / "results.csv").read_bytes()


def test_equal_numbers_give_equal_bytes(tmp_path: Path) -> None:
    """The CSV files depend on nothing but the numbers: no clock, no locale, no numpy repr."""
    other = tuple(
        Attempt(
            np.float64(a.time),
            np.float64(a.step_size),
            a.order,
            a.derivative_points,
            np.float64(a.error_norm),
            a.accepted,
            a.limiting_variable,
            tuple(Point(np.float64(p.time), p.outputs.copy()) for p in a.points),
        )
        for a in ATTEMPTS
    )
    a, b = write(tmp_path / "a"), write(tmp_path / "b", other)
    for name in ("results.csv", "steps.csv"):
        assert (a / name).read_bytes() == (b / name).read_bytes()


@given(st.lists(st.tuples(*[st.floats(width=64)] * 4), min_size=1, max_size=8))
def test_numbers_come_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, ...]]
) -> None:
    """Written and read back, every float has the bits it had: subnormal, huge, -0.0, inf.

    A NaN comes back as a NaN; its payload has no text.
    """
    points = tuple(Point(float(i), np.array(row)) for i, row in enumerate(rows, 1))
    attempt = Attempt(rows[0][0], rows[0][1], 1, 0, rows[0][2], True, "", points)
    result = Result.load(write(tmp_path_factory.mktemp("bits"), [attempt]))
    expected = np.array(rows)
    number = ~np.isnan(expected)
    assert bits(result.outputs[1:][number]) == bits(expected[number])
    assert np.isnan(result.outputs[1:][~number]).all()
    for name, value in zip(("time", "step_size", "error_norm"), rows[0], strict=False):
        read = result.steps[name][0]
        assert bits(read) == bits(np.float64(value)) or (math.isnan(read) and math.isnan(value))


@pytest.mark.parametrize(
    "text", ["a, b", 'say "x"', '"', "two\nlines", "a\r\nb", "", "'quoted name'.der(x)", "k·ø"]
)
def test_any_text_stays_one_field_on_one_line(tmp_path: Path, text: str) -> None:
    """Names and reasons with commas, quotes or line breaks do not break the tables."""
    writer = ResultsWriter(tmp_path, {})
    writer.started(RunStart((f"s.{text}", "s.z"), ("", ""), 0.0, 1.0, np.zeros(2)))
    writer.attempted(Attempt(0.0, 0.1, 0, 0, math.nan, False, text))
    writer.ended(end())
    one_line = text.replace("\r", " ").replace("\n", " ")
    result = Result.load(tmp_path)
    assert result.names == (f"s.{one_line}", "s.z")
    assert result.steps["limiting_variable"].tolist() == [one_line]
    assert len((tmp_path / "steps.csv").read_bytes().splitlines()) == 2


def test_a_system_without_outputs_has_a_time_column_only(tmp_path: Path) -> None:
    """No outputs, m = 0, is a valid number of outputs."""
    writer = ResultsWriter(tmp_path, {})
    writer.started(RunStart((), (), 0.0, 1.0, np.zeros(0)))
    writer.attempted(Attempt(0.0, 0.5, 0, 0, math.nan, True, "", (Point(0.5, np.zeros(0)),)))
    writer.ended(end())
    assert (tmp_path / "results.csv").read_text() == "time\n0.0\n0.5\n"
    result = Result.load(tmp_path)
    assert result.time.tolist() == [0.0, 0.5]
    assert result.outputs.shape == (2, 0)


# The summary


def test_summary_says_what_happened(tmp_path: Path) -> None:
    """Counters, counters per slave, settings with the models' hashes, all under their names."""
    summary = json.loads((write(tmp_path) / "summary.json").read_text())
    expected = {
        "outcome": "completed",
        "message": "",
        "communication_steps": 4,
        "rejected_double_steps": 1,
        "discontinuities": 3,
        "double_steps_at_discontinuities": 7,
        "changes_at_smallest_step_size": 2,
        "do_steps": {"wheel": 9, "chassis": 9},
        "rollbacks": {"wheel": 1, "chassis": 2},
        "requests": {"wheel": 5, "chassis": 6},
        "compute_time": {"wheel": 0.25, "chassis": 0.125},
        "transport_time": {"wheel": 0.5, "chassis": 0.0},
        "round_trips": 10,
        "wall_time": 2.0,
        "wait_time": 0.5,
        "simulated_time": 1.0,
        "estimator": "richardson",
        "order": 2,
        "smallest_step_size": 0.125,
        "largest_step_size": 0.25,
    }
    assert {key: summary[key] for key in expected} == expected
    assert summary["settings"]["slaves"]["wheel"] == {"fmu": "wheel.fmu", "sha256": "ab" * 32}
    assert not list(tmp_path.glob(".*")), "the unfinished summary is renamed, not copied"


def test_summary_is_strict_json(tmp_path: Path) -> None:
    """NaN and inf become null, wherever they are: no parser has to know Python's extensions."""
    settings = {
        **SETTINGS,
        "numpy": np.float64("nan"),
        "deep": ({"array": np.array([1, math.nan])},),
    }
    writer = ResultsWriter(tmp_path, settings)
    writer.started(start())
    writer.ended(RunEnd(Outcome.FAILED, Statistics(), "wheel: lost"))
    text = (tmp_path / "summary.json").read_text()
    summary = json.loads(text, parse_constant=lambda name: pytest.fail(f"not JSON: {name}"))
    assert summary["smallest_step_size"] is None
    assert summary["settings"]["simulation"]["largest_step_size"] is None
    assert summary["settings"]["numpy"] is None
    assert summary["settings"]["deep"] == [{"array": [1.0, None]}]
    assert (summary["outcome"], summary["message"]) == ("failed", "wheel: lost")


# How they are written


def test_memory_does_not_grow_with_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred thousand attempts need no more memory than the lines between two flushes."""
    now = 0.0

    def clock() -> float:  # a flush every five hundred attempts, however slow this machine is
        nonlocal now
        now += 1e-3
        return now

    monkeypatch.setattr(writer_module, "monotonic", clock)
    writer = ResultsWriter(tmp_path, SETTINGS)
    writer.started(start())
    attempt, reason = accepted(0.5, 0.1), "no error norm at t = {}"
    for _ in range(1000):
        writer.attempted(attempt)
    tracemalloc.start()
    try:
        for i in range(100_000):
            text = "wheel.v" if i % 2 else reason.format(i)
            writer.attempted(Attempt(0.5, 0.1, 2, 0, 0.5, True, text, attempt.points))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    writer.ended(end())
    assert peak < 500_000
    assert (tmp_path / "results.csv").stat().st_size > 10_000_000


def test_lines_reach_the_disk_twice_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within 0.5 s nothing is written; the first attempt after that takes all lines with it."""
    now = 100.0
    monkeypatch.setattr(writer_module, "monotonic", lambda: now)
    writer = ResultsWriter(tmp_path, {})
    writer.started(start())
    assert (tmp_path / "results.csv").read_text().count("\n") == 2, "T_0 is there at once"
    now = 100.49
    writer.attempted(accepted(0.0, 0.25))
    assert (tmp_path / "results.csv").read_text().count("\n") == 2
    now = 100.5
    writer.attempted(accepted(0.5, 0.25))
    assert (tmp_path / "results.csv").read_text().count("\n") == 6
    assert (tmp_path / "steps.csv").read_text().count("\n") == 3
    assert not (tmp_path / "summary.json").exists()
    writer.ended(end())


def test_killed_writer_leaves_whole_lines(tmp_path: Path) -> None:
    """A master that dies without a word leaves files that load, complete to the last flush."""
    process = run_python(
        """
        writer = helpers.ResultsWriter(Path(sys.argv[2]), {})
        helpers.writer_module.FLUSH_INTERVAL = 0.02
        writer.started(helpers.start())
        for i in range(10**9):
            writer.attempted(helpers.accepted(i * 0.5, 0.25))
            if i % 1000 == 0 and Path(sys.argv[2], "results.csv").stat().st_size > 2_000_000:
                writer.attempted(helpers.accepted(i * 0.5, 0.25))
                os._exit(9)
        """,
        str(tmp_path),
    )
    assert process.returncode == 9, process.stderr
    assert (tmp_path / "results.csv").read_bytes().endswith(b"\n")
    assert (tmp_path / "steps.csv").read_bytes().endswith(b"\n")
    result = Result.load(tmp_path)
    assert result.summary == {}
    assert len(result.time) > 10_000
    assert len(result.time) == 1 + 2 * len(result.steps)
    assert np.array_equal(result.time, 0.25 * np.arange(len(result.time)))
    assert np.array_equal(result["wheel.x"], [math.sin(t) for t in result.time])
    assert "without an end" in repr(result)


@pytest.mark.skipif(sys.platform == "win32", reason="the limit on file sizes is POSIX")
def test_full_disk_leaves_readable_results(tmp_path: Path) -> None:
    """A write that the system cuts short is undone: the file ends with its last whole batch."""
    process = run_python(
        """
        import resource
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
        helpers.writer_module.FLUSH_INTERVAL = 0.0
        writer = helpers.ResultsWriter(Path(sys.argv[2]), {})
        writer.started(helpers.start())
        try:
            for i in range(10_000):
                writer.attempted(helpers.accepted(i * 0.5, 0.25))
        except helpers.ResultsError as error:
            print(error.exit_code, error)
        writer.ended(helpers.end(outcome=helpers.Outcome.FAILED))
        """,
        str(tmp_path),
    )
    assert process.returncode == 0, process.stderr
    assert process.stdout.startswith("7 cannot write")
    assert f"{tmp_path / 'results.csv'}: File too large; choose" in process.stdout
    assert 99_000 < (tmp_path / "results.csv").stat().st_size <= 100_000
    result = Result.load(tmp_path)
    assert np.array_equal(result.time, 0.25 * np.arange(len(result.time)))
    assert result.summary["outcome"] == "failed", "the summary, small enough, was still written"


def test_interrupted_write_is_repeated_not_doubled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full for a while costs no line and doubles none, once there is room."""
    monkeypatch.setattr(writer_module, "FLUSH_INTERVAL", 0.0)
    writer = ResultsWriter(tmp_path, {})
    writer.started(start())
    file = writer._results[0]._file

    class Full:
        def __getattr__(self, name: str) -> object:
            return getattr(file, name)

        def write(self, data: memoryview) -> int:
            if len(data) < 30:
                raise OSError(errno.ENOSPC, "No space left on device")
            return file.write(data[:17])

    monkeypatch.setattr(writer._results[0], "_file", Full())
    with pytest.raises(ResultsError, match=r"results\.csv: No space left on device; free space"):
        writer.attempted(accepted(0.0, 0.25))
    assert Result.load(tmp_path).time.tolist() == [0.0]
    monkeypatch.setattr(writer._results[0], "_file", file)
    writer.ended(end())
    assert Result.load(tmp_path).time.tolist() == [0.0, 0.25, 0.5]


@pytest.mark.skipif(sys.platform == "win32", reason="the limit on file sizes is POSIX")
def test_disk_full_from_the_start_is_told_at_once(tmp_path: Path) -> None:
    """The first flush is in ``started``; the end of such a run has nothing to add, no open file."""
    process = run_python(
        """
        import resource, warnings
        warnings.simplefilter("error")
        resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10))
        writer = helpers.ResultsWriter(Path(sys.argv[2]), {})
        try:
            writer.started(helpers.start())
        except helpers.ResultsError as error:
            print(error)
        writer.ended(helpers.end())
        del writer
        """,
        str(tmp_path),
    )
    assert (process.returncode, process.stderr) == (0, "")
    assert "results.csv: File too large" in process.stdout
    assert (tmp_path / "results.csv").read_bytes() == b""


# Where they are written


def test_directory_below_a_file_is_refused_before_the_run(tmp_path: Path) -> None:
    """``prepare`` names the place that cannot be written, with the exit code of results."""
    (tmp_path / "file").write_text("mine")
    for directory in (tmp_path / "file", tmp_path / "file" / "deeper" / "out"):
        with pytest.raises(ResultsError, match=f"cannot write {directory}: .*; ") as caught:
            ResultsWriter(directory, {}).prepare()
        assert caught.value.exit_code == 7
        assert caught.value.remedy
    assert (tmp_path / "file").read_text() == "mine"


def test_directory_in_place_of_a_file_is_refused(tmp_path: Path) -> None:
    """A directory called results.csv is found by ``prepare``, not at the first row."""
    (tmp_path / "results.csv").mkdir()
    with pytest.raises(ResultsError, match=r"results\.csv: Is a directory"):
        ResultsWriter(tmp_path, {}).prepare()


def test_lost_directory_is_an_error_at_the_end(tmp_path: Path) -> None:
    """Unwritten files are told, even when it is only the summary."""
    writer = ResultsWriter(tmp_path / "out", {})
    writer.started(start())
    (tmp_path / "out").rename(tmp_path / "moved")
    with pytest.raises(ResultsError, match=r"summary\.json: No such file"):
        writer.ended(end())
    assert len(Result.load(tmp_path / "moved").time) == 1


def test_old_results_are_replaced_and_other_files_stay(tmp_path: Path) -> None:
    """A run that did not get to its end never shows the summary or the plot of an older one."""
    directory = write(tmp_path / "a" / "b")
    (directory / "results.png").write_text("old plot")
    (directory / "notes.txt").write_text("mine")
    writer = ResultsWriter(directory, {})
    writer.prepare()
    assert Result.load(directory).summary, "until the run starts, the old results stay"
    writer.started(start())
    now = {path.name for path in directory.iterdir()}
    assert now == {".start.json", "notes.txt", "results.csv", "steps.csv"}
    assert Result.load(directory).time.tolist() == [0.0]
    writer.ended(end())
    now = {path.name for path in directory.iterdir()}
    assert now == {"notes.txt", "results.csv", "steps.csv", "summary.json"}


def test_end_without_a_start_writes_nothing(tmp_path: Path) -> None:
    """A writer whose run never started has nothing to say and leaves old results alone."""
    write(tmp_path)
    before = (tmp_path / "results.csv").read_bytes()
    ResultsWriter(tmp_path, {}).ended(end())
    assert (tmp_path / "results.csv").read_bytes() == before


# What a user gets


def test_recording_equals_what_is_written(tmp_path: Path) -> None:
    """A run in memory has the numbers and the summary of one through files."""
    recording = Recording(SETTINGS)
    drive(recording)
    recorded, loaded = recording.result(), Result.load(write(tmp_path))
    assert recorded.names == loaded.names == NAMES
    assert recorded.units == loaded.units == dict(zip(NAMES, UNITS, strict=True))
    assert bits(recorded.time) == bits(loaded.time)
    assert bits(recorded.outputs) == bits(loaded.outputs)
    assert recorded.steps.dtype == loaded.steps.dtype
    assert recorded.steps.tolist() == loaded.steps.tolist()
    assert recorded.summary == loaded.summary


def test_recording_can_be_read_at_any_time() -> None:
    """A result is a copy: what comes later changes the next one only."""
    recording = Recording()
    with pytest.raises(ResultsError, match="did not start"):
        recording.result()
    recording.started(start())
    first = recording.result()
    recording.attempted(rejected(0.0, 0.5, math.inf))
    recording.attempted(accepted(0.0, 0.25))
    second = recording.result()
    assert (len(first.time), len(first.steps), first.summary) == (1, 0, {})
    assert (len(second.time), len(second.steps)) == (3, 2)
    recording.started(start())
    assert len(recording.result().time) == 1, "a second run starts anew"


def test_result_is_indexed_by_name() -> None:
    """A variable is a one-dimensional float64 array over ``time``; ``to_array`` has them all."""
    recording = Recording()
    drive(recording)
    result = recording.result()
    wheel = result["wheel.x"]
    assert wheel.shape == result.time.shape == (5,)
    assert wheel.dtype == np.float64
    assert wheel.flags.c_contiguous
    assert wheel.tolist() == [math.sin(t) for t in result.time]
    assert result["time"] is result.time
    assert list(result) == list(NAMES)
    assert "wheel.x" in result
    assert "wheel" not in result
    table = result.to_array()
    assert table.dtype.names == ("time", *NAMES)
    assert bits(table["chassis.x"]) == bits(result["chassis.x"])
    assert result.steps[~result.steps["accepted"]]["step_size"].tolist() == [0.5]


@pytest.mark.parametrize(
    ("name", "hint"),
    [("weel.x", "wheel.x"), ("v", r"wheel\.v or chassis\.v"), ("zzz", "see result.names")],
)
def test_unknown_variable_names_the_nearest(name: str, hint: str) -> None:
    """A typing error costs one look, not a search."""
    recording = Recording()
    drive(recording)
    with pytest.raises(KeyError, match=f"no variable {name}; .*{hint}"):
        recording.result()[name]


def test_repr_is_for_people() -> None:
    """It says how the run ended, how large it is and what is in it."""
    recording = Recording()
    drive(recording)
    text = repr(recording.result())
    assert "completed: 5 result points from 0 to 0.75 s, 3 attempts, 1 rejected" in text
    assert "wheel.v [m/s], chassis.x [m], chassis.v>" in text


# Loading what others wrote, or broke


def put(directory: Path, lines: Sequence[str], name: str = "results.csv") -> Path:
    """A file as another program or a crash left it."""
    (directory / name).write_bytes("\n".join(lines).encode())
    return directory


def test_unfinished_last_line_is_left_out(tmp_path: Path) -> None:
    """Without its line break a last number may be cut: 0.12 of 0.125 is no result."""
    put(tmp_path, ["time,a.x", "0.0,1.0", "0.5,0.12"])
    put(tmp_path, [",".join(STEPS_DTYPE.names), "0.0,0.5,1,0,0,0.1,tr"], "steps.csv")
    result = Result.load(tmp_path)
    assert result.time.tolist() == [0.0]
    assert len(result.steps) == 0


def test_csv_of_other_tools(tmp_path: Path) -> None:
    """One file of another tool: byte order mark, CRLF, quoted names, no last line break."""
    path = tmp_path / "reference.csv"
    path.write_bytes(b'\xef\xbb\xbf"time","a.x, y"\r\n0,1\r\n1e0, 2.5\r\n\r\n2,3')
    result = Result.load(path)
    assert result.names == ("a.x, y",)
    assert result.time.tolist() == [0.0, 1.0, 2.0]
    assert result["a.x, y"].tolist() == [1.0, 2.5, 3.0]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["time,a.x", "0.0,1.0", "0.5,abc", ""], r"results\.csv, line 3: expected 2 numbers.*abc"),
        (["time,a.x", "0.0,1.0", "0.5", ""], r"results\.csv, line 3: expected 2 numbers, found 1"),
        (["time,a.x", "0.0,1.0,2.0", ""], r"results\.csv, line 2: expected 2 numbers, found 3"),
        (["x,time", ""], r"results\.csv, line 1: the first column must be time"),
        (["time,a,a", ""], r"results\.csv, line 1: two columns"),
        ([""], r"results\.csv, line 1: the first column"),
    ],
)
def test_malformed_results_name_file_and_line(
    tmp_path: Path, lines: Sequence[str], message: str
) -> None:
    """Whoever edited the file learns where."""
    with pytest.raises(ResultsError, match=message):
        Result.load(put(tmp_path, lines))


@pytest.mark.parametrize(
    ("name", "lines", "message"),
    [
        ("steps.csv", ["time,H", ""], r"steps\.csv, line 1: the columns must be time,step_size"),
        ("steps.csv", [None, "0.0,0.1,1,0,0,0.5,maybe,x", ""], r"steps\.csv, line 2: .*maybe"),
        ("steps.csv", [None, "0.0,0.1", ""], r"steps\.csv, line 2: expected an attempted step"),
        ("summary.json", ["{", '"a": nope', "}"], r"summary\.json, line 2: Expecting value"),
        ("summary.json", ["[]"], r"summary\.json, line 1: expected a JSON object"),
    ],
)
def test_malformed_companions_name_file_and_line(
    tmp_path: Path, name: str, lines: Sequence[str | None], message: str
) -> None:
    """The other two files are held to the same."""
    put(tmp_path, ["time,a.x", "0.0,1.0", ""])
    header = ",".join(STEPS_DTYPE.names)
    put(tmp_path, [header if line is None else line for line in lines], name)
    with pytest.raises(ResultsError, match=message):
        Result.load(tmp_path)


def test_no_results_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    """An empty directory and a missing one are told apart from broken files."""
    for source in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ResultsError, match=r"cannot read .*: No such file.*; name a results"):
            Result.load(source)


@given(st.binary(max_size=200))
def test_any_bytes_load_or_are_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    """Whatever is in the file, the only error is a ``ResultsError``."""
    directory = tmp_path_factory.mktemp("any")
    (directory / "results.csv").write_bytes(b"time,a.x\n" + content)
    (directory / "steps.csv").write_bytes(",".join(STEPS_DTYPE.names).encode() + b"\n" + content)
    (directory / "summary.json").write_bytes(b"{" + content)
    for name in ("summary.json", "steps.csv", "results.csv"):
        try:
            Result.load(directory)
        except ResultsError:
            (directory / name).unlink()
