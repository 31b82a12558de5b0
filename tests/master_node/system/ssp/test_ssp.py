"""SSP: packages run, as their example and as the systems that they were made of."""

from __future__ import annotations

from pathlib import Path

import pytest

from master_node import open_system
from master_node.system.files import read_ssp
from tests.support.quarter_car_case import EXAMPLES
from tests.support.ssp_documents import DIRECT, invoke, pairs


@pytest.fixture
def displacement(fmu_dir: Path) -> Path:
    """The system file of the quarter car, where its FMUs are."""
    path = fmu_dir / "displacement.toml"
    path.write_bytes((EXAMPLES / "displacement.toml").read_bytes())
    return path


def test_a_package_runs_as_the_system_that_it_was_made_of(
    displacement: Path, tmp_path: Path
) -> None:
    """Export, run, and the same run from TOML: equal files, byte for byte."""
    invoke("export", displacement, "-o", tmp_path / "car.ssp")
    for name, file in (("ssp", tmp_path / "car.ssp"), ("toml", displacement)):
        invoke("run", file, "--in-process", "--quiet", "--no-plot", "--output", tmp_path / name)
    results = [(tmp_path / name / "results.csv").read_bytes() for name in ("ssp", "toml")]
    assert results[0] == results[1]
    assert results[0].count(b"\n") > 100


def test_the_package_runs_in_processes_of_its_own(
    quarter_car_ssp: Path, tmp_path: Path, no_process_left: None
) -> None:
    """Launched slaves find the extracted models; those are gone afterwards."""
    arguments = ("--stop-time", "0.1", "--quiet", "--no-plot")
    for name, more in (("bus", ()), ("here", ("--in-process",))):
        invoke("run", quarter_car_ssp, *arguments, *more, "--output", tmp_path / name)
    results = [(tmp_path / name / "results.csv").read_bytes() for name in ("bus", "here")]
    assert results[0] == results[1]
    with open_system(quarter_car_ssp) as car:
        base = car.base
        assert base.is_dir()
    assert not base.exists()


def test_the_example_is_the_quarter_car(quarter_car_ssp: Path, tmp_path: Path) -> None:
    """Through a nested system and its connectors, with nothing to be noted."""
    read = read_ssp(quarter_car_ssp, tmp_path)
    assert read.notes == ()
    renamed = {(s.replace("axle.", ""), t.replace("axle.", "")) for s, t in pairs(read.system)}
    assert renamed == set(DIRECT)
    assert read.system.slaves["axle.wheel"].parameters == {"z": 0.1}
    assert (read.system.simulation.start_time, read.system.simulation.stop_time) == (0.0, 4.0)
