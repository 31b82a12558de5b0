"""Variables that are recorded beside the outputs: of any causality, in every mode, at no cost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from typer.testing import CliRunner

from master_node import Result, System, simulate
from master_node.cli.app import app
from master_node.simulation import resume
from protocol.errors import ConfigurationError, DoublestepError
from tests.support.interrupting import Interrupt
from tests.support.quarter_car_case import EXAMPLES

LOCALS = ("drive.*", "!drive.ratio")
CONTINUOUS = ["drive.u", "drive.flow", "drive.s", "drive.der(s)"]
DISCRETE = ["drive.gain", "drive.total", "drive.mode", "drive.n", "drive.is_moving", "drive.label"]


def drives(
    folder: Path, version: int = 2, *, results: dict[str, Any] | None = None, **slave: Any
) -> System:
    """A drive with a ramp for its input, and one that it feeds."""
    model = str(folder / f"drive{version}.fmu")
    return System(
        simulation={"stop_time": 1.0, "checkpoint_interval": 1e-9},
        slaves={
            "drive": {"model": model, "parameters": {"gain": 2.0, "n": 4}, **slave},
            "second": {"model": model},
        },
        connections=[("drive.y", "second.u")],
        inputs={"drive.u": (np.array([0.0, 1.0]), np.array([1.0, 2.0]))},
        results={} if results is None else results,
    )


def check(result: Result) -> None:
    """All variables keep the laws of the drive at every point."""
    flow = 2.0 * result["drive.u"]
    assert np.array_equal(result["drive.flow"], flow)
    assert np.array_equal(result["drive.der(s)"], result["drive.y"])
    t = result.time
    assert result["drive.y"] == pytest.approx(2.0 * (t + 0.5 * t**2), abs=1e-3)
    assert result["drive.s"] == pytest.approx(t**2 + t**3 / 3.0, abs=1e-3)
    assert set(result["drive.gain"]) == {2.0}
    assert set(result["drive.total"]) == {8.0}
    assert set(result["drive.n"]) == {4}
    assert result["drive.is_moving"].tolist() == (flow != 0.0).tolist()
    assert set(result["drive.label"]) == {"forward"}


def test_every_variable_can_be_recorded(capability_dir: Path) -> None:
    """Behind the outputs in the order of the slave; the continuous ones first."""
    result = simulate(drives(capability_dir, results={"locals": LOCALS}), in_process=True)
    assert list(result.names) == ["drive.y", "second.y", *CONTINUOUS]
    assert list(result.discrete) == DISCRETE
    check(result)
    assert result.enumerations == {
        "drive.mode": {"reverse": -1, "neutral": 0, "forward": 1, "fast": 5}
    }
    assert set(result.item_names("drive.mode")) == {"forward"}


@pytest.mark.parametrize(
    ("version", "slave", "simulation"),
    [
        (2, {}, {}),
        (2, {"state": "fork"}, {}),
        (2, {"state": "replay"}, {}),
        (2, {"state": "none"}, {}),
        (3, {}, {"estimator": "rich"}),
        (2, {}, {"sequence": "gauss-seidel"}),
        (2, {}, {"estimator": "none", "initial_step_size": 0.01}),
        (2, {"outputs_follow_inputs": True}, {"evaluate_outputs": True}),
        (2, {"input_substeps": 1}, {}),
    ],
)
def test_recording_changes_nothing_else(
    capability_dir: Path, version: int, slave: dict[str, Any], simulation: dict[str, Any]
) -> None:
    """Outputs bit for bit and round trips stay; requests that read have one more call."""
    plain, recorded = (
        simulate(
            drives(capability_dir, version, results=results, **slave).with_simulation(**simulation),
            in_process=True,
        )
        for results in ({}, {"locals": LOCALS})
    )
    assert recorded.time.tobytes() == plain.time.tobytes()
    for name in plain.names:
        assert recorded[name].tobytes() == plain[name].tobytes()
    for key in ("round_trips", "do_steps", "rollbacks", "requests", "communication_steps"):
        assert recorded.summary[key] == plain.summary[key], key
    assert recorded["drive.s"][-1] == pytest.approx(4.0 / 3.0, abs=2e-2)
    assert np.array_equal(recorded["drive.der(s)"], recorded["drive.y"])


def test_fmi_1_is_read_where_it_can_be(capability_dir: Path) -> None:
    """Local variables and parameters, from the first point on."""
    system = drives(capability_dir, 1, results={"locals": ["drive.s", "drive.n", "drive.label"]})
    result = simulate(system, in_process=True)
    assert result["drive.s"][0] == 0.0
    assert result["drive.s"] == pytest.approx(result.time**2 + result.time**3 / 3.0, abs=1e-2)
    assert set(result["drive.n"]) == {4}


def test_the_same_bits_in_files_of_all_formats_over_the_bus_and_after_a_resume(
    capability_dir: Path, tmp_path: Path, no_process_left: None
) -> None:
    """CSV, Arrow, Parquet and MAT agree; a run that was broken off ends in the same files."""
    formats = ["csv", "arrow", "parquet", "mat"]
    system = drives(capability_dir, results={"locals": LOCALS, "formats": formats})
    system = system._with(inputs={"drive.u": 1.5})
    here = simulate(system, output=tmp_path / "here", in_process=True)
    for name in ("results.csv", "results.arrow", "results.parquet", "results.mat"):
        read = Result.load(tmp_path / "here" / name if name != "results.csv" else tmp_path / "here")
        for column in here.names:
            assert read[column].tobytes() == here[column].tobytes(), (name, column)
    simulate(system, output=tmp_path / "bus")

    with pytest.raises(DoublestepError, match="interrupted"):
        simulate(system, output=tmp_path / "cut", observers=[Interrupt(6)])
    resume(tmp_path / "cut")
    csv = [(tmp_path / folder / "results.csv").read_bytes() for folder in ("here", "bus", "cut")]
    assert csv[0] == csv[1] == csv[2]
    loaded = Result.load(tmp_path / "cut")
    assert list(loaded.discrete) == DISCRETE
    assert loaded.enumerations == here.enumerations
    assert loaded.summary["enumerations"] == {
        name: dict(i) for name, i in here.enumerations.items()
    }


def test_values_that_are_not_finite_stay_what_they_are(capability_dir: Path) -> None:
    """A recorded variable rejects no step and ends no run."""
    system = drives(capability_dir, results={"locals": ["drive.ratio"]})
    result = simulate(system._with(inputs={"drive.u": 0.0}), in_process=True)
    assert result.summary["outcome"] == "completed"
    assert np.isposinf(result["drive.ratio"]).all()


def test_recorded_variables_are_read_with_the_outputs(capability_dir: Path, tmp_path: Path) -> None:
    """One more call in each request that reads a solution, of the slave that records."""

    def requests(**results: Any) -> list[tuple[str, int]]:
        file = tmp_path / f"{len(results)}.json"
        simulate(drives(capability_dir, results=results), in_process=True, trace=file)
        events = json.loads(file.read_text())
        return [
            (event["name"], event["args"]["calls"])
            for event in (events["traceEvents"] if isinstance(events, dict) else events)
            if "calls" in event.get("args", {})
        ]

    plain, recorded = requests(), requests(locals=["drive.s"])
    assert [name for name, _ in plain] == [name for name, _ in recorded]
    more = [b - a for (name, a), (_, b) in zip(plain, recorded, strict=True) if "do_step" in name]
    assert more == [1, 0] * (len(more) // 2)  # the drive, and the one that it feeds


def test_on_a_grid_continuous_ones_are_interpolated_and_others_held(capability_dir: Path) -> None:
    """They are read as outputs are: by polynomials through communication points, or as before."""
    system = drives(capability_dir, results={"locals": LOCALS})
    grid = simulate(system.with_simulation(output_interval=0.05), in_process=True)
    assert grid.time == pytest.approx(np.arange(21) * 0.05)
    assert grid["drive.s"] == pytest.approx(grid.time**2 + grid.time**3 / 3.0, abs=1e-3)
    assert grid["drive.der(s)"] == pytest.approx(grid["drive.y"], abs=1e-4)
    assert set(grid["drive.label"]) == {"forward"}


# ---- Which variables ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("results", "names"),
    [
        ({"variables": ["drive.s"]}, {"drive.s"}),
        ({"variables": ["drive.y", "drive.n"]}, {"drive.y", "drive.n"}),
        ({"variables": ["second.*"], "locals": ["drive.s"]}, {"second.y", "drive.s"}),
        (
            {"variables": ["!second.*"], "locals": ["drive.*", "!*.?", "!drive.*a*"]},
            {"drive.y", "drive.flow", "drive.der(s)", "drive.mode", "drive.is_moving"},
        ),
        ({"locals": ["*.n"], "every": 3}, {"drive.y", "second.y", "drive.n", "second.n"}),
    ],
)
def test_patterns_choose(capability_dir: Path, results: dict[str, Any], names: set[str]) -> None:
    """``variables`` among the outputs, or one variable by its name; ``locals`` among all others."""
    result = simulate(drives(capability_dir, results=results), in_process=True)
    assert set(result) == names


def test_they_can_be_asked_for_at_the_prompt(capability_dir: Path, tmp_path: Path) -> None:
    """``--output-locals`` stands for ``locals``."""
    file = tmp_path / "drive.toml"
    model = str(capability_dir / "drive2.fmu")
    file.write_text(
        tomli_w.dumps({"simulation": {"stop_time": 0.1}, "slaves": {"drive": {"model": model}}}),
        encoding="utf-8",
    )
    words = ["run", str(file), "--in-process", "--no-plot", "--output", str(tmp_path / "out")]
    chosen = ["--output-locals", "*.s", "--output-locals", "*.n"]
    done = CliRunner().invoke(app, [*words, *chosen])
    assert done.exit_code == 0, done.output
    assert set(Result.load(tmp_path / "out")) == {"drive.y", "drive.s", "drive.n"}


@pytest.mark.parametrize(
    ("results", "told"),
    [
        (
            {"locals": ["drive.los"]},
            r"\[results\] locals: 'drive.los' matches no variable beside the outputs; did you mean",
        ),
        ({"locals": ["drive.y"]}, "'drive.y' matches no variable beside the outputs"),
        ({"variables": ["drive.q"]}, r"\[results\] variables: 'drive.q' matches no variable"),
        ({"variables": ["*.flow"]}, r"'\*.flow' matches no variable.*locals = "),
        ({"variables": ["!*.y"]}, "variables leaves no variable"),
    ],
)
def test_patterns_that_choose_nothing_are_named(
    capability_dir: Path, results: dict[str, Any], told: str
) -> None:
    """Before the first step."""
    with pytest.raises(ConfigurationError, match=told):
        simulate(drives(capability_dir, results=results), in_process=True)


def test_states_inputs_and_parameters_of_python_models_are_recorded() -> None:
    """All but outputs are there; the same values over the bus as in process."""
    wheel = {"model": "quarter_car.py:Wheel"}
    system = System(
        simulation={"stop_time": 0.1, "initial_step_size": 1e-3},
        slaves={"chassis": {"model": "quarter_car.py:Chassis"}, "wheel": wheel},
        connections=[
            ("chassis.x", "wheel.x_c"),
            ("chassis.v", "wheel.v_c"),
            ("wheel.x", "chassis.x_w"),
            ("wheel.v", "chassis.v_w"),
        ],
        results={"locals": ["wheel.*"]},
        base=EXAMPLES,
    )
    result = simulate(system, in_process=True)
    assert result["wheel.x_c"] == pytest.approx(result["chassis.x"], abs=1e-4)
    assert {"wheel.x_c", "wheel.v_c"} <= set(result.names)
    assert {"wheel.m", "wheel.k_c"} <= set(result.discrete)


# ---- Systems without outputs --------------------------------------------------------------------


@pytest.mark.parametrize("state", ["native", "none"])
def test_a_system_without_outputs_runs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, state: str
) -> None:
    """In steps of a thousandth of the simulated time, which a warning says; results may hold
    what is recorded.
    """
    (tmp_path / "silent.py").write_text(
        "from slave_node.python.model_slave import Model, real\n"
        "class Silent(Model):\n"
        "    states = (real('x', start=1.0),)\n"
        "    def derivatives(self, t, x, u):\n"
        "        return -x\n"
    )
    system = System(
        simulation={"stop_time": 2.0},
        slaves={"a": {"model": "silent.py:Silent", "state": state}},
        base=tmp_path,
    )
    empty = simulate(system, output=tmp_path / "empty", in_process=True)
    assert list(empty) == []
    assert empty.time[-1] == 2.0
    assert "no slave has a continuous output, so there is no error to control" in caplog.text
    assert "steps are of 0.002 s at most" in caplog.text
    assert (tmp_path / "empty" / "results.csv").read_text().startswith("time\n0.0\n")
    recorded = simulate(
        system.with_simulation(events=(0.3,)).with_results(locals=("a.x",)), in_process=True
    )
    assert recorded["a.x"] == pytest.approx(np.exp(-recorded.time), rel=1e-5)
    assert np.diff(recorded.time).max() <= 0.002 * (1.0 + 1e-9)
    fixed = simulate(
        system.with_results(locals=("a.x",)),
        in_process=True,
        estimator="none",
        initial_step_size=0.5,
    )
    assert fixed["a.x"] == pytest.approx(np.exp([0.0, -0.5, -1.0, -1.5, -2.0]), rel=1e-5)
