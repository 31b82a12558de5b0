"""The benchmark over all FMUs of a folder: what it finds, bounds, compares and counts."""

from __future__ import annotations

import json
import shutil
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import corpus
from benchmarks.bounded import Bound, Outcome, run_bounded
from benchmarks.corpus.comparison import compare, is_same
from benchmarks.corpus.experiment import experiment_of
from benchmarks.corpus.fmpy_loop import regular_rows, scalars
from benchmarks.corpus.lag import Lag
from benchmarks.corpus.models import distinct_models, normalized_tool
from benchmarks.corpus.table import by_tool, coupling_reasons, faults, general, reasons
from benchmarks.corpus.trials import End, judged
from master_node import Result
from master_node.results import STEPS_DTYPE

NOTHING_DONE = Outcome(0, "", "", 1.0, None, ())


# ---- The models ---------------------------------------------------------------------------------


def packed(path: Path, tool: str, binary: str = "binaries/linux64/m.so") -> Path:
    """An FMU of which the description and the name of a binary are there."""
    with zipfile.ZipFile(path, "w") as archive:
        text = f'<fmiModelDescription fmiVersion="2.0" generationTool="{tool}"/>'
        archive.writestr("modelDescription.xml", text)
        archive.writestr(binary, "")
    return path


def test_each_content_is_found_once(tmp_path: Path) -> None:
    """Files at any depth and folders; a copy under another name is no other model."""
    fmu = packed(tmp_path / "a.fmu", "Dymola Version 2020x (64-bit), 2019-10-10")
    (tmp_path / "deep").mkdir()
    shutil.copy(fmu, tmp_path / "deep" / "copy.fmu")
    packed(tmp_path / "deep" / "other.fmu", "", "binaries/win64/m.dll")
    (tmp_path / "broken.fmu").write_text("no archive")
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(tmp_path / "folder")
    found = {model.path.name: model for model in distinct_models(tmp_path)}
    assert sorted(found) == ["a.fmu", "broken.fmu", "folder", "other.fmu"]
    assert [found[name].has_binary for name in sorted(found)] == [True, False, True, False]
    assert [found[name].tool for name in sorted(found)] == [
        "Dymola",
        "not said",
        "Dymola",
        "not said",
    ]


@pytest.mark.parametrize(
    ("generation_tool", "name"),
    [
        ("Dymola Version 2016 (64-bit), 2015-04-15 (requires license to execute)", "Dymola"),
        ("OpenModelica Compiler OMCompiler v1.18.0-dev.192+gc2d2d8d45f", "OpenModelica"),
        ("LMS Imagine.Lab Amesim 15.0.0 - 55273-51181 2016", "Amesim"),
        ("Simulink 8.11 (R2016b) 25-Aug-2016 with FMI Kit 2.7 (x)", "Simulink (FMI Kit)"),
        ("FMI Toolbox 2.6.4 from Modelon run at MATLAB (R2019a)", "Simulink (FMI Toolbox)"),
        ("Simulink (R2020a)", "Simulink"),
        ("PythonFMU 0.7.0", "PythonFMU"),
        ("MLFMU 1.0.2", "MLFMU"),
        ("Unknown Tool v3", "Unknown Tool"),
        ("unifmu", "unifmu"),
        ("", "not said"),
    ],
)
def test_a_tool_is_one_whatever_its_version(generation_tool: str, name: str) -> None:
    """The table is by tool, and names as they are in model descriptions vary."""
    assert normalized_tool(generation_tool) == name


def test_the_experiment_is_the_begin_of_the_default_one(
    fmu_dir: Path, capability_dir: Path, tmp_path: Path
) -> None:
    """Step size and times of the model where it has some; what cannot be read is said."""
    wheel = experiment_of(fmu_dir / "wheel.fmu", 10)
    assert (wheel.start_time, wheel.step_size) == (0.0, 1e-3)
    assert wheel.stop_time == pytest.approx(1e-2)
    assert (set(wheel.inputs), wheel.outputs) == ({"x_c", "v_c"}, ("x", "v"))
    assert not experiment_of(capability_dir / "wheel_me2.fmu").is_co_simulation
    broken = tmp_path / "broken.fmu"
    broken.write_text("no archive")
    assert experiment_of(broken).problem


@given(
    y=st.floats(-1e300, 1e300),
    t=st.floats(0.0, 100.0),
    base=st.floats(-1e6, 1e6),
    amplitude=st.floats(0.0, 1.0),
)
def test_the_lag_answers_boundedly(y: float, t: float, base: float, amplitude: float) -> None:
    """Within its amplitude of the start value of the input, whatever the model does."""
    lag = Lag()
    lag.base, lag.amplitude = base, amplitude
    for state in (-1.0, 1.0):
        (slope,) = lag.derivatives(t, np.array([state]), np.array([y]))
        assert slope * state <= 0.0  # never out of [-1, 1]
        (u,) = lag.output_values(t, np.array([state]), np.array([y]))
        assert abs(u - base) <= amplitude * (1.0 + 1e-9) + 1e-9 * abs(base)


# ---- Bounded commands ---------------------------------------------------------------------------


def bounded(code: str, folder: Path, seconds: float = 60.0, memory: float = 1e12) -> Outcome:
    """Python code as a command."""
    return run_bounded([sys.executable, "-c", code], folder, {"WORD": "x"}, seconds, memory)


def test_a_command_has_its_folder_its_environment_and_its_end(tmp_path: Path) -> None:
    """Both streams and the exit code come back."""
    code = "import os, sys; print(os.getcwd(), os.environ['WORD']); sys.exit('so')"
    outcome = bounded(code, tmp_path)
    assert outcome.stdout == f"{tmp_path} x\n"
    assert (outcome.stderr, outcome.exit_code, outcome.bound) == ("so\n", 1, None)


def test_a_command_without_an_end_is_ended(tmp_path: Path) -> None:
    """And what it said before is there."""
    code = "import time; print('begun', flush=True); time.sleep(3600)"
    outcome = bounded(code, tmp_path, seconds=3.0)
    assert (outcome.bound, outcome.stdout) == (Bound.TIME, "begun\n")


def test_a_command_that_takes_all_memory_is_ended(tmp_path: Path) -> None:
    """Also where a child of it takes it."""
    child = "import time; block = bytearray(200_000_000); time.sleep(3600)"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    assert bounded(code, tmp_path, memory=1.5e8).bound is Bound.MEMORY


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux hands orphans on")
def test_what_a_command_leaves_behind_is_told_and_ended(tmp_path: Path) -> None:
    """A process in a session of its own, whose parent is gone."""
    child = "import time; time.sleep(3600)"
    code = (
        f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {child!r}],"
        " start_new_session=True)"
    )
    (left,) = bounded(code, tmp_path).left
    assert child in left
    assert bounded("", tmp_path).left == ()


@pytest.mark.parametrize(
    ("outcome", "end"),
    [
        ({}, End.DONE),
        ({"exit_code": 2, "stderr": "WARNING: w\nmaster-node: because"}, End.REFUSED),
        ({"bound": Bound.TIME}, End.HANG),
        ({"bound": Bound.MEMORY}, End.MEMORY),
        ({"exit_code": -11}, End.CRASH),
        ({"exit_code": 1}, End.CRASH),
        ({"left": ("sleep 3600",)}, End.LEFT_PROCESSES),
    ],
)
def test_an_end_is_judged_by_code_and_words(outcome: dict[str, Any], end: End) -> None:
    """A refusal has an exit code of ours and a sentence; a traceback is none."""
    trial = judged(replace(NOTHING_DONE, **outcome))
    assert trial.end is end
    if end is End.REFUSED:
        assert (trial.reason, trial.warnings) == ("master-node: because", ("w",))


@pytest.mark.slow
def test_a_traceback_of_ours_is_one_and_that_of_a_model_is_none(tmp_path: Path) -> None:
    """An FMU in Python may print what it likes; frames of our packages mean a fault of ours."""
    ours = bounded("from master_node.system.files import load_system; load_system(3)", tmp_path)
    theirs = bounded("import traceback; 1 / 0", tmp_path)
    repeated = Outcome(0, "", theirs.stderr, 1.0, None, ())
    assert judged(ours).end is End.TRACEBACK
    assert judged(repeated).end is End.DONE


# ---- Comparison with FMPy -----------------------------------------------------------------------


def result_of(time: list[float], values: list[float]) -> Result:
    """A run of one output."""
    return Result(
        names=("model.y",),
        units={"model.y": ""},
        time=np.array(time),
        outputs=np.array([values]).T,
        steps=np.zeros(0, STEPS_DTYPE),
        summary={},
        discrete={"model.n": np.array([1] * len(time))},
    )


def test_results_are_compared_to_the_bit() -> None:
    """One unit in the last place is a difference, and so is a sign of zero; NaN is like NaN."""
    result = result_of([0.0, 0.1], [0.0, 0.3])
    same = {"time": [0.0, 0.1], "y": [0.0, 0.3], "n": [1, 1], "text": ["a", "b"]}
    assert compare(result, "model", same).difference == ""
    assert compare(result, "model", same).values == 4
    for other in ({"y": [0.0, 0.1 + 0.2]}, {"y": [-0.0, 0.3]}, {"n": [1, 2]}, {"time": [0.0]}):
        assert compare(result, "model", same | other).difference
    assert is_same(float("nan"), float("nan"))
    assert not is_same(float("nan"), 1.0)


def test_fmpy_rows_are_those_of_the_communication_points() -> None:
    """FMPy also records within a step at events, and twice at an event: the last row counts."""
    time = np.array([0.0, 0.1, 0.1, 0.15, 0.2, 0.30000000000000004])
    assert regular_rows(time, 0.0, 0.1) == [0, 2, 4, 5]


def test_arrays_are_compared_element_by_element() -> None:
    """Under the names that Doublestep gives to elements."""
    values = np.arange(12.0).reshape(2, 2, 3)
    columns = scalars("A", values)
    assert columns["A[1,1]"] == [0.0, 6.0]
    assert columns["A[2,3]"] == [5.0, 11.0]
    assert scalars("y", np.array([1.0, 2.0])) == {"y": [1.0, 2.0]}


# ---- Tables -------------------------------------------------------------------------------------


def record(file: str, tool: str = "T", **trials: Any) -> dict[str, Any]:
    """A record; trials by name: an end, or an end and a reason."""
    found: dict[str, Any] = {"file": file, "tool": tool, "has_binary": True, "comparison": None}
    for name in ("validate", "fixed", "fmpy", "alone", "coupled"):
        given = trials.get(name, "done")
        end, reason = (given, "") if isinstance(given, str) else given
        found[name] = {"end": end, "reason": reason}
    return found | {key: trials[key] for key in ("comparison",) if key in trials}


def refusal(name: str, version: float) -> tuple[str, str]:
    """An end with a reason, as the program gives it."""
    return "refused", f"master-node: model: /a/{name}.fmu: needs lib {version} here"


RECORDS = (
    record("a.fmu", comparison={"values": 3, "difference": ""}),
    record("b.fmu", comparison={"values": 3, "difference": "y at t=0"}),
    record("c.fmu", alone=refusal("c", 1.5), fmpy="refused"),
    record("d.fmu", tool="U", alone=refusal("d", 7)),
    record("e.fmu", tool="U", fixed=("hang", ""), alone=("slow", "")),
    record("g.fmu", validate="refused", coupled=refusal("g", 3)),
    {"file": "f.fmu", "tool": "V", "has_binary": False, "validate": {"end": "refused"}},
)


def test_the_table_counts_by_tool() -> None:
    """Each model once, in the row of its tool and in the sum."""
    rows = {row[0]: row[1:] for row in by_tool(RECORDS)}
    assert list(rows) == ["T", "U", "all"]
    assert rows["T"] == ("4", "3", "3", "1", "0", "0", "0", "2", "1")
    assert rows["U"] == ("2", "0", "2", "1", "1", "1", "1", "0", "0")
    assert [sum(map(int, pair)) for pair in zip(rows["T"], rows["U"], strict=True)] == list(
        map(int, rows["all"])
    )


def test_reasons_are_counted_without_what_is_special_to_a_model() -> None:
    """Paths and numbers differ, the reason is the same; beside it stands what FMPy could."""
    assert list(reasons(RECORDS)) == [("needs lib N here", "2", "1")]
    assert list(coupling_reasons(RECORDS)) == [("needs lib N here", "1")]
    assert general("master-node: model: /x/y.fmu: no file /a/b/c.so") == "no file PATH"


def test_what_should_not_be_is_told() -> None:
    """Differences, hangs, and false refusals end the benchmark with an error."""
    told = list(faults(RECORDS))
    assert [line.partition(":")[0] for line in told] == ["b.fmu", "d.fmu", "e.fmu", "g.fmu"]


# ---- All of it ----------------------------------------------------------------------------------


def test_a_folder_is_tried_and_its_records_are_kept(
    fmu_dir: Path, capability_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One FMU runs to the same bits as FMPy's loop, one lacks a library, which is a true reason.

    The second time nothing is tried again.
    """
    folder, records = tmp_path / "fmus", tmp_path / "records"
    folder.mkdir()
    for fmu in (fmu_dir / "wheel.fmu", capability_dir / "missing_library.fmu"):
        shutil.copy(fmu, folder)
    words = [str(folder), "--records", str(records), "--steps", "5"]
    corpus.main(words)
    table = capsys.readouterr().out
    assert "| not said | 2 | 1 | 1 | 1 | 0 | 0 | 0 | 1 | 1 |" in table
    assert "needs the shared library libdoublestep_absent" in table
    corpus.main([*words, "--json"])
    out, err = capsys.readouterr()
    assert err == ""
    assert [r["alone"]["end"] for r in json.loads(out)] == ["refused", "done"]
    shutil.copy(fmu_dir / "chassis.fmu", folder)
    corpus.main([*words, "--json", "--known"])
    assert capsys.readouterr() == (out, "")
