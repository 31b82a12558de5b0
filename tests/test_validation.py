"""``slave-node validate``: a true report for every FMU, whatever it can and whatever it breaks."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from slave_node.validation import Finding, Grade, validate

pytestmark = pytest.mark.timeout(300)  # the first one pays for the build of the FMUs


def report(folder: Path, fmu: str) -> dict[str, Finding]:
    """What was found, by what was tried."""
    return {finding.what: finding for finding in validate(f"{fmu}.fmu", folder)}


@pytest.mark.parametrize("fmu", ["chassis_fmi1", "chassis_fmi3", "chassis_me2", "chassis_bare"])
def test_good_fmus_have_no_problem(capability_dir: Path, fmu: str) -> None:
    """Every version can be run, with states saved exactly in one way or another."""
    found = report(capability_dir, fmu)
    assert not [f for f in found.values() if f.grade is Grade.PROBLEM]
    states = [f for what, f in found.items() if what.startswith("saved states")]
    assert states[-1].result == "exact to the bit"


@pytest.mark.parametrize(
    ("fmu", "what", "words"),
    [
        ("broken_state", "saved states, native", "does not repeat"),
        ("not_repeating", "saved states, native", "does not repeat"),
        ("restarting_solver", "saved states, native", "restarts the solver"),
        ("error_on_restore", "saved states, native", "broken"),
        ("starts_thread", "saved states, fork", "thread"),
        ("writes_file", "saved states, fork", "steps.txt"),
        ("internal_clock", "internal clock", "multiples of 0.01 s"),
        ("euler_per_step", "one step against two", "times the tolerance"),
        ("fixed_step", "steps of changing size", "not declared"),
        ("discards", "10 steps of 0.01 s", "discard"),
        ("chassis_no_derivatives", "input derivatives", "not taken"),
    ],
)
def test_weaknesses_are_found(capability_dir: Path, fmu: str, what: str, words: str) -> None:
    """Each is a note with what was seen and what is done about it; the FMU can still be run."""
    finding = report(capability_dir, fmu)[what]
    assert finding.grade is Grade.NOTE
    assert words in finding.result
    assert finding.consequence


def test_the_next_way_to_save_states_is_tried(capability_dir: Path) -> None:
    """Native states that cannot be trusted are followed by the first that can."""
    assert report(capability_dir, "broken_state")["saved states, fork"].grade is Grade.OK
    assert report(capability_dir, "starts_thread")["saved states, replay"].grade is Grade.OK


@pytest.mark.parametrize(
    ("fmu", "words"), [("licence_error", "LICENCE_FILE"), ("missing_library", "doublestep_absent")]
)
def test_an_fmu_that_cannot_be_run_says_why(capability_dir: Path, fmu: str, words: str) -> None:
    """By the FMU's own log or the name of the library; the exit code is that of FMU errors."""
    model = capability_dir / f"{fmu}.fmu"
    command = [sys.executable, "-m", "slave_node", "validate", str(model), "--json"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 4
    last = json.loads(run.stdout)[-1]
    assert last["grade"] == "problem"
    assert words in last["result"]


def test_a_python_model_is_validated_too() -> None:
    """The same tests, without those of a model description."""
    model = Path(__file__).parents[1] / "examples" / "quarter_car" / "quarter_car.py"
    found = {f.what: f for f in validate(f"{model.name}:Wheel", model.parent)}
    assert "model description" not in found
    assert not [f for f in found.values() if f.grade is Grade.PROBLEM]
