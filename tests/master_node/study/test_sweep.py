"""Studies: which runs they are, that each is what it says, and that nothing is lost or done twice.

Runs are real processes, and so are the workers of the Dask cluster.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from master_node import Result, load_system, simulate
from master_node.numerics.reductions import REDUCTIONS
from master_node.numerics.samples import latin_hypercube, spaced
from master_node.study.case import apply_case, read_case, write_case
from master_node.study.cases import cases_of
from master_node.study.configuration import Study, load_study
from master_node.study.directory import StudyDirectory
from master_node.study.plan import PlannedRun, make_plan
from master_node.study.records import RunRecord, read_record, write_record
from protocol.errors import ConfigurationError, ResultsError
from protocol.host.processes import ending_signals
from tests.support.places import SUPPORT
from tests.support.quarter_car_case import DISPLACEMENT, EXAMPLES
from tests.support.waiting import BOUND, is_quick, wait_until

pytestmark = pytest.mark.skipif(os.name != "posix", reason="uses signals")


MODELS = SUPPORT / "quarter_car_models.py"


def car(
    folder: Path,
    chassis: str = f"{EXAMPLES / 'quarter_car.py'}:Chassis",
    connections: Sequence[tuple[str, str]] = DISPLACEMENT,
) -> Path:
    """The quarter car as a system file, for 0.02 s."""
    path = folder / "car.toml"
    tables: dict[str, Any] = {
        "simulation": {"stop_time": 0.02, "initial_step_size": 1e-3},
        "slaves": {
            "chassis": {"model": chassis},
            "wheel": {"model": f"{EXAMPLES / 'quarter_car.py'}:Wheel"},
        },
        "connections": [{"from": source, "to": target} for source, target in connections],
    }
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return path


def study_file(folder: Path, text: str) -> Path:
    """A study of ``car.toml``, in process but where it says otherwise."""
    path = folder / "study.toml"
    if "[run]" not in text:
        text += "\n[run]\nin_process = true\n"
    path.write_text(f'system = "car.toml"\n{text}', encoding="utf-8")
    return path


def cases(text: str, base: Path | None = None) -> list[dict[str, Any]]:
    """The cases of a study file with this text."""
    import tomllib  # noqa: PLC0415  here only

    tables = tomllib.loads(text)
    study = Study(system="car.toml", base=base or Path.cwd(), **tables)
    return [dict(case) for case in cases_of(study)]


# ---- Which runs ---------------------------------------------------------------------------------


def test_a_grid_has_every_combination_once_and_the_last_varies_fastest() -> None:
    """Lists, ranges and single values; both ends of a range belong to it, bit for bit."""
    found = cases("""
    [parameters]
    "a.x" = { from = 0.1, to = 0.7, number = 3 }
    "b.y" = true
    "b.z" = [1, "two"]
    "c.copy" = { same_as = "a.x" }
    """)
    assert [(case["a.x"], case["b.z"]) for case in found] == [
        (x, z) for x in (0.1, pytest.approx(0.4), 0.7) for z in (1, "two")
    ]
    assert all(case["b.y"] is True and case["c.copy"] == case["a.x"] for case in found)
    assert list(found[0]) == ["a.x", "b.y", "b.z", "c.copy"]
    assert (found[0]["a.x"], found[-1]["a.x"]) == (0.1, 0.7)


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6), st.integers(2, 50), st.booleans())
def test_neighbours_in_a_range_have_equal_distances_or_ratios(
    begin: float, end: float, number: int, logarithmic: bool
) -> None:
    """Law of `spaced`, both directions; no value is outside."""
    values = spaced(begin, end, number, logarithmic=logarithmic)
    assert (values[0], values[-1], len(values)) == (begin, end, number)
    assert ((min(begin, end) <= values) & (values <= max(begin, end))).all()
    steps = np.diff(np.log(values) if logarithmic else values)
    assert steps == pytest.approx(steps.mean(), abs=1e-9 * max(begin, end, 1.0))


@given(st.integers(1, 60), st.integers(1, 4), st.integers(0, 2**32))
def test_a_latin_hypercube_has_one_value_in_each_part_of_each_range(
    number: int, dimension: int, seed: int
) -> None:
    """The law that gives it its name, for linear and logarithmic ranges; and the seed decides."""
    begin, end = np.full(dimension, 2.0), np.full(dimension, 32.0)
    logarithmic = np.arange(dimension) % 2 == 1
    rows = latin_hypercube(number, seed, begin, end, logarithmic)
    assert rows.shape == (number, dimension)
    for column, is_logarithmic in zip(rows.T, logarithmic, strict=True):
        unit = np.log(column / 2.0) / np.log(16.0) if is_logarithmic else (column - 2.0) / 30.0
        parts = np.sort(np.floor(unit * number + 1e-9 * (unit < 0.5)).astype(int))
        assert parts.tolist() == list(range(number))
    assert latin_hypercube(number, seed, begin, end, logarithmic).tolist() == rows.tolist()
    assert latin_hypercube(number, seed + 1, begin, end, logarithmic).tolist() != rows.tolist()


def test_a_sample_varies_the_ranges_and_keeps_the_rest() -> None:
    """Single values are the same in all runs, ``same_as`` follows what was drawn."""
    text = """
    [parameters]
    "a.x" = { from = 1, to = 2 }
    "a.y" = 7
    "b.x" = { same_as = "a.x" }
    [sample]
    kind = "latin-hypercube"
    number = 5
    seed = 3
    """
    found = cases(text)
    assert len({case["a.x"] for case in found}) == len(found) == 5
    assert all(case["a.y"] == 7 and case["b.x"] == case["a.x"] for case in found)
    assert cases(text) == found


@pytest.mark.parametrize(
    ("row", "values"),
    [
        ("from = 1, to = 3, number = 3", [1, 2, 3]),
        ("from = 10, to = -10, number = 5", [10, 5, 0, -5, -10]),
        ("from = 1, to = 100, number = 3, spacing = 'logarithmic'", [1, 10, 100]),
        ("from = 1, to = 1000, number = 4, spacing = 'logarithmic'", [1, 10, 100, 1000]),
        ("from = 8, to = 27, number = 4, spacing = 'logarithmic'", [8, 12, 18, 27]),
        ("from = 1, to = 2, number = 3", [1.0, 1.5, 2.0]),
        ("from = 1, to = 3, number = 3, spacing = 'logarithmic'", [1.0, 3.0**0.5, 3.0]),
        ("from = 1.0, to = 3, number = 3", [1.0, 2.0, 3.0]),
    ],
)
def test_a_range_of_whole_numbers_has_whole_numbers(
    tmp_path: Path, row: str, values: list[float]
) -> None:
    """Where its ends are whole and all between them is; any Integer takes either."""
    (tmp_path / "study.toml").write_text(
        f'system = "s.toml"\n[parameters]\n"a.n" = {{ {row} }}\n', encoding="utf-8"
    )
    found = [case["a.n"] for case in cases_of(load_study(tmp_path / "study.toml"))]
    assert found == pytest.approx(values, rel=1e-12)
    assert [type(value) for value in found] == [type(value) for value in values]


def test_cases_in_a_file_are_taken_row_by_row(tmp_path: Path) -> None:
    """Numbers, booleans and texts; an empty cell leaves what the system has."""
    (tmp_path / "cases.csv").write_text(
        'a.x,b.name, simulation.order\n1e3,"hard, dry",auto\n\n2,,3\n', encoding="utf-8"
    )
    assert cases('[cases]\nfile = "cases.csv"', tmp_path) == [
        {"a.x": 1000.0, "b.name": "hard, dry", "simulation.order": "auto"},
        {"a.x": 2, "simulation.order": 3},
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a.x\n1,2\n", "cases.csv, line 2: 2 cells for 1 columns"),
        ("a.x,a.x\n1,2\n", "cases.csv, line 1: two columns are called 'a.x'"),
        ("x\n1\n", "cases.csv, line 1: 'x': write slave.variable or simulation.key"),
        ("", "cases.csv, line 1: there is no column"),
        ("a.x\n", "cases.csv: there is no row with a case"),
        ("a.x\nnan\n", "cases.csv, line 2: a.x = nan: must be finite"),
        ("a.x\n[1]\n", "cases.csv, line 2: a.x = [1]: must be a number, a boolean or a string"),
        ('a.x\n"1\n', "cases.csv: not a CSV file: unexpected end of data"),
        (None, "cannot be read: No such file or directory"),
    ],
)
def test_a_mistake_in_a_file_of_cases_is_named(
    tmp_path: Path, text: str | None, words: str
) -> None:
    """With file and line."""
    if text is not None:
        (tmp_path / "cases.csv").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError) as info:
        cases('[cases]\nfile = "cases.csv"', tmp_path)
    assert words in str(info.value)


def test_a_case_goes_through_its_file(tmp_path: Path) -> None:
    """Values and types are the same, and the system has them, also a slave with a dot."""
    case = {"wheel.z": 0.1, "wheel.n": 3, "b.c.on": True, "simulation.stop_time": 5.0}
    write_case(tmp_path / "case.toml", case)
    assert read_case(tmp_path / "case.toml") == case
    (tmp_path / "car.toml").write_text(
        '[slaves.wheel]\nparameters = { z = 7, m = 40 }\n[slaves."b.c"]\n[slaves.b]\n'
    )
    system = apply_case(load_system(tmp_path / "car.toml"), case)
    assert system.slaves["wheel"].parameters == {"z": 0.1, "m": 40, "n": 3}
    assert system.slaves["b.c"].parameters == {"on": True}
    assert system.slaves["b"].parameters == {}
    assert system.simulation.stop_time == 5.0
    (tmp_path / "case.toml").write_text("[slaves]\n")
    with pytest.raises(ConfigurationError, match="not a case"):
        read_case(tmp_path / "case.toml")


# ---- Mistakes are found before anything starts --------------------------------------------------

GRID = '[parameters]\n"wheel.z" = [0.1, 0.2]\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "there is nothing to vary"),
        ("[paramters]\n" + GRID, "unknown key 'paramters'; did you mean 'parameters'?"),
        (GRID + "[runs]\nplot = true", "unknown key 'runs'; did you mean 'run'?"),
        (GRID + "[run]\ninproces = true", "[run] unknown key 'inproces'; did you mean 'in_proce"),
        (GRID + "[run]\ntimeout = 0", "[run] timeout = 0: input should be greater than 0"),
        ('[parameters]\n"z" = [1]', "write slave.variable"),
        ('[parameters]\n"wheel.z" = []', "at least 1 item"),
        ('[parameters]\n"wheel.z" = [inf]', "must be finite"),
        ('[parameters]\n"wheel.z" = {from = 1, to = 2}', '"wheel.z": number is missing'),
        (
            '[parameters]\n"wheel.z" = {from = 1, to = 2, number = 1}',
            "[parameters.wheel.z] number = 1: input should be greater than or equal to 2",
        ),
        (
            '[parameters]\n"wheel.z" = {from = 1, too = 2, number = 2}',
            "[parameters.wheel.z] unknown key 'too'; did you mean 'to'",
        ),
        ('[parameters]\n"wheel.z" = {from = 1, to = 1, number = 2}', "are the same"),
        (
            '[parameters]\n"wheel.z" = {from = 0, to = 1, number = 2, spacing = "logarithmic"}',
            "a logarithmic range needs from and to above 0",
        ),
        (
            GRID + '"chassis.k" = { same_as = "wheel.zz" }',
            "same_as = 'wheel.zz': no parameter with values; did you mean 'wheel.z'?",
        ),
        (
            GRID + '[sample]\nkind = "latin-hypercube"\nnumber = 2\nseed = 1',
            '"wheel.z": a sample is drawn from ranges',
        ),
        (GRID + '[cases]\nfile = "c.csv"', "[cases] stands alone"),
        (GRID + '[run]\nneeds = ["dymola"]', "there is no licence 'dymola'"),
        (
            GRID + '[resources]\nlicences = { dymola = 1 }\n[run]\nneeds = ["dymola", "dymola"]',
            "a run needs 2 licences 'dymola', and there are 1",
        ),
        (
            GRID + '[results.outputs]\nx = { variable = "chassis.x", reduce = "maximum" }',
            "must be one of 'first', 'last', 'min', 'max'",
        ),
        (GRID + '[results.outputs]\n"a,b" = { variable = "a.x", reduce = "max" }', "not a valid"),
        (
            '[parameters]\n"a.x" = {from = 1, to = 2, number = 400}\n'
            '"a.y" = {from = 1, to = 2, number = 400}',
            "[parameters] make 160000 runs, more than 100000",
        ),
        # what only the system and the models can tell
        ('[parameters]\n"weel.z" = [1]', "run 1: {car}: 'weel.z': no slave 'weel'; did you mean"),
        ('[parameters]\n"wheel.zz" = [1]', "'zz': no such variable; did you mean 'z'?"),
        (
            '[parameters]\n"simulation.order" = [1, 2, 9]',
            "run 3: {car}: [simulation] order = 9",
        ),
        (
            '[parameters]\n"simulation.relativ_tolerance" = [1]',
            "[simulation] unknown key 'relativ_tolerance'; did you mean 'relative_tolerance'",
        ),
        ('[parameters]\n"simulation.stop_time" = [-1.0]', "stop_time -1 must be after"),
        (
            GRID + '[results.outputs]\nx = { variable = "chassis.y", reduce = "max" }',
            "[results.outputs.x] variable = 'chassis.y': no such output; did you mean 'chassis.x'",
        ),
        (
            GRID + '[results.outputs]\noutcome = { variable = "chassis.x", reduce = "max" }',
            "a column of the table has this name already",
        ),
    ],
)
def test_a_mistake_is_found_before_anything_starts(tmp_path: Path, text: str, words: str) -> None:
    """The message names the file and the place, and the nearest names; nothing is written."""
    path = car(tmp_path)
    file = study_file(tmp_path, text)
    done = sweep(file, tmp_path / "out")
    assert done.code == 2, done.text
    assert f"master-node: {file}: " in done.text
    assert words.replace("{car}", str(path)) in done.text
    assert not (tmp_path / "out").exists()


def test_a_system_whose_slaves_are_not_started_cannot_be_swept(tmp_path: Path) -> None:
    """Runs beside each other would take the same slave."""
    path = car(tmp_path)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("[slaves.wheel]\nmodel", "[slaves.wheel]\n#"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"\[slaves.wheel\] has no model"):
        make_plan(load_study(study_file(tmp_path, GRID)))


def test_the_fingerprint_is_of_what_the_results_depend_on(tmp_path: Path) -> None:
    """It changes with parameter, setting, model and table, and not with addresses or names."""
    model = tmp_path / "model.py"
    source = (EXAMPLES / "quarter_car.py").read_text(encoding="utf-8")
    model.write_text(source, encoding="utf-8")
    table = tmp_path / "road.csv"
    table.write_text("time,z\n0,0\n1,1\n")
    path = car(tmp_path, f"{model}:Chassis", DISPLACEMENT[1:])
    text = path.read_text(encoding="utf-8") + '\n[inputs]\n"wheel.x_c" = { table = "road.csv" }\n'

    def prints(system: str, study: str = GRID) -> list[str]:
        path.write_text(system, encoding="utf-8")
        return [run.fingerprint for run in make_plan(load_study(study_file(tmp_path, study))).runs]

    first, second = prints(text)
    assert first != second
    assert prints(text + "[bus]\nstep_timeout = 3\n") == [first, second]
    assert prints(text, GRID.replace("0.1, ", "")) == [second]
    assert prints(text, GRID + "[run]\nplot = true\n") == [first, second]
    assert set(prints(text.replace("0.02", "0.03"))).isdisjoint({first, second})
    table.write_text("time,z\n0,0\n1,2\n")
    assert set(prints(text)).isdisjoint({first, second})
    table.write_text("time,z\n0,0\n1,1\n")
    assert prints(text) == [first, second]
    model.write_text(source.replace("400.0", "401.0"), encoding="utf-8")
    changed = run_python(f"""
        from pathlib import Path
        from master_node.study.configuration import load_study
        from master_node.study.plan import make_plan
        print(*[run.fingerprint for run in make_plan(load_study(Path({str(path)!r}).with_name(
            'study.toml'))).runs])
    """)
    assert set(changed.split()).isdisjoint({first, second})


def test_a_package_has_the_same_fingerprint_wherever_it_is_extracted(
    quarter_car_ssp: Path, tmp_path: Path
) -> None:
    """Systems of SSP can be swept, and a sweep of one can be continued."""
    study = Study(
        system=str(quarter_car_ssp),
        parameters={"simulation.relative_tolerance": (1e-3, 1e-4)},
        base=tmp_path,
    )
    assert make_plan(study).runs == make_plan(study).runs
    assert len({run.fingerprint for run in make_plan(study).runs}) == 2


# ---- Numbers out of courses ---------------------------------------------------------------------

COURSES = st.lists(st.tuples(st.floats(0.01, 10.0), st.floats(-1e3, 1e3)), min_size=2, max_size=20)


@pytest.mark.parametrize("name", REDUCTIONS)
@given(course=COURSES, data=st.data())
def test_points_on_the_straight_lines_change_no_number(
    name: str, course: list[tuple[float, float]], data: st.DataObject
) -> None:
    """Law: it depends on the course and not on where the communication points are."""
    time = np.cumsum([step for step, _ in course])
    values = np.array([value for _, value in course])
    more = data.draw(st.lists(st.floats(time[0], time[-1]), max_size=10))
    finer = np.unique([*time, *more])
    expected = REDUCTIONS[name](time, values)
    found = REDUCTIONS[name](finer, np.interp(finer, time, values))
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_the_reductions_of_a_known_course() -> None:
    """A ramp from -1 to 3 within 2 s, from integrals by hand."""
    time, values = np.array([1.0, 3.0]), np.array([-1.0, 3.0])
    found = {name: reduce(time, values) for name, reduce in REDUCTIONS.items()}
    known = {"first": -1, "last": 3, "min": -1, "max": 3, "max_abs": 3, "integral": 2, "mean": 1}
    assert found == pytest.approx(known | {"rms": np.sqrt(7.0 / 3.0)})


@pytest.mark.parametrize("name", sorted(set(REDUCTIONS) - {"first", "last"}))
def test_a_value_that_is_not_a_number_shows_in_the_result(name: str) -> None:
    """NaN never passes."""
    assert np.isnan(REDUCTIONS[name](np.array([0.0, 1.0, 2.0]), np.array([0.0, np.nan, 1.0])))


# ---- Sweeps -------------------------------------------------------------------------------------


@dataclasses.dataclass
class Done:
    """A command that has ended."""

    code: int
    text: str


def run_python(script: str) -> str:
    """Output of a script in a process of its own."""
    import textwrap  # noqa: PLC0415  here only

    words = [sys.executable, "-c", textwrap.dedent(script)]
    return subprocess.run(words, capture_output=True, text=True, timeout=BOUND, check=True).stdout


def invoke(*words: object) -> Done:
    """``master-node`` with these words, in this process."""
    from typer.testing import CliRunner  # noqa: PLC0415  here only

    from master_node.cli.app import app  # noqa: PLC0415
    from protocol.errors import DoublestepError  # noqa: PLC0415

    kept = {number: signal.getsignal(number) for number in ending_signals()}
    try:
        result = CliRunner().invoke(app, [*map(str, words)], env={"COLUMNS": "500"})
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
    if isinstance(result.exception, DoublestepError):
        return Done(result.exception.exit_code, f"master-node: {result.exception}")
    return Done(result.exit_code, result.output)


def sweep(file: Path, output: Path, *words: object, in_this_process: bool = True) -> Done:
    """``master-node sweep``, to its end."""
    arguments = ["sweep", file, "--output", output, *words]
    if in_this_process:
        return invoke(*arguments)
    done = subprocess.run(
        [sys.executable, "-m", "master_node", *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=2 * BOUND,
        env={**os.environ, "COLUMNS": "500"},
        check=False,
    )
    return Done(done.returncode, done.stdout + done.stderr)


def rows(output: Path) -> list[dict[str, str]]:
    """The table of results."""
    with (output / "study.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def identities(output: Path) -> dict[str, int]:
    """Identities of the files ``run.json``: a run that was executed again has another one."""
    return {path.name: (path / "run.json").stat().st_ino for path in (output / "runs").iterdir()}


OUTPUTS = """
[results.outputs]
highest = { variable = "wheel.x", reduce = "max" }
end = { variable = "chassis.x", reduce = "last" }
"""


@pytest.mark.usefixtures("no_process_left")
def test_each_run_is_the_run_that_its_row_says(tmp_path: Path) -> None:
    """Law: a run of a study is bit for bit the same as one by hand with its parameters.

    Slaves in processes of their own here; by hand once from Python, and once with the case's file.
    """
    system = load_system(car(tmp_path))
    text = '[parameters]\n"wheel.z" = [0.1, 0.2]\n"simulation.order" = [1]\n[run]\nplot = true\n'
    out = tmp_path / "out"
    done = sweep(study_file(tmp_path, text + OUTPUTS), out, "--workers", 2)
    assert done.code == 0, done.text
    assert str(out / "study.csv") in done.text
    table = rows(out)
    assert [row["run"] for row in table] == ["0001", "0002"]
    for row in table:
        z = float(row["wheel.z"])
        run = Result.load(out / "runs" / row["run"])
        known = simulate(system.with_parameters({"wheel.z": z}), in_process=True, order=1)
        assert run.outputs.tobytes() == known.outputs.tobytes()
        assert run.time.tobytes() == known.time.tobytes()
        assert (row["outcome"], row["exit_code"], row["message"]) == ("completed", "0", "")
        assert int(row["communication_steps"]) == known.summary["communication_steps"]
        assert int(row["rejected_double_steps"]) == known.summary["rejected_double_steps"]
        assert int(row["do_steps"]) == sum(known.summary["do_steps"].values())
        assert float(row["wall_time"]) > 0.0
        assert float(row["highest"]) == known["wheel.x"].max()
        assert float(row["end"]) == known["chassis.x"][-1]
        assert (out / "runs" / row["run"] / "results.png").is_file()
    again = tmp_path / "again"
    words = ["--case", out / "runs" / "0002" / "case.toml", "--output", again, "--in-process"]
    done = invoke("run", tmp_path / "car.toml", *words, "--no-plot")
    assert done.code == 0, done.text
    for name in ("results.csv", "steps.csv"):
        assert (again / name).read_bytes() == (out / "runs" / "0002" / name).read_bytes()


@pytest.mark.usefixtures("no_process_left")
def test_what_was_run_is_not_run_again(tmp_path: Path) -> None:
    """Restart: only what is missing or has failed and is asked for; the table comes out the same.

    And a directory with runs of another study is not touched.
    """
    car(tmp_path, f"{MODELS}:BreaksDown")
    text = '[parameters]\n"chassis.breaks_at" = [1.0, 2.0, 0.01]\n"wheel.z" = 0.1\n'
    text += "[run]\nin_process = true\n" + OUTPUTS
    file, out = study_file(tmp_path, text), tmp_path / "out"
    done = sweep(file, out)
    assert done.code == 1, done.text
    assert "run 0003 failed, exit code 4: chassis: do_step" in done.text
    assert "3 of 3 runs ended, 1 failed" in done.text
    first = identities(out)
    table = (out / "study.csv").read_bytes()
    assert [row["outcome"] for row in rows(out)] == ["completed"] * 2 + ["failed"]
    assert [row["exit_code"] for row in rows(out)] == ["0", "0", "4"]
    assert rows(out)[2]["highest"] == ""
    assert "t=0." in rows(out)[2]["message"]

    (out / "study.csv").unlink()
    (out / "runs" / "0007.part-00000000").mkdir()
    done = sweep(file, out)
    assert done.code == 1, done.text
    assert identities(out) == first
    assert (out / "study.csv").read_bytes() == table

    for path in (out / "runs" / "0002").iterdir():
        path.unlink()
    (out / "runs" / "0002").rmdir()
    assert sweep(file, out, "--retry-failed", "--quiet") == Done(1, f"{out / 'study.csv'}\n")
    second = identities(out)
    assert second["0001"] == first["0001"]
    assert second["0003"] != first["0003"]
    stays = ("highest", "end", "communication_steps", "outcome", "message")
    old = list(csv.DictReader(table.decode().splitlines()))
    assert [[row[c] for c in stays] for row in rows(out)] == [[r[c] for c in stays] for r in old]

    study_file(tmp_path, text.replace("2.0, ", "").replace("0.1", "0.3"))
    done = sweep(file, out)
    assert (done.code, "is not a run of this study" in done.text) == (7, True), done.text
    assert identities(out) == second
    assert sweep(file, out, "--replace").code == 1
    assert [row["wheel.z"] for row in rows(out)] == ["0.3"] * 2
    assert sorted(identities(out)) == ["0001", "0002"]


def test_discrete_outputs_become_numbers_where_they_are(
    capability_dir: Path, tmp_path: Path
) -> None:
    """An integer has a highest value; it is held between points, so it has no mean; texts neither.

    And only what the system keeps can be a column.
    """
    (tmp_path / "car.toml").write_text(
        "[simulation]\nstop_time = 1.0\n[results]\nvariables = ['!all.toggle_out']\n"
        f"[slaves.model]\nmodel = '{capability_dir / 'event_mode3.fmu'}'\n"
        f"[slaves.all]\nmodel = '{capability_dir / 'all_types2.fmu'}'\n"
    )
    text = '[parameters]\n"simulation.relative_tolerance" = 1e-5\n[results.outputs]\n'
    column = 'x = {{ variable = "{}", reduce = "{}" }}\n'
    for variable, reduce, words in (
        ("model.level", "mean", "reduce = 'mean': model.level is held between the points"),
        ("all.string_out", "last", "all.string_out is no number"),
        ("all.toggle_out", "last", "no such output"),
    ):
        file = study_file(tmp_path, text + column.format(variable, reduce))
        with pytest.raises(ConfigurationError) as info:
            make_plan(load_study(file))
        assert words in str(info.value)
    file = study_file(tmp_path, text + column.format("model.level", "max"))
    done = sweep(file, tmp_path / "out")
    assert done.code == 0, done.text
    assert [row["x"] for row in rows(tmp_path / "out")] == ["2.0"]


class Command:
    """A sweep under way."""

    def __init__(self, *words: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "master_node", "sweep", *map(str, words)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)

    def end(self, number: signal.Signals) -> tuple[int, float, str]:
        """Send it a signal: its exit code, the seconds until it ended, and what it said."""
        begin = time.monotonic()
        self.process.send_signal(number)
        code = self.process.wait(BOUND)
        taken = time.monotonic() - begin
        self._reader.join(BOUND)
        return code, taken, "".join(self._lines.queue)

    def close(self) -> None:
        """End it, whatever it does."""
        self.process.kill()
        self.process.wait(BOUND)
        self._reader.join(BOUND)
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def start() -> Iterator[Callable[..., Command]]:
    """``start(file, "--output", ...)`` is a sweep in the background."""
    commands: list[Command] = []

    def start_command(*words: object) -> Command:
        commands.append(Command(*words))
        return commands[-1]

    yield start_command
    for command in commands:
        command.close()


def under_way(output: Path) -> list[Path]:
    """The runs that have taken steps and have not ended."""
    return [path.parent for path in (output / "runs").glob("*.part-*/steps.csv")]


ENDLESS = """
[parameters]
"simulation.stop_time" = [0.02, 1e6, 2e6, 3e6]
"simulation.largest_step_size" = 1e-3
"simulation.smallest_step_size" = 1e-9
[resources]
licences = { solver = 2, other = 5 }
[run]
needs = ["solver", "other"]
"""


@pytest.mark.usefixtures("no_process_left")
@pytest.mark.parametrize("in_process", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_ctrl_c_ends_a_sweep_at_once_and_it_can_go_on(
    start: Callable[..., Command], tmp_path: Path, in_process: bool
) -> None:
    """Runs that had ended stay and are not run again; no file or process is left of the rest.

    Before that, no more runs are under way than there are licences, though there are workers, and
    a second sweep is not let into the directory.
    """
    car(tmp_path)
    text = ENDLESS + f"in_process = {'true' if in_process else 'false'}\n"
    file, out = study_file(tmp_path, text), tmp_path / "out"
    command = start(file, "--output", out, "--workers", 4)
    wait_until(lambda: (out / "runs" / "0001").exists() and len(under_way(out)) == 2)
    assert len(list((out / "runs").glob("*.part-*"))) == 2
    done = sweep(file, out)
    assert (done.code, "another sweep is working in" in done.text) == (7, True), done.text
    code, taken, said = command.end(signal.SIGINT)
    assert (code, "master-node: interrupted" in said) == (130, True), said
    assert is_quick(taken, 1.0)
    assert [path.name for path in (out / "runs").iterdir()] == ["0001"]
    assert [row["outcome"] for row in rows(out)] == ["completed"] + ["pending"] * 3
    known = identities(out)

    command = start(file, "--output", out, "--workers", 1)
    wait_until(lambda: len(under_way(out)) == 1)
    assert under_way(out)[0].name.startswith("0002.part-")
    assert command.end(signal.SIGTERM)[0] == 130
    assert identities(out) == known


@pytest.mark.usefixtures("no_process_left")
@pytest.mark.slow
def test_runs_do_not_outlive_a_sweep_that_was_killed(
    start: Callable[..., Command], tmp_path: Path
) -> None:
    """Their standard input closes; and its directory can be used again."""
    car(tmp_path)
    file, out = study_file(tmp_path, ENDLESS.replace("0.02, ", "")), tmp_path / "out"
    command = start(file, "--output", out, "--workers", 2)
    wait_until(lambda: len(under_way(out)) == 2)
    assert command.end(signal.SIGKILL)[0] == -signal.SIGKILL
    study_file(tmp_path, GRID)
    assert sweep(file, out).code == 0
    assert sorted(path.name for path in (out / "runs").iterdir()) == ["0001", "0002"]


@pytest.mark.usefixtures("no_process_left")
def test_a_run_beyond_its_time_has_failed(tmp_path: Path) -> None:
    """It is ended, counted, and its results up to there are kept."""
    car(tmp_path)
    text = ENDLESS.replace("0.02, 1e6, 2e6, 3e6", "1e6") + "in_process = true\ntimeout = 8.0\n"
    done = sweep(study_file(tmp_path, text), tmp_path / "out")
    assert done.code == 1
    (row,) = rows(tmp_path / "out")
    assert (row["outcome"], row["exit_code"]) == ("failed", "5")
    assert row["message"] == "the run did not end within 8 s"
    assert (tmp_path / "out" / "runs" / "0001" / "run.log").is_file()


def test_what_is_no_record_counts_for_nothing(tmp_path: Path) -> None:
    """A record goes through its file; a broken one is none, so that the run is repeated."""
    record = RunRecord("print", "failed", -9, "ended by signal 9", 1.5)
    write_record(tmp_path, record)
    assert read_record(tmp_path) == record
    file = tmp_path / "run.json"
    whole = json.loads(file.read_text(encoding="utf-8"))
    for broken in ("", "[]", "{}", json.dumps(whole | {"outcome": "maybe"}), '{"a": 1'):
        file.write_text(broken, encoding="utf-8")
        assert read_record(tmp_path) is None


def test_what_is_no_run_is_not_removed(tmp_path: Path) -> None:
    """``--replace`` takes away directories of runs and nothing else."""
    path = car(tmp_path)
    plan = make_plan(load_study(study_file(path.parent, GRID)))
    stranger = tmp_path / "out" / "runs" / "0001"
    stranger.mkdir(parents=True)
    (stranger / "thesis.tex").write_text("years of work")
    (tmp_path / "out" / "runs" / "notes").mkdir()
    with StudyDirectory(tmp_path / "out") as directory:
        with pytest.raises(ResultsError, match="is in the way and is not a run"):
            directory.records(plan, replace=True)
        assert directory.directory_of(PlannedRun(123, {}, "")).name == "0123"
    assert (stranger / "thesis.tex").is_file()


def test_the_example_is_valid(tmp_path: Path) -> None:
    """All cases of all study files of the examples."""
    files = sorted((EXAMPLES.parent / "sweep").glob("*.toml"))
    assert len(files) == 4
    for file in files:
        assert make_plan(load_study(file)).runs


# ---- Dask ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def distributed() -> ModuleType:
    """The package, where the extra is installed."""
    return pytest.importorskip("distributed", reason="the extra doublestep[dask] is not installed")


@pytest.fixture(scope="module")
def cluster(distributed: ModuleType) -> Iterator[Any]:
    """Two workers in processes of their own, with one licence each."""
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=2,
        processes=True,
        resources={"solver": 1},
        dashboard_address="127.0.0.1:0",
        host="127.0.0.1",
    ) as started:
        yield started


@pytest.mark.usefixtures("no_process_left")
def test_a_cluster_gives_the_same_results(cluster: Any, tmp_path: Path) -> None:
    """Law: results.csv and steps.csv do not depend on where a run is; failures are counted, too."""
    car(tmp_path, f"{MODELS}:BreaksDown")
    text = '[parameters]\n"chassis.breaks_at" = [1.0, 0.01]\n' + OUTPUTS
    text += '[run]\nin_process = true\nneeds = ["solver"]\n[resources]\nlicences = { solver = 2 }\n'
    file, out = study_file(tmp_path, text), tmp_path / "out"
    done = sweep(file, out, "--dask", cluster.scheduler_address, in_this_process=False)
    assert done.code == 1, done.text
    assert sweep(file, tmp_path / "local").code == 1
    for run in ("0001", "0002"):
        for name in ("results.csv", "steps.csv", "case.toml"):
            here = tmp_path / "local" / "runs" / run / name
            assert (out / "runs" / run / name).read_bytes() == here.read_bytes()
    stays = [set(row.items()) - {("wall_time", row["wall_time"])} for row in rows(out)]
    local = rows(tmp_path / "local")
    assert stays == [set(row.items()) - {("wall_time", row["wall_time"])} for row in local]
    known = identities(out)
    assert sweep(file, out).code == 1
    assert identities(out) == known


@pytest.mark.slow
@pytest.mark.usefixtures("no_process_left")
def test_ctrl_c_ends_the_runs_on_a_cluster(
    cluster: Any, start: Callable[..., Command], tmp_path: Path
) -> None:
    """The sweep ends at once, the runs on the workers soon after it; the cluster goes on.

    Each worker has one of the licences, so it executes one run at a time.
    """
    car(tmp_path)
    text = ENDLESS.replace(', "other"', "") + "in_process = true\n"
    file, out = study_file(tmp_path, text), tmp_path / "out"
    command = start(file, "--output", out, "--dask", cluster.scheduler_address)
    wait_until(lambda: (out / "runs" / "0001").exists() and len(under_way(out)) == 2)
    code, taken, said = command.end(signal.SIGINT)
    assert code == 130, said
    assert is_quick(taken, 3.0)  # Dask's own farewell included
    wait_until(lambda: [path.name for path in (out / "runs").iterdir()] == ["0001"])
    study_file(tmp_path, GRID)
    assert (
        sweep(
            file, tmp_path / "next", "--dask", cluster.scheduler_address, in_this_process=False
        ).code
        == 0
    )


@pytest.mark.usefixtures("no_process_left")
@pytest.mark.slow
def test_what_a_cluster_lacks_is_said(cluster: Any, tmp_path: Path) -> None:
    """No scheduler, no licence on any worker, and workers that are asked for beside a cluster."""
    car(tmp_path)
    needs = '[resources]\nlicences = { dymola = 2 }\n[run]\nneeds = ["dymola"]\n'
    file = study_file(tmp_path, GRID + needs)
    done = sweep(file, tmp_path / "out", "--dask", cluster.scheduler_address, in_this_process=False)
    assert done.code == 2
    assert "has the licences that a run needs: dymola=1" in done.text
    done = sweep(file, tmp_path / "out", "--dask", "tcp://127.0.0.1:1", in_this_process=False)
    assert done.code == 2
    assert "no Dask scheduler at tcp://127.0.0.1:1" in done.text
    done = sweep(file, tmp_path / "out", "--dask", "tcp://127.0.0.1:1", "--workers", "2")
    assert (done.code, "--workers is for this host" in done.text) == (2, True)


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The error names the extra to install."""
    car(tmp_path)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    done = sweep(study_file(tmp_path, GRID), tmp_path / "out", "--dask", "x")
    assert done.code == 2
    assert "pip install 'doublestep[dask]'" in done.text
