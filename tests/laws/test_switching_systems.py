"""Systems that switch: each jump is met where it is, and smooth signals are left alone."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from master_node import Result, System
from master_node.observing.observers import Statistics
from master_node.observing.run_warnings import warnings_of
from master_node.preparing.configuring import configure
from master_node.preparing.preparation import prepare
from master_node.slaves.group import SlaveGroup
from master_node.slaves.link import LocalSlave, SlaveLink
from protocol.slave import Slave
from slave_node.execution.executor import Executor
from tests.support.jump_models import Cosine, LimitedController, Product, PulseTrains, Threshold
from tests.support.quarter_car_case import run_slaves


def run(slaves: dict[str, Slave], connections: dict[str, str], **simulation: Any) -> Result:
    """A run to its end; connections lead from the value to the key."""
    system = System(
        simulation=simulation,
        slaves={name: {"model": "slave"} for name in slaves},
        connections=[(source, target) for target, source in connections.items()],
    )
    done = run_slaves(system, slaves)
    if done.error is not None:
        raise done.error
    return done.result


def both(tolerance: float) -> dict[str, float]:
    """Tolerances."""
    return {"relative_tolerance": tolerance, "absolute_tolerance": tolerance}


# ---- Several inputs that jump -------------------------------------------------------------------


def switched_integrator(scale: float, derivatives: bool, **simulation: Any) -> Result:
    """Two signals and a threshold switch the rate of an integrator, at times scaled by a factor.

    In units of the factor the rate is 1 from 2 to 3, 2 until x = 1.5 at 3.25, and 0.5 up to 8.
    """
    slaves: dict[str, Slave] = {
        "signals": PulseTrains(
            [
                [(1.0 * scale, 1.0), (8.0 * scale, 0.0)],
                [(2.0 * scale, 1.0), (3.0 * scale, 2.0)],
            ],
            derivatives=derivatives,
        ),
        "integrator": Product(3, derivatives=derivatives),
        "threshold": Threshold(1.5 * scale, low=0.25, high=1.0),
    }
    connections = {
        "integrator.u_0": "signals.s_0",
        "integrator.u_1": "signals.s_1",
        "integrator.u_2": "threshold.y",
        "threshold.u": "integrator.x",
    }
    return run(slaves, connections, stop_time=10.0 * scale, **simulation)


@pytest.mark.parametrize("estimator", ["mod", "rich"])
@pytest.mark.parametrize("derivatives", [False, True])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_signals_that_jump_one_after_the_other_are_all_met(
    estimator: str, derivatives: bool, tolerance: float
) -> None:
    """The integrator ends at 3.875 within ten tolerances: no jump hides behind another one's."""
    result = switched_integrator(1.0, derivatives, estimator=estimator, **both(tolerance))
    assert result["integrator.x"][-1] == pytest.approx(3.875, abs=10.0 * tolerance)
    assert result["signals.s_0"][-1] == 0.0


@settings(max_examples=5, deadline=None)
@given(st.floats(0.3, 3.0), st.booleans())
@example(1.75, True)  # at the smallest H the jump is in the comparison solution alone
def test_where_signals_jump_does_not_matter(scale: float, derivatives: bool) -> None:
    """Law: the result is in proportion to the time scale, wherever communication points fall."""
    result = switched_integrator(scale, derivatives, **both(1e-4))
    assert result["integrator.x"][-1] == pytest.approx(3.875 * scale, abs=1e-3 * (1.0 + scale))


def switched_at_ticks(period: float, stop: float) -> tuple[System, dict[str, Slave]]:
    """An integrator of a signal that is 1 in every second period and else 0."""
    times = np.arange(1, round(stop / period) + 1) * period
    train = [(float(time), float((i + 1) % 2)) for i, time in enumerate(times)]
    system = System(
        simulation={"stop_time": stop},
        slaves={"signals": {"model": "slave"}, "integrator": {"model": "slave"}},
        connections=[("signals.s_0", "integrator.u_0")],
    )
    return system, {"signals": PulseTrains([train]), "integrator": Product(1)}


@pytest.mark.parametrize(("period", "stop"), [(1.0, 5.0), (0.3, 5.1)])
def test_a_switch_at_equal_distances_is_put_on_no_grid(period: float, stop: float) -> None:
    """With the defaults and trial steps: each jump is met where it is, as without these."""
    system, slaves = switched_at_ticks(period, stop)
    links: dict[str, SlaveLink] = {n: LocalSlave(Executor(s)) for n, s in slaves.items()}
    loaded = {name: slave.description for name, slave in slaves.items()}
    descriptions = configure(links, system, loaded)
    prepared = prepare(SlaveGroup(links), system, descriptions, {})
    assert prepared.examinations["signals"].internal_clock is None
    assert not prepared.warnings
    done = run_slaves(prepared.system, slaves)
    assert done.error is None
    on = period * (round(stop / period) // 2)
    assert done.result["integrator.x"][-1] == pytest.approx(on, abs=1e-3)


# ---- Inputs that are not answered ---------------------------------------------------------------


def time_below_zero(**simulation: Any) -> Result:
    """A threshold that a cosine passes at pi/2 and 3 pi/2 switches an integrator on and off."""
    slaves: dict[str, Slave] = {
        "cosine": Cosine(),
        "threshold": Threshold(0.0, low=0.0, high=1.0),
        "integrator": Product(1),
    }
    connections = {"threshold.u": "cosine.y", "integrator.u_0": "threshold.y"}
    return run(slaves, connections, stop_time=6.0, **simulation)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4, 1e-6])
@pytest.mark.parametrize("estimator", ["mod", "rich"])
def test_where_err_says_nothing_defects_choose_order_and_step_size(
    estimator: str, tolerance: float
) -> None:
    """A threshold that does not react is met in time, within ten tolerances, with few steps."""
    result = time_below_zero(estimator=estimator, **both(tolerance))
    assert result["integrator.x"][-1] == pytest.approx(pi, abs=10.0 * tolerance)
    assert result.summary["late_jumps"] == 0
    assert result.steps["order"].max() >= 2
    assert result.summary["communication_steps"] < 2000


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_a_threshold_that_is_met_late_is_told(tolerance: float) -> None:
    """With constants nothing bounds H: a result beyond its tolerance has its warning."""
    result = time_below_zero(order=0, **both(tolerance))
    off = abs(result["integrator.x"][-1] - pi)
    assert off > 5.0 * tolerance  # as H is not bounded by anything
    assert result.summary["late_jumps"] > 0
    assert any("were met late" in warning for warning in result.summary["warnings"])
    assert any("jumps late" in name for name in result.steps["limiting_variable"])


# ---- Smooth systems that look like jumps --------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_false_alarms_are_not_raised_without_end(tolerance: float) -> None:
    """A stiff controller at and off its limit costs hardly more steps than without any search."""

    def controlled(**simulation: Any) -> Result:
        slaves: dict[str, Slave] = {
            "reference": Cosine(),
            "controller": LimitedController(100.0, 0.1, 12.0),
            "plant": Product(1, 1.0 / 3.0),
        }
        connections = {
            "controller.r": "reference.y",
            "controller.w": "plant.x",
            "plant.u_0": "controller.y",
        }
        return run(slaves, connections, stop_time=2.0, **both(tolerance), **simulation)

    with_search, without = controlled(), controlled(discontinuities=False)
    attempts = [
        result.summary["communication_steps"] // 2 + result.summary["rejected_double_steps"]
        for result in (with_search, without)
    ]
    assert attempts[0] <= 1.5 * attempts[1] + 50
    difference = abs(with_search["plant.x"][-1] - without["plant.x"][-1])
    assert difference <= 100.0 * tolerance


# ---- What is told -------------------------------------------------------------------------------


def test_warnings_follow_from_counters_and_name_a_remedy() -> None:
    """Nothing to say of a run without jumps; of each counter one sentence, with what to do."""
    assert warnings_of(Statistics(communication_steps=1000)) == []
    remedies = {
        "double_steps_at_discontinuities": (300, "events"),
        "double_steps_at_false_alarms": (60, "largest_step_size"),
        "late_jumps": (1, 'order = "auto"'),
        "changes_at_smallest_step_size": (1, "smallest_step_size"),
    }
    for counter, (count, remedy) in remedies.items():
        (warning,) = warnings_of(Statistics(communication_steps=1000, **{counter: count}))
        assert warning.startswith(str(count))
        assert remedy in warning
    assert warnings_of(Statistics(communication_steps=1000, double_steps_at_false_alarms=40)) == []


# ---- Results beside jumps -----------------------------------------------------------------------


@pytest.mark.parametrize("derivatives", [False, True])
@pytest.mark.parametrize("search", [False, True])
def test_a_switch_is_never_read_between_its_values(derivatives: bool, search: bool) -> None:
    """A signal that is 0 or 1 is 0 or 1 in all rows, found or stepped over, and rises once."""
    slaves: dict[str, Slave] = {
        "signals": PulseTrains([[(1.2345, 1.0)]], derivatives=derivatives),
        "integrator": Product(1, derivatives=derivatives),
    }
    result = run(
        slaves,
        {"integrator.u_0": "signals.s_0"},
        stop_time=3.0,
        output_interval=1e-3,
        discontinuities=search,
        largest_step_size=0.1,
        **both(1e-4),
    )
    signal = result["signals.s_0"]
    assert set(signal.tolist()) == {0.0, 1.0}
    assert (np.diff(signal) >= 0.0).all()
