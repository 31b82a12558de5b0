"""Times to the last bit: a slave is never told to begin elsewhere than it stands, or to go beyond.

A slave adds what it is told, t + h in double precision. Slaves that refuse what misses that sum, or
exceeds a time that they know, take every step of every kind of run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from master_node import System, simulate
from protocol.calls import Initialize, StepResult
from protocol.description import Capabilities
from protocol.step_sums import step_to
from tests.master_node.resuming.test_resume import contents, interrupted
from tests.support.quarter_car_case import (
    ALL,
    CHASSIS,
    DISPLACEMENT,
    WHEEL,
    LinearSlave,
    Run,
    run_slaves,
)

TIMES = st.floats(-1e10, 1e10)


@given(TIMES, st.floats(1e-12, 1e10))
def test_a_step_meets_its_end_if_any_size_does(begin: float, length: float) -> None:
    """Law: the sum is never beyond the end, and just before it only where no size leads there."""
    end = begin + length  # which is a sum
    assume(end > begin)
    assert begin + step_to(begin, end) == end
    for following in (math.nextafter(end, math.inf), math.nextafter(end, -math.inf)):
        if following > begin:
            size = step_to(begin, following)
            assert begin + size <= following
            assert begin + size == following or begin + math.nextafter(size, math.inf) > following
            assert begin + size == following or not 0.0 < following <= 2.0 * begin


@given(TIMES, st.floats(1e-6, 1e6), st.floats(0.0, 2.0))
def test_a_step_is_not_larger_than_the_largest(begin: float, length: float, part: float) -> None:
    """Law: by the last bit; and what is wanted is taken where it leads to the end."""
    end, largest = begin + length, part * length
    assume(end > begin and begin + largest > begin)
    assert step_to(begin, end, largest=largest) <= largest
    assert step_to(begin, end, length) == length
    assert step_to(begin, end, length, largest) <= largest


# ---- Whole runs ---------------------------------------------------------------------------------


@dataclass
class Told:
    """Times that a slave knows [s]."""

    stop: float = math.inf
    largest: float = math.inf
    events: tuple[float, ...] = ()


class StrictSlave(LinearSlave):
    """Knows where it stands, also after it was set back."""

    def __init__(self, *arguments: Any, told: Told) -> None:
        self.time = 0.0
        self.told = told
        self.times: list[tuple[object, float]] = []
        super().__init__(*arguments)

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        assert experiment.stop_time is not None
        self.time, self.told.stop = experiment.start_time, experiment.stop_time
        super().initialize(experiment)

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        assert communication_point == self.time
        end = communication_point + step_size
        assert self.time < end <= self.told.stop
        assert step_size <= self.told.largest
        assert not any(self.time < event < end for event in self.told.events)
        self.time = end
        return super().do_step(communication_point, step_size, prior)

    def get_state(self) -> object:
        """See `Slave`."""
        state = super().get_state()
        self.times = [pair for pair in self.times if pair[0] is not state]
        self.times.append((state, self.time))
        return state

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        super().set_state(state)
        self.time = next(time for kept, time in self.times if kept is state)


NO_STATE = Capabilities(can_interpolate_inputs=True, can_handle_variable_step_size=True)
STARTS = st.sampled_from([0.0, 0.1, 1.1, -0.07, -3.3, 17.3, 1.7e9]) | st.floats(-9.0, 9.0)


@dataclass
class Case:
    """A run of the quarter car with strict slaves."""

    start: float
    length: float
    rules: Mapping[str, float] = field(default_factory=dict)
    simulation: Mapping[str, Any] = field(default_factory=dict)
    events: tuple[float, ...] = ()
    cans: tuple[Capabilities, Capabilities] = (ALL, ALL)

    def run(self) -> Run:
        """The run, completed. All tolerances are met: only the times matter."""
        told = [Told(largest=self.rules.get("largest_step_size", math.inf)) for _ in self.cans]
        stop = self.start + self.length
        chassis, wheel = (
            StrictSlave(system, np.zeros(2), can, told=one)
            for system, can, one in zip((CHASSIS, WHEEL), self.cans, told, strict=True)
        )
        system = System(
            simulation={
                "start_time": self.start,
                "stop_time": stop,
                "relative_tolerance": 1e6,
                "absolute_tolerance": 1e6,
                "discontinuities": False,
                "order": 1,
                "examine": False,
                "events": self.events,
                **self.simulation,
            },
            slaves={"chassis": dict(self.rules), "wheel": {}},
            connections=DISPLACEMENT,
        )
        if self.simulation.get("estimator") != "rich":  # whose long steps go over events
            for one in told:
                one.events = self.events
        run = run_slaves(system, {"chassis": chassis, "wheel": wheel})
        if run.error is not None:
            raise run.error
        for slave in (chassis, wheel):
            rounding = len(run.result.time) * math.ulp(max(abs(self.start), abs(stop)))
            assert stop - rounding <= slave.time <= stop
            if stop >= 0.5 * self.length + 1.1 * max(0.0, -self.start):
                assert slave.time == stop or "largest_step_size" in self.rules
        return run


@settings(max_examples=60, deadline=None)
@given(STARTS, st.floats(0.05, 0.4), st.floats(2e-3, 0.06))
def test_fixed_steps(start: float, length: float, step_size: float) -> None:
    """Points are start + n H; the last step ends on the stop time."""
    fixed = {"estimator": "none", "initial_step_size": step_size}
    run = Case(start, length, simulation=fixed).run()
    assert run.result.time[-1] == start + length
    n = np.arange(len(run.result.time) - 1)
    assert run.result.time[:-1] == pytest.approx(start + n * step_size, rel=1e-15, abs=1e-17)


@settings(max_examples=60, deadline=None)
@given(STARTS, st.integers(1, 80), st.sampled_from([0.01, 0.1 / 3.0, 1e-3, 0.05]))
def test_fixed_steps_that_a_slave_takes_at_most(
    start: float, halves: int, step_size: float
) -> None:
    """Where rounding makes n of the largest steps too short for the way, the last is halved."""
    assume(start < 1e9)
    fixed = {"estimator": "none", "initial_step_size": step_size}
    length = 0.5 * halves * step_size
    run = Case(start, length, {"largest_step_size": step_size}, fixed).run()
    assert run.result.time[-1] == start + length
    assert np.diff(run.result.time).min() > 0.4 * step_size


@settings(max_examples=60, deadline=None)
@given(
    tenths=st.integers(-40, 60) | st.integers(1700000000, 1700000010),
    number=st.integers(1, 60),
    rule=st.sampled_from(["step_size", "step_multiple"]),
    size=st.sampled_from([0.05, 0.01, 0.3, 0.007]),
    estimator=st.sampled_from(["none", "mod", "rich"]),
    is_largest=st.booleans(),
)
def test_steps_on_a_grid(
    *, tenths: int, number: int, rule: str, size: float, estimator: str, is_largest: bool
) -> None:
    """Multiples and single sizes: as many as there are in decimal numbers."""
    assume(not (rule == "step_size" and estimator == "rich"))
    start = tenths / 10
    rules = {rule: size}
    if is_largest:
        rules["largest_step_size"] = 2.0 * size if estimator == "rich" else size
    simulation: dict[str, Any] = {"estimator": estimator}
    if estimator == "none":
        simulation["initial_step_size"] = size
    length = float(f"{start + 2 * number * size:.12g}") - start
    assume(start + length == float(f"{start + 2 * number * size:.12g}"))
    run = Case(start, length, rules, simulation).run()
    sizes = run.result.steps["step_size"]
    assert sizes / size == pytest.approx(np.round(sizes / size), abs=1e-5)
    if rule == "step_size" or estimator == "none":
        assert len(run.result.time) == 2 * number + 1
    assert run.result.time[-1] == pytest.approx(start + length, rel=1e-13)


@settings(max_examples=80, deadline=None)
@given(
    start=STARTS,
    length=st.floats(0.05, 0.4),
    estimator=st.sampled_from(["mod", "rich"]),
    cans=st.sampled_from([(ALL, ALL), (ALL, NO_STATE), (NO_STATE, NO_STATE)]),
    rules=st.sampled_from([{}, {"largest_step_size": 0.01}, {"largest_step_size": 0.1 / 7}]),
    parts=st.lists(st.floats(0.2, 0.8), max_size=2),
)
def test_controlled_steps(
    *,
    start: float,
    length: float,
    estimator: str,
    cans: tuple[Capabilities, Capabilities],
    rules: Mapping[str, float],
    parts: list[float],
) -> None:
    """With rollback, without, and of both kinds; over events, which no step goes over."""
    events = tuple(start + part * length for part in sorted(parts))
    assume(all(abs(a - b) > 0.05 * length for a in events for b in events if a is not b))
    simulation = {"estimator": estimator, "smallest_step_size": 1e-5}
    if "largest_step_size" not in rules:
        simulation["largest_step_size"] = 0.02
    run = Case(start, length, rules, simulation, events, cans).run()
    assert run.result.time[-1] == start + length
    assert set(events) <= set(run.result.time.tolist())


# ---- FMUs ---------------------------------------------------------------------------------------

RULES: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {
    "fixed": ({"estimator": "none", "initial_step_size": 0.1}, {}),
    "step_size": ({}, {"step_size": 0.05}),
    "step_multiple": ({}, {"step_multiple": 0.05, "largest_step_size": 0.1}),
    "rich": ({"estimator": "rich"}, {"largest_step_size": 0.1}),
    "events": ({"events": (1.3, 1.5)}, {"largest_step_size": 0.1 / 3.0}),
}


def fmus(fmu_dir: Path, rule: str) -> System:
    """The quarter car from 1.1 s to 1.7 s, by the times that this rule gives."""
    simulation, rules = RULES[rule]
    tolerances = {"relative_tolerance": 0.1, "absolute_tolerance": 1e3, "discontinuities": False}
    return System(
        simulation={"start_time": 1.1, "stop_time": 1.7, **tolerances, **simulation},
        slaves={
            name: {"model": str(fmu_dir / f"{name}.fmu")} | rules for name in ("chassis", "wheel")
        },
        connections=DISPLACEMENT,
    )


@pytest.mark.parametrize("rule", RULES)
def test_strict_fmus(rule: str, fmu_dir: Path, tmp_path: Path) -> None:
    """None is told to go beyond 1.7 s, or over an event, and none after a resume: it ends up the
    same, byte for byte.
    """
    system = fmus(fmu_dir, rule)
    run = simulate(system, output=tmp_path / "whole", in_process=True)
    assert run.time[-1] == 1.7
    assert set(system.simulation.events) <= set(run.time.tolist())
    interrupted(system, tmp_path / "parts", 2)
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


@pytest.mark.usefixtures("no_process_left")
@pytest.mark.parametrize("rule", ["fixed", "step_multiple"])
def test_strict_fmus_in_processes(rule: str, fmu_dir: Path, tmp_path: Path) -> None:
    """The times are the same, bit for bit, in processes of their own."""
    system = fmus(fmu_dir, rule)
    simulate(system, output=tmp_path / "here", in_process=True)
    simulate(system, output=tmp_path / "there")
    assert contents(tmp_path / "there") == contents(tmp_path / "here")
