"""Discrete outputs that change in every step: changes that no H can tell apart are not searched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from master_node import Result
from master_node.judging.restless import IN_A_ROW, RestlessOutputs
from protocol.calls import Initialize
from protocol.variables import Causality, StartValue
from tests.support.quarter_car_case import (
    CHASSIS,
    WHEEL,
    LinearSlave,
    car,
    global_errors,
    run_slaves,
)


class DiscreteWheel(LinearSlave):
    """The wheel with outputs that are declared discrete, as some tools declare all of theirs."""

    def __init__(self) -> None:
        super().__init__(WHEEL, np.zeros(2))
        self.description = replace(
            self.description,
            variables=tuple(
                replace(v, variability="discrete") if v.causality is Causality.OUTPUT else v
                for v in self.description.variables
            ),
        )

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        assert experiment.discrete_outputs == self.system.outputs

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`; there is none."""
        return np.zeros((order + 1, 0))

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        """See `Slave`."""
        return tuple(self.x.tolist())


class HoldingChassis(LinearSlave):
    """The chassis with inputs that are fed by discrete outputs, and so held."""

    def __init__(self) -> None:
        super().__init__(CHASSIS, np.zeros(2))

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        assert experiment.discrete_inputs == self.system.inputs

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`."""
        self.u = np.array([values], dtype=float)


def test_outputs_are_restless_once_they_changed_in_both_small_steps_often_enough() -> None:
    """Law: a change in one small step counts nothing, and a double step without any ends it."""
    restless = RestlessOutputs()
    for number in range(1, IN_A_ROW + 1):
        assert not restless.outputs
        restless = restless.noted({1, 2}, {2, 3})
        assert dict(restless.counts) == {1: 0, 2: number, 3: 0}
    assert restless.outputs == {2}
    assert restless.noted({2}, set()).outputs == {2}
    assert not restless.noted({1}, {1}).outputs
    assert not restless.noted(set(), set()).counts


def held(tolerance: float, caplog: pytest.LogCaptureFixture) -> tuple[Result, float]:
    """The car with a discrete wheel, and its largest error."""
    system = car(
        stop_time=0.2, relative_tolerance=tolerance, absolute_tolerance=tolerance, order="auto"
    )
    slaves = {"chassis": HoldingChassis(), "wheel": DiscreteWheel()}
    run = run_slaves(system, slaves)
    assert run.error is None
    told = [r.getMessage() for r in caplog.records if "changes in every small step" in r.message]
    assert [text.split()[0] for text in told] == ["wheel.x", "wheel.v"]
    caplog.clear()
    return run.result, float(global_errors(run.result).max())


def test_a_run_gets_on_over_outputs_that_move_all_the_time(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Law: the run ends, says so, and its error follows the tolerance, as ERR tells what held
    values cost: it is of first order in H, and H of order one half in the tolerance.
    """
    (_, coarse), (result, fine) = (held(tolerance, caplog) for tolerance in (1e-3, 1e-4))
    assert 2.5 < coarse / fine < 4.0
    assert len(result.time) < 1000
    assert result.summary["changes_at_smallest_step_size"] == 0
