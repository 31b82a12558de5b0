"""Systems at rest: what begins and ends again after a long quiet time is not stepped over."""

from __future__ import annotations

from typing import Any

import pytest

from master_node import Result, System
from protocol.slave import Slave
from tests.support.jump_models import Product, PulseTrains
from tests.support.quarter_car_case import run_slaves

STOP = 10.0
LASTS = 0.5
"""Duration of the pulse [s], more than a 32nd of the simulated time."""


def pulse_at(begin: float, **simulation: Any) -> Result:
    """An integrator at rest, which a pulse of 10 from ``begin`` [s] on moves to 5."""
    slaves: dict[str, Slave] = {
        "force": PulseTrains([[(begin, 10.0), (begin + LASTS, 0.0)]]),
        "body": Product(1),
    }
    system = System(
        simulation={"stop_time": STOP, **simulation},
        slaves={name: {"model": "slave"} for name in slaves},
        connections=[("force.s_0", "body.u_0")],
    )
    done = run_slaves(system, slaves)
    if done.error is not None:
        raise done.error
    return done.result


@pytest.mark.parametrize("begin", [2.7, 5.0, 7.21])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-6])
def test_a_pulse_in_a_quiet_run_is_found(begin: float, tolerance: float) -> None:
    """Both its edges are met at every tolerance, wherever it lies."""
    result = pulse_at(begin, relative_tolerance=tolerance, absolute_tolerance=tolerance)
    assert abs(result["body.x"][-1] - 10.0 * LASTS) <= 10.0 * tolerance
    assert result.summary["discontinuities"] == 2
    assert result.summary["double_steps_at_rest"] > 0


def test_nothing_but_rest_costs_sixteen_double_steps() -> None:
    """The bound costs a run in which nothing happens a fixed and small number of steps."""
    summary = pulse_at(2.0 * STOP).summary
    assert summary["largest_step_size"] == STOP / 32.0
    assert 16 <= summary["communication_steps"] / 2 <= 32


@pytest.mark.parametrize(
    "settings", [{"preset": "paper"}, {"largest_step_size": STOP / 2.0}], ids=["paper", "given"]
)
def test_the_bound_gives_way(settings: dict[str, Any]) -> None:
    """The paper's method has no bound, and a given one takes its place."""
    summary = pulse_at(2.0 * STOP, **settings).summary
    assert summary["largest_step_size"] > STOP / 32.0
    assert summary["double_steps_at_rest"] == 0


def test_a_larger_first_step_size_widens_the_bound() -> None:
    """Steps as large as the first one are asked for."""
    summary = pulse_at(2.0 * STOP, initial_step_size=1.0).summary
    assert summary["largest_step_size"] == 1.0
