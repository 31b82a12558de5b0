"""Laws of the error of one double step, with the program's own parts and slaves without errors.

A double step is taken from the exact solution with an exact history of values and derivatives, so
that what it is off by at its end is its local error, and known.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from master_node.numerics.error_estimators import EST_MOD
from master_node.numerics.extrapolation import POLYNOMIALS, InputPolynomial
from protocol.signals import InputSignal
from tests.support.quarter_car_case import (
    CHASSIS,
    CHASSIS_FORCE,
    FORCE,
    SIZES,
    WHEEL_FORCE,
    WHOLE_CAR,
    LinearSlave,
    exact_outputs,
    exact_solution,
    limit_of_deviations,
    local_error,
)

ESTIMATORS = ("rich", "mod")
VALUES_ONLY = [p for p in POLYNOMIALS if not p.derivative_points]
FORCE_PARTS = {"chassis": CHASSIS_FORCE, "wheel": WHEEL_FORCE}


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("polynomial", POLYNOMIALS, ids=str)
@pytest.mark.parametrize("factor", [1.0, 0.3, 2.0])
def test_the_estimate_tends_to_the_true_error(
    estimator: str, polynomial: InputPolynomial, factor: float
) -> None:
    """Law: EST / true local error -> 1 as H -> 0, also after H was changed by ``factor``.

    With and without derivatives: the constants are those of the nodes that there are.
    """
    near, limit = limit_of_deviations(polynomial, factor, estimator=estimator)
    assert limit == pytest.approx(0.0, abs=0.04)
    assert near < 0.12


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize(
    ("constants", "sequence"),
    [("exact", "jacobi"), ("exact", "gauss-seidel"), ("paper", "jacobi")],
)
@pytest.mark.parametrize("coupling", ["displacement", "force"])
def test_err_is_the_norm_of_the_estimate(
    estimator: str, constants: str, sequence: str, coupling: str
) -> None:
    """Law: ERR is equation (8) of EST, and names the output that has most of it.

    Where all outputs have one constant p, and where each has its own.
    """
    system: dict[str, Any] = (
        {"parts": FORCE_PARTS, "connections": FORCE} if coupling == "force" else {}
    )
    found = local_error(
        InputPolynomial(1),
        1e-3,
        estimator=estimator,
        constants=constants,
        sequence=sequence,
        absolute_tolerance=1e-5,
        relative_tolerance=1e-3,
        **system,
    )
    parts = found.estimate / (1e-5 + 1e-3 * np.abs(found.step.end[0]))
    assert found.judged.norm == pytest.approx(np.sqrt(np.mean(parts**2)), rel=1e-12)
    assert found.judged.limiting_variable == found.names[int(np.abs(parts).argmax())]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("polynomial", VALUES_ONLY, ids=str)
def test_the_constants_of_the_paper_are_those_of_steps_of_one_size(
    estimator: str, polynomial: InputPolynomial
) -> None:
    """They are right on an equidistant history only: EST_Rich misses by a fifth and more on others.

    But for constant inputs, of which the last point alone tells.
    """
    options = {"estimator": estimator, "constants": "paper"}
    for factor in (1.0, 0.3, 2.0):
        _, limit = limit_of_deviations(polynomial, factor, **options)
        if factor == 1.0 or polynomial.order == 0:
            assert limit == pytest.approx(0.0, abs=0.02)
        else:
            assert limit > (0.04 if estimator == "mod" else 0.2)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("polynomial", POLYNOMIALS, ids=str)
def test_the_local_error_has_order_k_plus_2(estimator: str, polynomial: InputPolynomial) -> None:
    """Without feed-through the error of a double step, and so EST, is O(H^(k+2)): P = k + 2."""
    steps = [local_error(polynomial, h, estimator=estimator) for h in SIZES[polynomial.order]]
    for norms in (
        [np.linalg.norm(s.error) for s in steps],
        [np.linalg.norm(s.estimate) for s in steps],
    ):
        observed = np.log2(norms[0] / norms[1])
        assert observed == pytest.approx(polynomial.order + 2, abs=0.1)


def forces(
    polynomial: InputPolynomial, factor: float, step_size: float, **options: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Estimates and true errors of the wheel's force, a quarter of its vibration apart.

    At a single time the leading term may happen to be small.
    """
    found = []
    for time in (0.13, 0.155):
        step = local_error(
            polynomial,
            step_size,
            last_step_size=step_size / factor,
            parts=FORCE_PARTS,
            connections=FORCE,
            time=time,
            **options,
        )
        force = step.names.index("wheel.F")
        found.append((step.estimate[force], step.error[force]))
    estimates, errors = np.array(found).T
    return estimates, errors


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("polynomial", VALUES_ONLY, ids=str)
@pytest.mark.parametrize("factor", [1.0, 0.3, 2.0])
def test_the_estimate_of_an_output_with_feed_through(
    estimator: str, polynomial: InputPolynomial, factor: float
) -> None:
    """Law: the same holds for the wheel's force, which contains the extrapolated inputs.

    Its error is one order larger than that of a state, and so is ERR: P = k + 1.
    """
    deviations, norms = [], []
    for step_size in SIZES[polynomial.order]:
        estimates, errors = forces(polynomial, factor, step_size, estimator=estimator)
        norms.append(np.linalg.norm(errors))
        deviations.append(np.linalg.norm(estimates - errors) / norms[-1])
    assert deviations[1] < 0.25
    assert 2.0 * deviations[1] - deviations[0] == pytest.approx(0.0, abs=0.04)
    assert np.log2(norms[0] / norms[1]) == pytest.approx(polynomial.order + 1, abs=0.1)


@pytest.mark.parametrize("polynomial", VALUES_ONLY[1:], ids=str)
def test_the_constants_of_the_paper_do_not_know_feed_through(polynomial: InputPolynomial) -> None:
    """EST_mod of such an output is wrong, on an equidistant history too: p is not p_k but k + 2."""
    step_size = SIZES[polynomial.order][1]
    exact, _ = forces(polynomial, 1.0, step_size, estimator="mod")
    paper, _ = forces(polynomial, 1.0, step_size, estimator="mod", constants="paper")
    k = polynomial.order
    assert paper == pytest.approx(exact * (k + 1) / (EST_MOD.paper_ratios[k] - 1.0), rel=1e-6)


# ---- What these tests stand on ------------------------------------------------------------------


def test_the_propagation_is_exact() -> None:
    """With the exact inputs' Taylor series a slave has no error."""
    t, h = 0.3, 1e-3
    x = exact_solution(t)[0]
    jacobian = WHOLE_CAR.a @ x + WHOLE_CAR.c
    u = np.array([x[2:], jacobian[2:], (WHOLE_CAR.a @ jacobian)[2:]])
    reached = CHASSIS.propagate(x[:2], u, h)
    assert reached == pytest.approx(exact_solution(t + h)[0][:2], rel=0.0, abs=1e-8)
    half = CHASSIS.propagate(x[:2], u, h / 2)
    rest = InputSignal(u).shifted(h / 2).derivatives
    assert CHASSIS.propagate(half, rest, h / 2) == pytest.approx(reached, rel=1e-13)
    assert isinstance(CHASSIS.slave(x[:2]), LinearSlave)


def test_the_exact_outputs_and_their_derivatives_belong_together() -> None:
    """By the difference of neighbouring values, for all states and the force."""
    names = ["chassis.x", "chassis.v", "wheel.x", "wheel.v", "wheel.F"]
    t, h = 0.13, 1e-5
    before, now, after = (exact_outputs(names, time) for time in (t - h, t, t + h))
    slopes = (after[0] - before[0]) / (2 * h)
    assert now[1] == pytest.approx(slopes, rel=1e-5)


def test_a_slave_reads_what_it_propagates() -> None:
    """Outputs, and output derivatives with inputs that move, are those of the equations."""
    x, u, h = np.array([0.03, -0.2]), np.array([[0.05, 0.4], [3.0, -2.0], [7.0, 50.0]]), 1e-6
    for part in (CHASSIS, WHEEL_FORCE):
        y, slopes = part.read(x, u, 1)
        later = InputSignal(u).shifted(h).derivatives
        (following,) = part.read(part.propagate(x, u, h), later, 0)
        assert (following - y) / h == pytest.approx(slopes, rel=1e-2, abs=1e-2)
