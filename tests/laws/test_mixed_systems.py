"""Slaves that can more and slaves that can less in one system: each is used as far as it goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from master_node import Result, System
from protocol.description import Capabilities
from protocol.slave import Slave
from tests.support.quarter_car_case import (
    ALL,
    CHASSIS,
    WHEEL,
    LinearSlave,
    LinearSystem,
    car,
    global_errors,
    run_slaves,
)
from tests.support.slow import quick_at

SLOPES = replace(ALL, max_output_derivative_order=1)
CONSTANT = replace(ALL, can_interpolate_inputs=False)
KINDS = {"slopes": SLOPES, "values": ALL, "constant": CONSTANT}
SEQUENCES = ("jacobi", "gauss-seidel")
ESTIMATORS = ("rich", "mod")


class Listener(LinearSlave):
    """Keeps all inputs that it is given."""

    def __init__(self, system: LinearSystem, capabilities: Capabilities) -> None:
        self.heard: list[np.ndarray] = []
        super().__init__(system, np.zeros(2), capabilities)

    def set_inputs(self, derivatives: np.ndarray) -> None:
        """See `Slave`."""
        self.heard.append(derivatives.copy())
        super().set_inputs(derivatives)

    def highest_degree(self) -> int:
        """Highest degree of the polynomials that it was given, leading zeros left out."""
        return max(int(np.flatnonzero(rows.any(axis=1)).max(initial=0)) for rows in self.heard)


def slaves_of(chassis: Capabilities, wheel: Capabilities) -> dict[str, Listener]:
    """The exact car with other capabilities."""
    return {"chassis": Listener(CHASSIS, chassis), "wheel": Listener(WHEEL, wheel)}


def completed(system: System, slaves: dict[str, Any]) -> Result:
    """The result of a run that came to its end."""
    run = run_slaves(system, slaves)
    if run.error is not None:
        raise run.error
    return run.result


@pytest.mark.parametrize(("chassis", "wheel"), list(product(KINDS, repeat=2)))
@pytest.mark.parametrize("estimator", quick_at(["mod"], ESTIMATORS))
@pytest.mark.parametrize("sequence", SEQUENCES)
def test_any_mixture_comes_to_its_end_with_its_error_under_control(
    chassis: str, wheel: str, estimator: str, sequence: str
) -> None:
    """Law: with ``order = "auto"``, whatever the slaves can: the error is that of the tolerance."""
    options = {"estimator": estimator, "sequence": sequence, "order": "auto", "stop_time": 0.3}
    tolerance = {"relative_tolerance": 1e-3, "absolute_tolerance": 1e-3}
    system = car(**options, **tolerance)
    result = completed(system, slaves_of(KINDS[chassis], KINDS[wheel]))
    assert global_errors(result).mean() < 1e-2
    assert result.summary["discontinuities"] == 0


@pytest.mark.parametrize("without", ["chassis", "wheel"])
@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize(("k", "points"), [(1, 1), (2, 1), (3, 1), (3, 2)])
def test_inputs_without_derivatives_get_the_same_degree_through_more_points(
    without: str, estimator: str, sequence: str, k: int, points: int
) -> None:
    """Law: a polynomial of degree k is one for all inputs, as soon as there are points enough.

    Those that are fed by a slave without output derivatives, and those that are known ahead, go
    through k + 1 points.
    """
    options = {
        "estimator": estimator,
        "sequence": sequence,
        "order": k,
        "derivative_points": points,
        "initial_history": "none",
        "stop_time": 0.05,
    }
    can = {"chassis": SLOPES, "wheel": SLOPES, without: ALL}
    slaves = slaves_of(can["chassis"], can["wheel"])
    completed(car(**options), slaves)
    assert [slave.highest_degree() for slave in slaves.values()] == [k, k]


def test_derivatives_are_used_where_there_are_any() -> None:
    """The more slaves have output derivatives, the fewer steps."""
    options = {"order": "auto", "stop_time": 2.0}
    steps = [
        completed(car(**options), slaves_of(chassis, wheel)).summary["communication_steps"]
        for chassis, wheel in ((SLOPES, SLOPES), (SLOPES, ALL), (ALL, SLOPES), (ALL, ALL))
    ]
    assert steps[0] < min(steps[1:3])
    assert max(steps[1:3]) < steps[3]


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_derivatives_that_no_input_uses_change_nothing(estimator: str) -> None:
    """Law: the wheel's inputs are known ahead, so those of the chassis are of no use: same bits."""
    options = {"order": "auto", "sequence": "gauss-seidel", "stop_time": 1.0}
    results = [
        completed(car(estimator=estimator, **options), slaves_of(chassis, ALL))
        for chassis in (SLOPES, ALL)
    ]
    assert results[0].steps.tolist() == results[1].steps.tolist()
    assert results[0].outputs.tobytes() == results[1].outputs.tobytes()


@pytest.mark.parametrize("order", ["auto", 2])
@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
def test_a_slave_that_takes_constants_gets_nothing_else(estimator: str, order: Any) -> None:
    """Without canInterpolateInputs one row of inputs; the other slave gets its polynomials.

    The user is told which slave holds the order down.
    """
    slaves = slaves_of(SLOPES, CONSTANT)
    run = run_slaves(car(estimator=estimator, order=order, stop_time=0.1), slaves)
    assert run.error is None
    assert slaves["wheel"].highest_degree() == 0
    assert {len(rows) for rows in slaves["wheel"].heard} == {1}
    assert slaves["chassis"].highest_degree() >= 1
    (warning,) = run.warnings
    assert warning.startswith("wheel cannot interpolate inputs (canInterpolateInputs)")
    assert warning.endswith(f"order 0 instead of {order}")


# ---- Slaves that take or give nothing -----------------------------------------------------------


def source(slope: float) -> LinearSlave:
    """An output that rises; no inputs."""
    system = LinearSystem(
        a=np.zeros((1, 1)), b=np.zeros((1, 0)), c=np.array([slope]), inputs=(), outputs=("y",)
    )
    return system.slave((0.0,), capabilities=SLOPES)


def follower(inputs: Sequence[str] = ("u",)) -> LinearSlave:
    """A filter, x' = u - x."""
    system = LinearSystem(
        a=-np.eye(1),
        b=np.ones((1, len(inputs))),
        c=np.zeros(1),
        inputs=tuple(inputs),
        outputs=("x",),
    )
    return system.slave((0.0,), capabilities=SLOPES)


@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_slave_without_inputs_has_no_error(
    estimator: str, sequence: str, backwards: bool
) -> None:
    """A ramp that feeds a filter: exact up to the start, in any order of the slaves.

    x = t - 1 + e^-t.
    """
    slaves: dict[str, Slave] = {"source": source(1.0), "filter": follower()}
    if backwards:
        slaves = dict(reversed(slaves.items()))
    system = System(
        simulation={"stop_time": 2.0, "estimator": estimator, "sequence": sequence},
        slaves={name: {} for name in slaves},
        connections=[("source.y", "filter.u")],
    )
    result = completed(system, slaves)
    t = result.time
    assert result["source.y"] == pytest.approx(t, rel=1e-12, abs=1e-12)
    assert result["filter.x"] == pytest.approx(t - 1.0 + np.exp(-t), rel=0.0, abs=1e-4)
    assert result.summary["discontinuities"] == 0


@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
def test_slaves_without_any_connection_run_beside_each_other(estimator: str, sequence: str) -> None:
    """Nothing is extrapolated, so there is no error, and H grows as far as it may."""
    system = System(
        simulation={"stop_time": 2.0, "estimator": estimator, "sequence": sequence},
        slaves={"a": {}, "b": {}},
    )
    result = completed(system, {"a": source(1.0), "b": source(-2.0)})
    assert result["a.y"] == pytest.approx(result.time, rel=1e-12, abs=1e-12)
    assert result["b.y"] == pytest.approx(-2.0 * result.time, rel=1e-12, abs=1e-12)
    if estimator != "none":
        assert result.steps["accepted"].all()
        assert len(result.time) < 40
