"""The benchmark of coupled real FMUs, with systems and FMUs of our own in their place."""

from __future__ import annotations

import json
import shutil
from hashlib import sha256
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import pytest

from benchmarks import coupled
from benchmarks.corpus.models import distinct_models
from benchmarks.coupled.measurement import (
    Measured,
    Scale,
    extrapolated,
    find_reference,
    measure,
    run_fixed,
    system_of,
)
from benchmarks.coupled.systems import SYSTEMS, CoupledFmus, Slave

BASE: dict[str, Any] = {
    "name": "s",
    "tools": ["T"],
    "outcome": "completed",
    "message": "",
    "warnings": [],
    "do_steps": 30,
    "error": 1.0,
    "where": "a.y",
    "reference_change": 0.1,
    "reference_steps": 97,
    "fixed_do_steps": 60,
    "fixed_order": 1,
    "fixed_steps": 10,
    "problem": "",
}


@pytest.fixture
def quarter_car() -> CoupledFmus:
    """Our own quarter car."""
    return CoupledFmus(
        "of our own",
        {"chassis": Slave("chassis.fmu", "", {"x": 0.1}), "wheel": Slave("wheel.fmu", "")},
        (
            ("chassis.x", "wheel.x_c"),
            ("chassis.v", "wheel.v_c"),
            ("wheel.x", "chassis.x_w"),
            ("wheel.v", "chassis.v_w"),
        ),
        0.5,
    )


def test_every_connection_of_a_system_is_between_its_slaves() -> None:
    """Each input has one source, and each FMU the begin of a hash."""
    for name, system in SYSTEMS.items():
        ends = [end.partition(".")[0] for pair in system.connections for end in pair]
        assert set(ends) <= set(system.slaves), name
        targets = [target for _, target in system.connections]
        assert len(targets) == len(set(targets)), name
        assert not set(targets) & set(system.inputs), name
        assert all(len(slave.sha256) == 8 for slave in system.slaves.values()), name


def test_the_error_and_the_cost_are_those_of_the_runs(
    quarter_car: CoupledFmus, fmu_dir: Path
) -> None:
    """The reference converges, the defaults are near it, and a fixed run of that error is found."""
    fmus = {name: str(fmu_dir / f"{name}.fmu") for name in ("chassis", "wheel")}
    found = measure(quarter_car, fmus, 60.0)
    assert (found.outcome, found.problem) == ("completed", "")
    assert found.error is not None
    assert found.error < 10.0
    assert found.reference_change is not None
    assert found.reference_change <= 0.1
    assert found.fixed_steps is not None
    assert found.fixed_order is not None
    assert found.fixed_do_steps == 2 * found.fixed_steps


def test_a_run_that_is_refused_has_its_sentence(quarter_car: CoupledFmus, tmp_path: Path) -> None:
    """Also where there can be no reference."""
    fmus = {name: str(tmp_path / f"{name}.fmu") for name in ("chassis", "wheel")}
    for path in fmus.values():
        Path(path).write_text("no archive")
    found = measure(quarter_car, fmus, 1.0)
    assert found.outcome == "refused"
    assert "not a readable FMU archive" in found.message
    assert found.problem
    assert found.error is None


def test_halving_goes_on_until_nothing_changes(quarter_car: CoupledFmus, fmu_dir: Path) -> None:
    """Without time there are two runs only, and the change tells how far the reference is."""
    fmus = {name: str(fmu_dir / f"{name}.fmu") for name in ("chassis", "wheel")}
    system = system_of(quarter_car, fmus)
    scale = Scale(quarter_car, system)
    early = find_reference(system, scale, 0.0)
    assert early.steps == 2 * 97
    change, _ = scale.error(run_fixed(system, 97, 1), early.values)
    assert early.change == change
    assert find_reference(system, scale, monotonic() + 60.0).change < change


def test_extrapolation_takes_away_three_terms_of_the_error() -> None:
    """Values that are a cubic polynomial of H, at H = 1, 1/2, 1/4 and 1/8: the value at H = 0."""
    cubic = np.polynomial.Polynomial([1.0, -2.0, 3.0, 5.0])
    row: list[np.ndarray] = []
    for halving in range(4):
        row = extrapolated(row, np.array([[cubic(0.5**halving)]]))
    assert row[-1] == pytest.approx(1.0, abs=1e-12)


def test_what_is_wrong_without_a_warning_is_told() -> None:
    """A hundred tolerances; a warning excuses it, a process that ended before does not."""
    wrong = BASE | {"error": 101.0}
    broken = {"name": "b", "outcome": "broken off", "message": "exit code -11"}
    skipped = {"name": "k", "outcome": "skipped", "message": "the folder lacks a.fmu"}
    told = list(coupled.faults([BASE, wrong, wrong | {"warnings": ["w"]}, broken, skipped]))
    assert told == ["s: completed, but a.y is off by 101 tolerances", "b: exit code -11"]


def test_a_row_says_what_was_found() -> None:
    """Or why there is nothing."""
    assert coupled.row(BASE) == (
        "s",
        "T",
        "completed",
        "1 (a.y)",
        "0",
        "30",
        "60 (order 1)",
        "0.5",
    )
    assert "still changes by 3" in coupled.row(BASE | {"error": None, "reference_change": 3.0})[3]
    lost = BASE | {"error": None, "reference_change": None, "problem": "because"}
    assert coupled.row(lost)[3] == "no reference: because"
    assert coupled.row(BASE | {"outcome": "refused", "message": "no"})[2:4] == ("refused: no", "")


@pytest.mark.slow
def test_a_folder_is_measured(
    quarter_car: CoupledFmus,
    fmu_dir: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """FMUs are found by their hashes, whatever their names; a system that lacks one is skipped."""
    for name in ("chassis", "wheel"):
        shutil.copy(fmu_dir / f"{name}.fmu", tmp_path / f"any_{name}.fmu")
    hashes = {model.path.stem.removeprefix("any_"): model for model in distinct_models(tmp_path)}
    digest = sha256((fmu_dir / "wheel.fmu").read_bytes()).hexdigest()
    assert hashes["wheel"].sha256 == digest
    asked: list[dict[str, str]] = []

    def measured(_: str, fmus: dict[str, str], *_bounds: float) -> dict[str, Any]:
        asked.append(fmus)
        return json.loads(json.dumps(BASE)) | {"name": "here"}

    slaves = {name: Slave(f"{name}.fmu", model.sha256[:8]) for name, model in hashes.items()}
    here = CoupledFmus("r", slaves, (), 1.0)
    gone = CoupledFmus("r", {"wheel": Slave("lost.fmu", "00000000")}, (), 1.0)
    monkeypatch.setattr(coupled, "SYSTEMS", {"here": here, "gone": gone})
    monkeypatch.setattr(coupled, "_measure", measured)
    coupled.main([str(tmp_path)])
    table = capsys.readouterr().out
    assert "skipped: the folder lacks lost.fmu of r" in table
    assert asked == [{name: str(tmp_path / f"any_{name}.fmu") for name in slaves}]
    assert Measured("completed").error is None
