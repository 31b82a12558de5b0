"""Law: with fixed H and an exact start-up history the error falls as H^(k+1), whatever is used.

The road under the car rises smoothly from t = 0 on and the car rested before, so a history at rest
is exact. The slaves are propagated exactly, and the whole car on that road is one linear system.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from master_node.numerics.extrapolation import POLYNOMIALS, InputPolynomial
from protocol.description import Capabilities, InputDerivatives
from protocol.slave import Slave
from slave_node.substeps.slave import SubstepSlave, with_substeps
from tests.support.quarter_car_case import (
    ALL,
    CHASSIS,
    K_W,
    M_W,
    STATES,
    WHEEL,
    LinearSystem,
    Z,
    car,
    run_slaves,
)
from tests.support.slow import quick_at

POWER, RAMP = 5, 0.5
"""The road is Z (t / RAMP)^POWER: its first four derivatives begin with 0."""

_ROAD = np.eye(POWER + 1, k=1)
_FORCE = np.zeros((2, POWER + 1))
_FORCE[1, 0] = K_W / M_W

RAMP_WHEEL = LinearSystem(
    a=np.block([[WHEEL.a, _FORCE], [np.zeros((POWER + 1, 2)), _ROAD]]),
    b=np.vstack([WHEEL.b, np.zeros((POWER + 1, 2))]),
    c=np.zeros(3 + POWER),
    inputs=WHEEL.inputs,
    outputs=WHEEL.outputs,
    of_states=np.eye(2, 3 + POWER),
    of_inputs=np.zeros((2, 2)),
)
"""The wheel, with the road's height and its derivatives as further states."""

AT_REST = np.append(np.zeros(2 + POWER), Z * math.factorial(POWER) / RAMP**POWER)
SLOPES = replace(ALL, max_output_derivative_order=1)


@cache
def exact_end() -> np.ndarray:
    """`STATES` at the end of the ramp."""
    whole = LinearSystem(
        a=np.block(
            [
                [CHASSIS.a, CHASSIS.b, np.zeros((2, POWER + 1))],
                [RAMP_WHEEL.b, RAMP_WHEEL.a],
            ]
        ),
        b=np.zeros((5 + POWER, 0)),
        c=np.zeros(5 + POWER),
        inputs=(),
        outputs=(),
    )
    return whole.propagate(np.append(np.zeros(2), AT_REST), np.zeros((1, 0)), RAMP)[:4]


def observed_order(
    polynomial: InputPolynomial,
    chassis: Capabilities = SLOPES,
    wheel: Capabilities = SLOPES,
    wrapped: Callable[[Slave], Slave] = lambda slave: slave,
    **simulation: Any,
) -> float:
    """The order with which the error at the end of the ramp falls from one H to its half."""
    errors = []
    for step_size in (RAMP / 200, RAMP / 400):
        slaves: dict[str, Slave] = {
            "chassis": wrapped(CHASSIS.slave(capabilities=chassis)),
            "wheel": wrapped(RAMP_WHEEL.slave(AT_REST, capabilities=wheel)),
        }
        system = car(
            estimator="none",
            order=polynomial.order,
            derivative_points=polynomial.derivative_points,
            stop_time=RAMP,
            initial_step_size=step_size,
            **simulation,
        )
        run = run_slaves(system, slaves)
        assert run.error is None
        states = [run.result[name][-1] for name in STATES]
        errors.append(np.linalg.norm(states - exact_end()))
    return float(np.log2(errors[0] / errors[1]))


@pytest.mark.parametrize("sequence", ["jacobi", "gauss-seidel"])
@pytest.mark.parametrize("polynomial", POLYNOMIALS, ids=str)
def test_the_global_order_is_k_plus_1(polynomial: InputPolynomial, sequence: str) -> None:
    """For every polynomial, with extrapolated inputs and with inputs that are known ahead."""
    observed = observed_order(polynomial, sequence=sequence)
    assert observed == pytest.approx(polynomial.order + 1, abs=0.25)


@pytest.mark.parametrize("without", ["chassis", "wheel"])
@pytest.mark.parametrize("polynomial", [p for p in POLYNOMIALS if p.derivative_points], ids=str)
def test_a_slave_without_output_derivatives_costs_no_order(
    polynomial: InputPolynomial, without: str
) -> None:
    """The inputs that it feeds go through more points instead: the degree stays k."""
    can: dict[str, Any] = {without: ALL}
    observed = observed_order(polynomial, **can)
    assert observed > polynomial.order + 0.75


@pytest.mark.parametrize("sequence", quick_at(["jacobi"], ["jacobi", "gauss-seidel"]))
@pytest.mark.parametrize("polynomial", POLYNOMIALS, ids=str)
def test_emulated_inputs_cost_no_order(polynomial: InputPolynomial, sequence: str) -> None:
    """Slaves that take values only, in k + 1 substeps or more; with and without a look at the
    derivatives of their outputs, which belong to the end of the step.
    """
    held = replace(SLOPES, can_interpolate_inputs=False)
    observed = observed_order(polynomial, held, held, with_substeps, sequence=sequence)
    assert observed > polynomial.order + 0.75


def test_mean_values_alone_are_of_second_order() -> None:
    """Mean values alone, without further moments, are of order 2 for any k."""

    def mean(slave: Slave) -> Slave:
        return SubstepSlave(slave, InputDerivatives.EMULATED, 1)

    held = replace(ALL, can_interpolate_inputs=False)
    observed = observed_order(InputPolynomial(3), held, held, mean)
    assert observed == pytest.approx(2.0, abs=0.25)
