"""Iterated double steps: stiff coupling by few steps, the same bits everywhere, and never blind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from master_node import Result, System, load_system, simulate
from tests.faults.test_recovery import car as trapped_car
from tests.faults.test_recovery import files
from tests.master_node.resuming.test_resume import car, contents, interrupted
from tests.support.quarter_car_case import EXAMPLES
from tests.support.slow import quick_at

pytestmark = pytest.mark.usefixtures("no_process_left")

STIFF = EXAMPLES.parent / "stiff"
VESSEL = str(STIFF / "vessels.py:Vessel")
STOP = 10.0


def vessels(k: float, tolerance: float, **simulation: Any) -> System:
    """Two vessels that exchange k (p1 - p2)."""
    tolerances = {"relative_tolerance": tolerance, "absolute_tolerance": tolerance}
    return System(
        simulation={"stop_time": STOP, **tolerances, **simulation},
        slaves={
            "a": {"model": VESSEL, "parameters": {"k": k, "q": 1.0}},
            "b": {"model": VESSEL, "parameters": {"k": k, "p": 0.0, "C": 2.0}},
        },
        connections=[("a.p", "b.p_other"), ("b.p", "a.p_other")],
    )


def errors(result: Result, k: float, tolerance: float) -> np.ndarray:
    """Errors of both pressures over tolerance (1 + |p|), shape (points,): the larger one."""

    def whole(_: float, p: np.ndarray) -> list[float]:
        return [1.0 - 0.5 * p[0] + k * (p[1] - p[0]), (-0.5 * p[1] + k * (p[0] - p[1])) / 2.0]

    exact = solve_ivp(
        whole, (0.0, STOP), [1.0, 0.0], method="Radau", rtol=1e-10, atol=1e-12, dense_output=True
    ).sol(result.time)
    found = np.array([result["a.p"], result["b.p"]])
    ratios: np.ndarray = (np.abs(found - exact) / (tolerance * (1.0 + np.abs(exact)))).max(axis=0)
    return ratios


@pytest.mark.parametrize("sequence", ["jacobi", "gauss-seidel"])
@pytest.mark.parametrize("estimator", quick_at(["mod"], ["mod", "rich"]))
@pytest.mark.parametrize("k", [1e2, 1e5])
@pytest.mark.parametrize(("tolerance", "most", "largest"), [(1e-3, 500, 3.0), (1e-5, 900, 10.0)])
def test_a_stiff_exchange_takes_few_steps(  # noqa: PLR0917
    sequence: str, estimator: str, k: float, tolerance: float, most: int, largest: float
) -> None:
    """With the defaults, whatever k is: it is noticed that double steps have to be iterated."""
    system = vessels(k, tolerance, sequence=sequence, estimator=estimator)
    result = simulate(system, in_process=True)
    assert result.summary["iterated_double_steps"] > 5
    assert max(result.summary["do_steps"].values()) <= most
    assert errors(result, k, tolerance).max() <= largest
    assert not result.summary["warnings"]


@pytest.mark.parametrize("k", quick_at([1e6], [1e3, 1e6]))
def test_a_first_step_that_is_far_too_large(k: float) -> None:
    """A blind estimate is not believed from the first attempt on: the loop gain enlarges it."""
    result = simulate(vessels(k, 1e-3, initial_step_size=0.5), in_process=True)
    assert errors(result, k, 1e-3).max() <= 10.0


def test_extrapolation_does_not_end_without_a_word() -> None:
    """The method that is asked for is taken: the summary warns that its estimate tells little."""
    system = vessels(1e2, 1e-3, coupling="explicit", sequence="gauss-seidel")
    result = simulate(system, in_process=True)
    assert errors(result, 1e2, 1e-3).max() > 20.0
    assert any("stiff" in text for text in result.summary["warnings"])


@pytest.mark.parametrize("k", quick_at([1e4], [1.0, 1e4]))
def test_the_error_follows_the_tolerance(k: float) -> None:
    """Law of order 3: a hundred times less error for five times as many double steps or fewer."""
    accepted = []
    for tolerance in (1e-3, 1e-5, 1e-7):
        result = simulate(vessels(k, tolerance, coupling="implicit"), in_process=True)
        assert errors(result, k, tolerance).max() <= 20.0
        accepted.append(result.summary["communication_steps"])
    assert accepted[1] < 5.0 * accepted[0]
    assert accepted[2] < 5.0 * accepted[1]


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_nothing_changes_where_nothing_is_stiff(tolerance: float, tmp_path: Path) -> None:
    """Bit for bit: the quarter car as with extrapolated inputs, without one iterated step."""
    tolerances = f"relative_tolerance = {tolerance}\nabsolute_tolerance = {tolerance}\n"
    both = [
        simulate(
            car(tmp_path / coupling, f"stop_time = 1.0\n{tolerances}coupling = '{coupling}'\n"),
            in_process=True,
        )
        for coupling in ("auto", "explicit")
    ]
    assert both[0].outputs.tobytes() == both[1].outputs.tobytes()
    assert both[0].summary["iterated_double_steps"] == 0


ITERATED = "stop_time = 0.5\ncoupling = 'implicit'\n"


@pytest.mark.parametrize("sequence", ["jacobi", "gauss-seidel"])
def test_the_quarter_car_iterated(sequence: str, tmp_path: Path) -> None:
    """Near the solution with extrapolated inputs at a far lower tolerance."""
    simulation = f"stop_time = 0.5\nsequence = '{sequence}'\n"
    near = simulate(car(tmp_path / "near", f"{simulation}coupling = 'implicit'\n"), in_process=True)
    low = "relative_tolerance = 1e-9\nabsolute_tolerance = 1e-9\noutput_interval = 1e-3\n"
    exact = simulate(car(tmp_path / "exact", simulation + low), in_process=True)
    assert near.summary["iterated_double_steps"] == near.summary["communication_steps"] // 2
    for name in near.summary["units"]:
        expected = np.interp(near.time, exact.time, exact[name])
        assert np.abs(near[name] - expected).max() < 1e-3 * (1.0 + np.abs(expected).max())


def test_an_iterated_run_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    """Law: broken off anywhere, its secants and its choice of method are in the checkpoint."""
    for number, system in enumerate((car(tmp_path, ITERATED), vessels(1e4, 1e-3))):
        whole, parts = tmp_path / f"whole {number}", tmp_path / f"parts {number}"
        simulate(system, output=whole, in_process=True)
        interrupted(system, parts, 5, 7, 9)
        assert contents(parts) == contents(whole)


@pytest.mark.parametrize("state", ["fork", "replay"])
def test_saved_states_of_all_kinds(state: str, tmp_path: Path) -> None:
    """Bit for bit the same as with native states, in process and over Zenoh."""
    system = car(tmp_path, "stop_time = 0.1\ncoupling = 'implicit'\n")
    native = simulate(system, in_process=True)
    slaves = {
        name: slave.model_copy(update={"state": state}) for name, slave in system.slaves.items()
    }
    other = simulate(system.model_copy(update={"slaves": slaves}), output=tmp_path / "out")
    assert other.summary["state_kind"] == dict.fromkeys(slaves, state)
    assert other.outputs.tobytes() == native.outputs.tobytes()
    assert other.time.tobytes() == native.time.tobytes()


def test_killed_slaves_come_back(tmp_path: Path) -> None:
    """SIGKILL of node and worker in the middle of an iteration: the same files."""
    simulation = "stop_time = 0.2\nlargest_step_size = 2e-3\ncoupling = 'implicit'\n"
    undisturbed = files(trapped_car(tmp_path / "a", simulation), tmp_path / "a", in_process=True)
    traps = "0.05 kill worker, 0.11 kill node"
    killed = trapped_car(tmp_path / "b", simulation, traps=traps)
    assert files(killed, tmp_path / "b") == undisturbed


def test_the_example_is_iterated(tmp_path: Path) -> None:
    """Bit for bit the same over Zenoh and in process; ``steps.csv`` tells the iterations."""
    system = load_system(STIFF / "vessels.toml")
    there = simulate(system, output=tmp_path / "there")
    here = simulate(system, in_process=True)
    assert there.outputs.tobytes() == here.outputs.tobytes()
    assert there.time.tobytes() == here.time.tobytes()
    steps = Result.load(tmp_path / "there").steps
    iterated = steps["accepted"] & (steps["iterations"] > 0)
    assert iterated.sum() == there.summary["iterated_double_steps"] > 10
    assert any("stiff coupling" in text for text in steps["limiting_variable"])


def test_a_jump_between_iterated_steps(oscillator_dir: Path) -> None:
    """A source that jumps is met as with extrapolated inputs: the history is cut there."""
    system = load_system(EXAMPLES.parent / "oscillators" / "kick.toml")
    del oscillator_dir  # built by then
    found = simulate(system, in_process=True, coupling="implicit", stop_time=3.0)
    low = {"relative_tolerance": 1e-7, "absolute_tolerance": 1e-7, "output_interval": 1e-3}
    exact = simulate(system, in_process=True, stop_time=3.0, **low)
    assert found.summary["discontinuities"] >= 1
    for name in ("left.x", "right.x"):
        expected = np.interp(found.time, exact.time, exact[name])
        assert np.abs(found[name] - expected).max() < 1e-3


def test_inputs_that_are_held_cannot_be_iterated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It is said, and inputs are extrapolated."""
    system = car(tmp_path, "stop_time = 0.05\ncoupling = 'implicit'\n")
    wheel = system.slaves["wheel"].model_copy(update={"input_substeps": 1})
    held = system.model_copy(update={"slaves": {**system.slaves, "wheel": wheel}})
    result = simulate(held, in_process=True)
    assert result.summary["iterated_double_steps"] == 0
    assert "those of wheel do not" in caplog.text
