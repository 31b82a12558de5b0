"""The systems of the examples as they stand, with real FMUs, in this process and in their own.

One for each part of what FMUs can do; which example shows what stands in examples/README.md. The
examples that are not here are run where their subject is tested.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from master_node import Result, load_system, simulate
from slave_node.loading import describe_model
from tests.conftest import EXAMPLES
from tests.support.quarter_car_case import exact_solution, global_errors

pytestmark = pytest.mark.usefixtures("no_process_left")


@pytest.fixture
def capabilities(capability_dir: Path, tmp_path: Path) -> Path:
    """The folder of the examples for single capabilities, as it is once its FMUs are built."""
    folder = tmp_path / "capabilities"
    folder.mkdir()
    for file in (*capability_dir.glob("*.fmu"), *(EXAMPLES / "capabilities").glob("*.toml")):
        (folder / file.name).symlink_to(file)
    return folder


Run = Callable[..., Result]


@pytest.fixture(params=["in process", pytest.param("launched", marks=pytest.mark.slow)])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Run:
    """``run(file, ...)``: the result files of a system; launched slaves are reached over Zenoh."""
    place = {"in_process": request.param == "in process", "output": tmp_path / "results"}

    def run_system(file: Path, **simulation: Any) -> Result:
        simulate(load_system(file), **place, **simulation)
        result = Result.load(tmp_path / "results")
        assert result.summary["outcome"] == "completed"
        return result

    return run_system


def test_all_versions_and_interfaces_move_in_the_same_way(run: Run, capabilities: Path) -> None:
    """FMI 1.0, 2.0 and 3.0, co-simulation and model exchange, in one system: the exact solution."""
    result = run(capabilities / "versions.toml")
    models = result.summary["settings"]["models"]
    assert {name: model["kind"] for name, model in models.items()} == {
        "wheel": "FMI 3.0 co-simulation",
        "me3": "FMI 3.0 model exchange",
        "me2": "FMI 2.0 model exchange",
        "cs2": "FMI 2.0 co-simulation",
        "cs1": "FMI 1.0 co-simulation",
    }
    exact = exact_solution(result.time)
    assert result["wheel.x"] == pytest.approx(exact[:, 2], abs=3e-4)
    for name in ("me3", "me2", "cs2", "cs1"):
        assert result[f"{name}.x"] == pytest.approx(exact[:, 0], abs=3e-4)


def test_states_are_saved_in_three_ways_in_one_run(run: Run, capabilities: Path) -> None:
    """Natively, by forking what does not restore its state, by replaying what cannot be forked."""
    result = run(capabilities / "saved_states.toml")
    assert result.summary["state_kind"] == {"native": "native", "fork": "fork", "replay": "replay"}
    assert min(result.summary["rollbacks"].values()) > 0
    ring = np.zeros((5, 5))  # the three lags whose mean large_state shows, then the other two
    constants = np.array([0.5, 0.5 * (1.0 + 65536 / 131071), 1.0, 0.5, 0.5])
    for row, source in enumerate((4, 4, 4, None, 3)):
        ring[row, [0, 1, 2] if source is None else source] = 1 / 3 if source is None else 1.0
    ring = (ring - np.eye(5)) / constants[:, None]
    exact = np.array([expm(ring * t) @ [1, 1, 1, 0, 0] for t in result.time])
    assert result["native.y"] == pytest.approx(exact[:, :3].mean(axis=1), abs=3e-4)
    assert result["fork.y"] == pytest.approx(exact[:, 3], abs=3e-4)
    assert result["replay.y"] == pytest.approx(exact[:, 4], abs=3e-4)


def test_inputs_are_emulated(run: Run, capabilities: Path) -> None:
    """FMUs without input derivatives follow polynomials, within the tolerance."""
    file = capabilities / "emulated_inputs.toml"
    slaves = load_system(file).slaves.values()
    kinds = {describe_model(str(s.model), capabilities).input_derivatives for s in slaves}
    assert kinds == {"emulated"}
    result = run(file, stop_time=0.5)
    assert global_errors(result).max() < 1e-3
    assert max(result.steps["order"]) >= 1


def test_every_step_suits_all_slaves(run: Run, capabilities: Path) -> None:
    """A fixed step, multiples of one, a clock that was found, and a wish: multiples of 20 ms."""
    result = run(capabilities / "step_sizes.toml")
    sizes = result.steps["step_size"] / 0.02
    assert sizes == pytest.approx(np.round(sizes), abs=1e-9)
    assert result.summary["settings"]["examinations"]["clocked"]["internal_clock"] == 0.01
    ring = 2.0 * (np.roll(np.eye(4), 1, axis=0) - np.eye(4))
    exact = np.array([expm(ring * t) @ [1.0, 0.0, 0.0, 0.0] for t in result.time])
    for i, name in enumerate(("fixed", "multiple", "clocked", "preferred")):
        assert result[f"{name}.y"] == pytest.approx(exact[:, i], abs=2e-2)


def test_an_algebraic_loop_is_solved_at_the_start(run: Run, capabilities: Path) -> None:
    """Both equations hold from the first row on, one of them with a sine in it."""
    result = run(capabilities / "algebraic_loop.toml")
    first, second = result["first.y"][0], result["second.y"][0]
    assert first == pytest.approx(0.5 * second + 1.0, abs=1e-6)
    assert second == pytest.approx(-0.8 * first + 2.0 + 0.5 * np.sin(first), abs=1e-6)
    assert np.ptp(result["first.y"]) < 1e-6


def test_units_are_converted_there_and_back(run: Run, capabilities: Path) -> None:
    """Lengths by a factor, temperatures by an offset: y = (1 +- exp(-4t)) / 2 of the difference."""
    result = run(capabilities / "units.toml")
    half = 0.5 * np.exp(-4.0 * result.time)
    assert result["si.y"] == pytest.approx(0.5 + half, abs=3e-4)
    assert result["other.y"] == pytest.approx(1e3 * (0.5 - half), abs=0.3)
    assert result["si.theta_out"] == pytest.approx(273.15 + 20.0 * (0.5 + half), abs=3e-2)
    assert result["other.theta_out"] == pytest.approx(20.0 * (0.5 - half), abs=3e-2)
