"""``slave-node validate``: a true report for every FMU, whatever it can and whatever it breaks."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from fmpy import read_model_description
from rich.console import Console

from protocol.description import SlaveDescription
from protocol.slave import CallExecutor
from protocol.variables import Variable
from slave_node.loading import load_executor
from slave_node.validation.report import description_tables, report_table
from slave_node.validation.trials import Finding, Grade, validate
from slave_node.worker.process import ModelReference, WorkerProcess, execute_program
from tests.support.places import ROOT
from tests.support.slow import quick_at
from tests.support.waiting import BOUND


class LocalWorker:
    """Implements `Worker` of `slave_node.worker.process` in this process: nothing to kill."""

    def __init__(self, reference: ModelReference) -> None:
        self._reference = reference
        self._executor: CallExecutor | None = None
        self._scratch: tempfile.TemporaryDirectory[str] | None = None

    def start(self) -> SlaveDescription:
        self.stop()
        self._scratch = tempfile.TemporaryDirectory()
        model = self._reference
        self._executor = load_executor(
            model.model, model.base, model.name, Path(self._scratch.name)
        )
        return self._executor.description

    def execute(self, program: bytes) -> bytes:
        assert self._executor is not None
        return execute_program(self._executor, self._reference, program)

    def kill(self) -> None:
        raise AssertionError("a trial took too long")

    def stop(self) -> None:
        if self._executor is not None:
            self._executor.close()
        if self._scratch is not None:
            self._scratch.cleanup()
        self._executor = self._scratch = None


def test_nothing_of_a_description_is_cut_off_in_a_narrow_terminal() -> None:
    """Names and hashes are what a system file wants: they go on in the next line."""
    name = ".".join(["component"] * 9)
    description = SlaveDescription(
        model="Model",
        kind="FMI 2.0 co-simulation",
        variables=(Variable(name, unit="N.m/rad", start=1.0, nominal=2.0, description="angle"),),
        sha256="7" * 64,
        guid="{" + "8" * 64 + "}",
    )
    console = Console(width=80, color_system=None)
    with console.capture() as captured:
        console.print(*description_tables(description))
    shown = captured.get()
    assert "…" not in shown
    assert (shown.count("7"), shown.count("8")) == (64, 64)
    assert "N.m/rad" in shown


# ---- What is true of each FMU -------------------------------------------------------------------

EXACT = "exact to the bit"
FORKED = (("fork", EXACT),)


@dataclass(frozen=True)
class Truth:
    """Beginnings of the results of the trials of every model; "": not tried."""

    states: tuple[tuple[str, str], ...] = (("native", EXACT),)
    """Each way to save states down to the one that is used."""
    inputs: str = "up to order 1, then: set_inputs: fmi2SetRealInputDerivatives of order 2 returned"
    outputs: str = "agree with differences"
    steps: str = "taken"
    sizes: str = "taken"
    zero: str = "refused"
    clock: str = ""
    halves: str = "agree"
    remark: str = ""
    clocks: str = ""
    slopes: str = ""
    """Output derivatives after going back."""
    reset: str = "done"


LAG = Truth()
HELD = Truth(inputs="not taken by the model", outputs="none")
WHOLE = Truth(inputs="up to order 3")
UNREACHED = "does not reach the FMU"
AT_REST = f"{EXACT}; no output moved in the trial steps"
CLOCKS = replace(
    LAG,
    outputs="get_outputs: fmi2GetRealOutputDerivatives of order 1 returned fmi2Error",
    clocks="cpu_time, steps, number",
)
SECOND_ORDER = replace(
    LAG,
    inputs="up to order 2, then: set_inputs: fmi2SetRealInputDerivatives of order 3 returned",
)
OF_ONE_SIZE = {"sizes": "not declared", "halves": ""}
UNUSABLE = {"licence_error": "licence not found", "missing_library": "libdoublestep_absent.so"}

QUARTER_CAR = {
    "no_state": replace(WHOLE, states=FORKED),
    "no_derivatives": HELD,
    "bare": replace(HELD, states=FORKED),
    "fmi3": replace(HELD, outputs=LAG.outputs, zero=UNREACHED),
    "fmi3_bare": replace(HELD, states=FORKED, zero=UNREACHED),
    "fmi3_intermediate": replace(WHOLE, zero=UNREACHED),
    "me2": replace(WHOLE, outputs="none"),
    "me3": replace(WHOLE, outputs="none"),
}
CAPABILITIES = {
    **{f"{half}_{v}": truth for half in ("chassis", "wheel") for v, truth in QUARTER_CAR.items()},
    "chassis_fmi1": replace(HELD, states=FORKED),
    "wheel_fmi1": replace(WHOLE, states=FORKED),
    "broken_state": replace(LAG, states=(("native", "does not repeat: "), *FORKED)),
    "restarting_solver": replace(
        LAG, states=(("native", "repeats, but restarts the solver: steps after a restore repeat"),)
    ),
    "not_repeating": replace(HELD, states=(("native", "does not repeat: "), *FORKED)),
    "error_on_restore": replace(
        LAG, states=(("native", "broken: fmi2SetFMUstate returned fmi2Error"), *FORKED)
    ),
    "starts_thread": replace(
        LAG,
        states=(
            ("fork", "broken: get_state: the process that holds the model cannot be forked: the "
             "model runs 1 more thread"),
            ("replay", EXACT),
        ),
    ),
    "writes_file": replace(
        LAG,
        states=(
            ("fork", "broken: get_state: the process that holds the model cannot be forked: the "
             "model writes to the file"),
            ("replay", EXACT),
        ),
    ),
    "discards": replace(LAG, steps="do_step: discard at t=0.002 s; steps of 0.001 s are taken"),
    "accident": LAG,
    "large_state": LAG,
    "internal_clock": replace(HELD, clock="outputs move only at multiples of 0.01 s", halves=""),
    "euler_per_step": replace(HELD, halves="differ by "),
    "crashes": replace(
        LAG,
        states=(
            ("native", "the process that held the model died by SIGSEGV in trial steps of up to "
             "0.32 s"),
            *FORKED,
        ),
    ),
    "hangs": replace(
        LAG,
        states=(("native", "no answer within 3 s in trial steps of up to 0.32 s"),),
        halves="",
    ),
    "not_finite": LAG,
    "changes_process": LAG,
    "plain_lag": LAG,
    "slopes_nan_at_first": LAG,
    "slopes_nan": replace(LAG, outputs="those of y are not finite"),
    "slopes_infinite": replace(LAG, outputs="those of c are not finite"),
    "slopes_thousandfold": replace(LAG, outputs="those of y are nowhere near the change"),
    "slopes_differences": replace(LAG, outputs="those of y are differences over the last step"),
    "slopes_noise": replace(LAG, slopes="those of y, c are others when the same step is taken"),
    "second_order": SECOND_ORDER,
    "ignores_second_order": replace(
        LAG, inputs="up to order 1, then: those of order 2 change nothing"
    ),
    "ignores_derivatives": replace(
        LAG, inputs="up to order 0, then: those of order 1 change nothing"
    ),
    "counts_inputs": SECOND_ORDER,
    "clocks": CLOCKS,
    "clocks_no_state": replace(CLOCKS, states=FORKED),
    "loses_state": replace(
        HELD,
        states=(("native", "does not restore: "), *FORKED),
        halves="differ by ",
    ),
    "saturated_controller": replace(
        HELD, states=(("native", AT_REST),), halves="differ by "
    ),
    "reset_keeps_fmi1": replace(HELD, states=FORKED, reset="its reset is broken: "),
    "reset_keeps_state": replace(HELD, states=FORKED, reset="its reset is broken: "),
    "reset_spoils_fmi1": replace(HELD, states=FORKED, reset="its reset is broken: "),
    "execution_tool": replace(LAG, remark="it needs the tool that exported it"),
    "fixed_step": replace(HELD, **OF_ONE_SIZE),
    "fixed_step_fmi3": replace(HELD, **OF_ONE_SIZE, zero=UNREACHED),
    "terminates2": LAG,
    "terminates3": replace(HELD, outputs=LAG.outputs, zero=UNREACHED),
    "warns1": replace(HELD, states=FORKED),
    "warns2": HELD,
    "warns3": replace(HELD, zero=UNREACHED),
    "event_mode3": replace(HELD, inputs="no continuous inputs", zero=UNREACHED),
    "rounds_events3": replace(HELD, inputs="no continuous inputs", zero=UNREACHED),
    "loses_indicators3": replace(HELD, inputs="no continuous inputs", zero=UNREACHED),
    "few_variables": LAG,
    "many_variables": LAG,
    "units_metres": LAG,
    "units_millimetres": LAG,
    "loop_a": replace(LAG, states=(("native", AT_REST),)),
    "loop_b": replace(LAG, states=(("native", AT_REST),)),
    "bouncing_ball_me2": replace(HELD, inputs="no continuous inputs"),
    "bouncing_ball_me3": replace(HELD, inputs="no continuous inputs"),
    "relay_me2": replace(WHOLE, outputs="none", states=(("native", AT_REST),)),
    "drive1": replace(HELD, states=FORKED),
    "drive2": HELD,
    "drive3": replace(HELD, zero=UNREACHED),
    "all_types2": HELD,
    "all_types3": replace(HELD, zero=UNREACHED, remark="clock clock (triggered) is ignored"),
}  # fmt: skip
IN_PYTHON = replace(HELD, zero="taken", remark="its Python code runs in the Python of this slave")
FMUS: dict[str, dict[str, Truth]] = {
    "capability_dir": CAPABILITIES,
    "fmu_dir": dict.fromkeys(("chassis", "wheel", "chassis_force", "wheel_force"), WHOLE),
    "oscillator_dir": {
        "mass": WHOLE,
        "van_der_pol": WHOLE,
        "step_source": replace(WHOLE, inputs="no continuous inputs", states=(("native", AT_REST),)),
    },
    "no_rollback_dir": {
        "chassis_without_state": replace(WHOLE, states=FORKED),
        "wheel_without_state": replace(WHOLE, states=FORKED),
    },
    "python_fmu_dir": {
        "wheel": IN_PYTHON,
        "chassis": replace(IN_PYTHON, states=FORKED, zero=UNREACHED),
    },
}
NEED_A_PROCESS = ("crashes", "hangs", "changes_process")


EACH = [(folder, fmu) for folder, fmus in FMUS.items() for fmu in fmus]
OTHER_HALVES = [(folder, f"wheel_{variant}") for folder, variant in [
    *(("capability_dir", variant) for variant in QUARTER_CAR),
    ("no_rollback_dir", "without_state"),
]]  # fmt: skip
"""Wheels that can what their chassis can."""


@pytest.mark.parametrize(
    ("folder", "fmu"), quick_at([each for each in EACH if each not in OTHER_HALVES], EACH)
)
def test_every_report_is_true(request: pytest.FixtureRequest, folder: str, fmu: str) -> None:
    """Reports find all that an FMU was made to do, and give each weakness a consequence."""
    truth = FMUS[folder][fmu]
    findings = list(
        validate(
            f"{fmu}.fmu",
            request.getfixturevalue(folder),
            timeout=3.0 if fmu == "hangs" else 60.0,
            worker=WorkerProcess if fmu in NEED_A_PROCESS else LocalWorker,
        )
    )
    found = {finding.what: finding for finding in findings}
    assert len(found) == len(findings)

    def check(what: str, result: str) -> None:
        said = found.pop(what).result if what in found else ""
        assert said.startswith(result) if result else not said, f"{what}: {said}"

    steps = next(what for what in found if what.startswith("10 steps of"))
    check("model description", "valid")
    check("remark", truth.remark)
    variables = read_model_description(
        request.getfixturevalue(folder) / f"{fmu}.fmu", validate=False
    ).modelVariables
    said = "inputs: "
    if not any(v.dimensions for v in variables):  # the elements of an array count each
        counts = [sum(v.causality == kind for v in variables) for kind in ("input", "output")]
        said = "inputs: {}, outputs: {}".format(*counts)
    check("initialize", said)
    check(steps, truth.steps)
    check("steps of changing size", truth.sizes)
    check("a step of size zero", truth.zero)
    check("a step from elsewhere", "not noticed" if folder == "python_fmu_dir" else "refused")
    check("input derivatives", truth.inputs)
    check("output derivatives", truth.outputs)
    for way, result in truth.states:
        check(f"saved states, {way}", result)
    check("internal clock", truth.clock)
    check("one step against two", truth.halves)
    check(f"outputs that do not repeat, {truth.states[-1][0]}", truth.clocks)
    check("output derivatives, going back", truth.slopes)
    check("terminate and reset", truth.reset)
    assert not found
    for finding in findings:
        assert finding.grade is not Grade.PROBLEM
        assert finding.consequence or finding.grade is Grade.OK or finding.what == "remark"


def test_no_fmu_is_left_out(
    capability_dir: Path, fmu_dir: Path, oscillator_dir: Path, no_rollback_dir: Path
) -> None:
    """The table above has a row for every FMU that is built."""
    rows = FMUS | {"capability_dir": CAPABILITIES | dict.fromkeys(UNUSABLE, LAG)}
    for folder, name in (
        (capability_dir, "capability_dir"),
        (fmu_dir, "fmu_dir"),
        (oscillator_dir, "oscillator_dir"),
        (no_rollback_dir, "no_rollback_dir"),
    ):
        assert {path.stem for path in folder.glob("*.fmu")} == set(rows[name])


def test_a_report_shows_the_words_of_an_fmu_as_they_are() -> None:
    """Brackets, as around the category of a log message, are no markup of the console."""
    console = Console(width=200, record=True, file=io.StringIO())
    result = "[logStatusError] the valve[3] is [/shut]"
    console.print(report_table("a[b].fmu", [Finding("load", Grade.PROBLEM, result, "[none]")]))
    text = console.export_text()
    for words in (result, "a[b].fmu", "[none]"):
        assert words in text


# ---- The command --------------------------------------------------------------------------------


@pytest.mark.parametrize("fmu", UNUSABLE)
def test_an_fmu_that_cannot_be_run_says_why(capability_dir: Path, fmu: str) -> None:
    """By the FMU's own log or the name of the library; the exit code is that of FMU errors."""
    model = capability_dir / f"{fmu}.fmu"
    command = [sys.executable, "-m", "slave_node", "validate", str(model), "--json"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=BOUND, check=False)
    assert run.returncode == 4
    last = json.loads(run.stdout)[-1]
    assert last["grade"] == "problem"
    assert UNUSABLE[fmu] in last["result"]


def test_a_python_model_is_validated_too() -> None:
    """Python models get the trials of FMUs, without those of a model description."""
    model = ROOT / "examples" / "quarter_car" / "quarter_car.py"
    found: dict[str, Finding] = {
        f.what: f for f in validate(f"{model.name}:Wheel", model.parent, worker=LocalWorker)
    }
    assert "model description" not in found
    assert not [f for f in found.values() if f.grade is Grade.PROBLEM]
