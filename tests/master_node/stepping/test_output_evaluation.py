"""Laws of ``evaluate_outputs``: outputs with direct feed-through belong to the inputs there are."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from master_node import Result, System
from master_node.numerics.extrapolation import POLYNOMIALS, InputPolynomial
from protocol.calls import StepResult
from protocol.errors import StepRejectedError, StepSizeError
from protocol.slave import Slave
from tests.support.places import SUPPORT
from tests.support.quarter_car_case import (
    ALL,
    CHASSIS_FORCE,
    D_C,
    FORCE,
    K_C,
    WHEEL_FORCE,
    LinearSlave,
    car,
    exact_outputs,
    limit_of_deviations,
    run_slaves,
)

MODELS = "quarter_car_models.py"
ESTIMATORS = ("rich", "mod")
FOLLOWS = replace(ALL, max_output_derivative_order=1, outputs_follow_inputs=True)
VALUES_ONLY = [p for p in POLYNOMIALS if not p.derivative_points]


def force_car(**simulation: Any) -> System:
    """The car with a force over the cut."""
    return car(connections=FORCE, **{"stop_time": 0.5, "evaluate_outputs": True, **simulation})


def exact_slaves(chassis: type[LinearSlave] = LinearSlave) -> dict[str, Slave]:
    """Its slaves, propagated exactly, whose outputs follow their inputs without a step."""
    return {
        "chassis": chassis(CHASSIS_FORCE, np.zeros(2), FOLLOWS),
        "wheel": WHEEL_FORCE.slave(capabilities=FOLLOWS),
    }


def completed(system: System, slaves: dict[str, Slave] | None = None) -> Result:
    """The result of a run that came to its end."""
    run = run_slaves(system, exact_slaves() if slaves is None else slaves)
    if run.error is not None:
        raise run.error
    return run.result


def force_of(result: Result) -> np.ndarray:
    """Force for the positions and velocities at the communication points."""
    stretch = result["wheel.x"] - result["chassis.x"]
    rate = result["wheel.v"] - result["chassis.v"]
    return np.asarray(K_C * stretch + D_C * rate)


@pytest.mark.parametrize("sequence", ["jacobi", "gauss-seidel"])
@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
def test_outputs_are_consistent_at_every_communication_point(estimator: str, sequence: str) -> None:
    """Law: the force is that of the positions and velocities beside it, up to rounding.

    Without the evaluation it is that of extrapolated ones.
    """
    options = {"estimator": estimator, "order": 1, "sequence": sequence}
    result = completed(force_car(**options))
    force = result["wheel.F"]
    assert force == pytest.approx(force_of(result), rel=1e-12, abs=1e-9)
    if sequence == "jacobi":
        without = completed(force_car(evaluate_outputs=False, **options))
        assert np.abs(without["wheel.F"] - force_of(without)).max() > 1e-3


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_the_order_k_plus_2_is_kept(estimator: str, k: int) -> None:
    """Law: P = k + 2 as without feed-through, so there are fewer steps for the same tolerance.

    And the error of the force is no larger.
    """
    results = [
        completed(
            force_car(preset="paper", estimator=estimator, order=k, evaluate_outputs=evaluate)
        )
        for evaluate in (True, False)
    ]
    steps = [result.summary["communication_steps"] for result in results]
    assert steps[0] < 0.85 * steps[1]
    for result, exponent in zip(results, (k + 2, k + 1), strict=True):
        attempts = result.steps[:-5]
        factor = np.clip(0.85 * attempts["error_norm"][:-1] ** (-1.0 / exponent), 0.3, 2.0)
        following = attempts["step_size"][:-1] * factor
        assert attempts["step_size"][1:] == pytest.approx(following, rel=1e-9)


@pytest.mark.parametrize("order", [1, 2, "auto"])
def test_the_force_is_as_good_as_the_tolerance_asks(order: Any) -> None:
    """Against the exact solution, relative to its size; with fewer steps."""
    results = [
        completed(force_car(order=order, evaluate_outputs=evaluate)) for evaluate in (True, False)
    ]
    exact = np.array([exact_outputs(["wheel.F"], t)[0, 0] for t in results[0].time])
    error = np.abs(results[0]["wheel.F"] - exact).mean()
    assert error < 1e-2 * np.abs(exact).max()
    steps = [result.summary["communication_steps"] for result in results]
    assert steps[0] < 0.9 * steps[1]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("polynomial", VALUES_ONLY, ids=str)
@pytest.mark.parametrize("outputs", [("wheel.F",), ("chassis.x", "chassis.v")], ids=str)
def test_the_estimate_tends_to_the_true_error(
    estimator: str, polynomial: InputPolynomial, outputs: tuple[str, ...]
) -> None:
    """Law: EST / true local error -> 1, for the force too, also after a change of H."""
    for factor in (1.0, 0.3):
        near, limit = limit_of_deviations(
            polynomial,
            factor,
            outputs,
            parts={"chassis": CHASSIS_FORCE, "wheel": WHEEL_FORCE},
            connections=FORCE,
            capabilities=FOLLOWS,
            estimator=estimator,
            evaluate_outputs=True,
            time=0.1,
        )
        assert limit == pytest.approx(0.0, abs=0.06)
        assert near < 0.15


# ---- Algebraic loops ----------------------------------------------------------------------------

LOOP = (("a.y", "b.u"), ("b.y", "a.u"))


def loop(gain_a: float, gain_b: float, **simulation: Any) -> System:
    """Two models whose outputs contain each other."""
    slaves = {
        name: {"model": f"{MODELS}:Filter", "parameters": {"gain": gain, "x": x}}
        for name, gain, x in (("a", gain_a, 1.0), ("b", gain_b, -0.5))
    }
    settings = {"stop_time": 2.0, "evaluate_outputs": True, "order": 2, **simulation}
    return System(simulation=settings, slaves=slaves, connections=LOOP, base=SUPPORT)


@pytest.mark.parametrize("gains", [(0.5, 0.6), (2.0, -3.0), (-1.5, 0.9)])
def test_an_algebraic_loop_is_solved_at_every_communication_point(
    gains: tuple[float, float],
) -> None:
    """y_a = x_a + g_a y_b and y_b = x_b + g_b y_a, whatever the gains: against the solution."""
    direct = np.linalg.inv([[1.0, -gains[0]], [-gains[1], 1.0]])  # y = direct x
    tolerance = {"relative_tolerance": 1e-6, "absolute_tolerance": 1e-6}
    run = run_slaves(loop(*gains, **tolerance))
    assert run.error is None
    result = run.result
    y = np.column_stack([result["a.y"], result["b.y"]])
    matrix = np.array([[0.0, 1.0], [1.0, 0.0]]) @ direct - np.eye(2)
    exact = np.array([direct @ expm(matrix * t) @ [1.0, -0.5] for t in result.time])
    size = np.abs(exact).max()
    assert np.abs(y - exact).max() < 1e-4 * size
    assert run.result.summary["rejected_double_steps"] < 5


@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
def test_a_loop_that_has_no_solution_any_more_is_named(estimator: str) -> None:
    """From t = 0.5 s on its gain is 1: the run ends there, with the loop and the residual."""
    system = loop(0.5, 0.5, estimator=estimator, initial_step_size=0.01)
    slaves = {name: slave.model_dump() for name, slave in system.slaves.items()}
    for slave in slaves.values():
        slave["model"] = f"{MODELS}:LateLoop"
    system = System(simulation=system.simulation, slaves=slaves, connections=LOOP, base=system.base)
    run = run_slaves(system)
    assert isinstance(run.error, StepRejectedError)
    text = str(run.error)
    assert "the algebraic loop " in text
    assert "a.y -> b.y" in text
    assert "residual" in text
    assert 0.4 < run.result.time[-1] <= 0.5


def test_a_loop_that_is_not_evaluated_is_named_where_no_step_is_small_enough() -> None:
    """Errors grow round it whatever H is, so the tolerances alone are no remedy. Where the loop is
    evaluated it is not named.
    """
    run = run_slaves(loop(2.0, -3.0, evaluate_outputs=False, coupling="explicit"))
    assert isinstance(run.error, StepSizeError)
    assert "a.y -> b.y" in run.error.remedy
    assert "evaluate_outputs" in run.error.remedy
    hopeless = run_slaves(loop(0.5, 0.6, smallest_step_size=0.5, relative_tolerance=1e-9))
    assert isinstance(hopeless.error, StepSizeError)
    assert "loop" not in hopeless.error.remedy


# ---- Who takes part -----------------------------------------------------------------------------


def test_an_fmu_does_so_by_the_word_of_its_user_only(fmu_dir: Path) -> None:
    """FMI 2.0 does not promise that outputs follow inputs without a step: a warning says so.

    With ``outputs_follow_inputs = true`` they are evaluated, and there is no warning.
    """
    system = car("chassis_force.fmu", "wheel_force.fmu", base=fmu_dir, connections=FORCE)
    system = system.with_simulation(stop_time=0.05, evaluate_outputs=True)
    silent = run_slaves(system)
    assert silent.error is None
    (warning,) = silent.warnings
    assert warning.startswith("wheel: its outputs with direct feed-through cannot be evaluated")
    assert "[slaves.wheel] outputs_follow_inputs = true" in warning
    slaves = {name: slave.model_dump() for name, slave in system.slaves.items()}
    slaves["wheel"]["outputs_follow_inputs"] = True
    told = run_slaves(
        System(
            simulation=system.simulation,
            slaves=slaves,
            connections=system.connections,
            base=system.base,
        )
    )
    assert told.error is None
    assert told.warnings == []
    requests = [
        run.result.summary["requests"]["wheel"] / len(run.result.steps) for run in (silent, told)
    ]
    assert requests == pytest.approx([2.0, 6.0], abs=0.5)  # and those of the first trial
    errors = []
    for run in (silent, told):
        exact = [exact_outputs(["wheel.F"], t)[0, 0] for t in run.result.time]
        errors.append(np.abs(run.result["wheel.F"] - exact).max())
    assert errors[1] < 10.0


def test_a_slave_can_be_left_out() -> None:
    """``outputs_follow_inputs = false`` wins over what is known of the slave."""
    system = force_car()
    slaves = {name: slave.model_dump() for name, slave in system.slaves.items()}
    slaves["wheel"]["outputs_follow_inputs"] = False
    system = System(
        simulation=system.simulation,
        slaves=slaves,
        connections=system.connections,
        base=system.base,
    )
    result = completed(system)
    assert np.abs(result["wheel.F"] - force_of(result)).max() > 1e-3


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_only_slaves_with_feed_through_are_asked_again(estimator: str) -> None:
    """One more request for the wheel after each of the three small steps, none for the chassis."""
    result = completed(force_car(estimator=estimator, order=1))
    attempts = len(result.steps)
    pieces = 3 * attempts
    assert result.summary["requests"] == {"chassis": pieces, "wheel": 2 * pieces}
    assert result.summary["do_steps"] == {"chassis": pieces, "wheel": pieces}
    assert result.summary["round_trips"] == 2 * pieces


def test_without_feed_through_nothing_is_evaluated() -> None:
    """Displacements depend on no input directly: the same bits, and no request more."""
    options = {"order": 1, "stop_time": 0.2}
    plain, asked = (
        run_slaves(car(evaluate_outputs=evaluate, **options)).result for evaluate in (False, True)
    )
    assert plain.outputs.tobytes() == asked.outputs.tobytes()
    assert plain.summary["requests"] == asked.summary["requests"]


# ---- What goes wrong ----------------------------------------------------------------------------


class WatchedChassis(LinearSlave):
    """Notes the states in which each do_step started."""

    def __init__(self, *arguments: Any) -> None:
        self.begun: dict[float, set[bytes]] = defaultdict(set)
        super().__init__(*arguments)

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.begun[communication_point].add(self.x.tobytes())
        return super().do_step(communication_point, step_size, prior)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_rejection_leaves_no_trace(estimator: str) -> None:
    """Evaluating outputs sets inputs, but every attempt starts in the accepted state."""
    slaves = exact_slaves(WatchedChassis)
    result = completed(force_car(estimator=estimator, order=2, initial_step_size=0.02), slaves)
    repeated = result.steps[~result.steps["accepted"]]["time"]
    assert len(repeated) > 2
    at = dict(
        zip(
            result.time.tolist(),
            np.column_stack([result["chassis.x"], result["chassis.v"]]),
            strict=True,
        )
    )
    chassis = slaves["chassis"]
    assert isinstance(chassis, WatchedChassis)
    for time in repeated:
        assert chassis.begun[time] == {at[time].tobytes()}


class Moody(LinearSlave):
    """Cannot tell its outputs between two times, unless a step ended there."""

    span = (0.0, 0.0)
    time = 0.0
    reads = 0

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.time = communication_point + step_size
        self.reads = 0
        return super().do_step(communication_point, step_size, prior)

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        self.reads += 1
        if self.reads > 1 and self.span[0] < self.time < self.span[1]:
            raise StepRejectedError("no value")
        return super().get_outputs(order)


def test_an_output_that_cannot_be_evaluated_is_a_rejection() -> None:
    """It is repeated with a smaller step once, and ends the run with its own error after that."""
    wheel = Moody(WHEEL_FORCE, np.zeros(2), FOLLOWS)
    wheel.span = (0.1, 1.0)
    slaves = {**exact_slaves(), "wheel": wheel}
    run = run_slaves(force_car(order=1), slaves)
    assert isinstance(run.error, StepRejectedError)
    assert run.error.slave == "wheel"
    assert "no value" in str(run.error)
    assert run.result.summary["rejected_double_steps"] >= 1
    assert 0.05 < run.result.time[-1] <= 0.1


class NoNumber(LinearSlave):
    """A chassis whose velocity is no number from t = 0.03 s on."""

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


class HearingWheel(LinearSlave):
    """Keeps all inputs that it is given."""

    def __init__(self) -> None:
        self.heard: list[np.ndarray] = []
        super().__init__(WHEEL_FORCE, np.zeros(2), FOLLOWS)

    def set_inputs(self, derivatives: np.ndarray) -> None:
        """See `Slave`."""
        self.heard.append(derivatives.copy())
        super().set_inputs(derivatives)


@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
def test_what_is_no_number_reaches_no_other_slave(estimator: str) -> None:
    """Law: outputs are looked at before they are handed on: NaN stays with whom it comes from."""
    wheel = HearingWheel()
    slaves: dict[str, Slave] = {
        "chassis": NoNumber(CHASSIS_FORCE, np.zeros(2), FOLLOWS),
        "wheel": wheel,
    }
    options = {"estimator": estimator, "smallest_step_size": 1e-6, "stop_time": 0.1}
    run = run_slaves(force_car(**options), slaves)
    assert run.error is not None
    assert "chassis.v is not finite" in str(run.error)
    assert np.isfinite(run.result.outputs).all()
    assert all(np.isfinite(u).all() for u in wheel.heard)
