"""Laws of the Gauss-Seidel sequence: slaves one after the other, with the same estimates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_node import load_system, simulate
from master_node.numerics.extrapolation import POLYNOMIALS, InputPolynomial
from protocol.calls import StepResult, StepStatus
from tests.support.quarter_car_case import (
    CHASSIS,
    EXAMPLES,
    STATES,
    WHEEL,
    LinearSlave,
    car,
    exact_solution,
    global_errors,
    limit_of_deviations,
    run_slaves,
)
from tests.support.slow import quick_at

OSCILLATORS = EXAMPLES.parent / "oscillators"
SEQUENCE = {"sequence": "gauss-seidel"}


@pytest.mark.parametrize("estimator", ["mod", "rich"])
@pytest.mark.parametrize("name", ["two_mass", "chain"])
def test_a_double_step_costs_two_round_trips_for_each_slave(
    oscillator_dir: Path, name: str, estimator: str
) -> None:
    """Each slave still gets two requests; they follow each other."""
    system = load_system(OSCILLATORS / f"{name}.toml")
    options = {"initial_step_size": 1e-2, "estimator": estimator, "coupling": "explicit"}
    options |= SEQUENCE
    summary = simulate(system, in_process=True, stop_time=2.0, **options).summary
    attempts = summary["communication_steps"] // 2 + summary["rejected_double_steps"]
    slaves = len(system.slaves)
    assert summary["round_trips"] == 2 * slaves * attempts
    assert set(summary["requests"].values()) == {2 * attempts}
    assert set(summary["do_steps"].values()) == {3 * attempts}


@pytest.mark.parametrize("estimator", quick_at(["mod"], ["mod", "rich"]))
@pytest.mark.parametrize("order", quick_at([1, 2, "auto"], [0, 1, 2, 3, "auto"]))
def test_the_error_is_controlled(estimator: str, order: Any, fmu_dir: Path) -> None:
    """No more steps than a Jacobi sequence takes, and an error of the same size."""
    options = {"estimator": estimator, "order": order}
    system = car("chassis.fmu", "wheel.fmu", base=fmu_dir, **options)
    jacobi, seidel = run_slaves(system), run_slaves(system.with_simulation(**SEQUENCE))
    assert jacobi.error is None
    assert seidel.error is None
    steps = [run.result.summary["communication_steps"] for run in (jacobi, seidel)]
    assert steps[1] <= 1.05 * steps[0]
    assert global_errors(seidel.result).mean() <= 2.0 * global_errors(jacobi.result).mean() + 3e-4


@pytest.mark.parametrize("k", range(4))
def test_the_order_is_k_plus_1(k: int, fmu_dir: Path) -> None:
    """Law: with fixed H the error falls at least as H^(k+1), behind the kink at the start."""
    errors = []
    for step_size in (2e-3, 1e-3):
        system = car(
            "chassis.fmu",
            "wheel.fmu",
            base=fmu_dir,
            estimator="none",
            order=k,
            initial_step_size=step_size,
            slave_tolerance=1e-12,
            stop_time=0.5,
            **SEQUENCE,
        )
        run = run_slaves(system)
        assert run.error is None
        errors.append(global_errors(run.result)[-1])
    assert np.log2(errors[0] / errors[1]) > min(k + 1, 2) - 0.35


@pytest.mark.parametrize("estimator", ["mod", "rich"])
@pytest.mark.parametrize("polynomial", POLYNOMIALS, ids=str)
@pytest.mark.parametrize("factor", [1.0, 0.3])
def test_the_estimate_tends_to_the_true_error(
    estimator: str, polynomial: InputPolynomial, factor: float
) -> None:
    """Law: EST / true local error -> 1 as H -> 0, for inputs known ahead too, after any change."""
    near, limit = limit_of_deviations(polynomial, factor, estimator=estimator, **SEQUENCE)
    assert limit == pytest.approx(0.0, abs=0.08)
    assert near < 0.3


class NoNumber(LinearSlave):
    """Its velocity is no number from t = 0.03 s on."""

    time = 0.0

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.time = communication_point + step_size
        return super().do_step(communication_point, step_size, prior)

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        y = super().get_outputs(order)
        if self.time > 0.03:
            y[0, 1] = np.nan
        return y


class Hearing(LinearSlave):
    """Keeps all inputs that it is given."""

    def __init__(self, *arguments: Any) -> None:
        self.heard: list[np.ndarray] = []
        super().__init__(*arguments)

    def set_inputs(self, derivatives: np.ndarray) -> None:
        """See `Slave`."""
        self.heard.append(derivatives.copy())
        super().set_inputs(derivatives)


@pytest.mark.parametrize("estimator", ["mod", "rich", "none"])
def test_what_is_no_number_reaches_no_other_slave(estimator: str) -> None:
    """Law: also where outputs are handed on within a step, NaN stays with whom it comes from."""
    wheel = Hearing(WHEEL, np.zeros(2))
    slaves = {"chassis": NoNumber(CHASSIS, np.zeros(2)), "wheel": wheel}
    options = {"estimator": estimator, "smallest_step_size": 1e-6, **SEQUENCE}
    run = run_slaves(car(stop_time=0.1, **options), slaves)
    assert run.error is not None
    assert "chassis.v is not finite" in str(run.error)
    assert np.isfinite(run.result.outputs).all()
    assert all(np.isfinite(u).all() for u in wheel.heard)


class Stumbling(LinearSlave):
    """Discards its n-th do_step."""

    at = 7

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.at -= 1
        if self.at == 0:
            return StepResult(StepStatus.DISCARD, communication_point)
        return super().do_step(communication_point, step_size, prior)


@pytest.mark.parametrize("at", range(4, 11))
@pytest.mark.parametrize("estimator", ["mod", "rich"])
@pytest.mark.parametrize("first", [True, False])
def test_a_slave_that_fails_takes_back_only_what_was_done(
    first: bool, estimator: str, at: int
) -> None:
    """Law: whichever slave discards whichever step, all go on from the same accepted state.

    When the first slave of the sequence fails, the second has not begun the double step and has
    saved no state for it.
    """
    chassis = (Stumbling if first else LinearSlave)(CHASSIS, np.zeros(2))
    wheel = (LinearSlave if first else Stumbling)(WHEEL, np.zeros(2))
    (chassis if first else wheel).at = at  # type: ignore[attr-defined]
    options = {"estimator": estimator, "order": 2, "stop_time": 0.3, **SEQUENCE}
    run = run_slaves(car(**options), {"chassis": chassis, "wheel": wheel})
    assert run.error is None
    assert (~run.result.steps["accepted"]).sum() >= 1
    y = np.column_stack([run.result[name] for name in STATES])
    assert np.abs(y - exact_solution(run.result.time)).max() < 2e-3


def test_in_process_and_over_zenoh_the_same_bits(fmu_dir: Path) -> None:
    """Real processes, one slave after the other."""
    system = load_system(EXAMPLES / "displacement.toml")
    slaves = {name: {"model": str(fmu_dir / f"{name}.fmu")} for name in system.slaves}
    system = type(system)(
        simulation=system.simulation, slaves=slaves, connections=system.connections
    )
    options: dict[str, Any] = {"stop_time": 0.3, "evaluate_outputs": True, **SEQUENCE}
    near = simulate(system, in_process=True, **options)
    far = simulate(system, **options)
    assert near.time.tobytes() == far.time.tobytes()
    assert near.outputs.tobytes() == far.outputs.tobytes()
