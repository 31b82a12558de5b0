"""One slave drives another: nothing comes back, so only what is handed on tells of an error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import Phase, assume, example, given, settings
from hypothesis import strategies as st

from master_node import Result, System
from protocol.calls import StepResult
from protocol.slave import (
    Causality,
    InputDerivatives,
    Slave,
    SlaveDescription,
    StartValue,
    StateKind,
    StepStatus,
    Variable,
)
from tests.quarter_car_case import ALL, LinearSystem, run_slaves

Jumps = Sequence[tuple[float, float]]
STOP = 3.0

OSCILLATOR = LinearSystem(
    a=np.array([[0.0, 1.0], [-30.0, -1.0]]),
    b=np.array([[0.0], [30.0]]),
    c=np.zeros(2),
    inputs=("u",),
    outputs=("x", "v"),
)


class JumpingSource(Slave):
    """y jumps by a at t_i, for each (t_i, a); from t_i on it has the new value."""

    def __init__(self, jumps: Jumps) -> None:
        self.jumps = jumps
        self.description = SlaveDescription(
            model="jumps",
            kind="test",
            variables=(Variable("y", Causality.OUTPUT),),
            capabilities=replace(ALL, max_output_derivative_order=1),
            state_kind=StateKind.NATIVE,
            input_derivatives=InputDerivatives.NATIVE,
        )
        self.reset()

    def reset(self) -> None:
        """See `Slave`."""
        self.time = 0.0

    def initialize(
        self,
        *,
        start_time: float,
        stop_time: float | None,
        relative_tolerance: float | None,
        start_values: Mapping[str, StartValue],
        inputs: Sequence[str],
        outputs: Sequence[str],
        discrete_inputs: Sequence[str] = (),
        discrete_outputs: Sequence[str] = (),
        early_return: bool = False,
    ) -> None:
        """See `Slave`."""
        self.time = start_time

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""

    def set_inputs(self, derivatives: np.ndarray) -> None:
        """See `Slave`."""

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`."""
        self.time = communication_point + step_size
        return StepResult(StepStatus.OK, self.time)

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        y = sum(jump for time, jump in self.jumps if self.time >= time)
        return np.array([[y], [0.0]][: order + 1])

    def get_state(self) -> object:
        """See `Slave`."""
        return self.time

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        assert isinstance(state, float)
        self.time = state

    def free_state(self, state: object) -> None:
        """See `Slave`."""

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`."""
        raise NotImplementedError

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`."""
        raise NotImplementedError

    def terminate(self) -> None:
        """See `Slave`."""

    def close(self) -> None:
        """See `Slave`."""


def driven(jumps: Jumps, **simulation: Any) -> Result:
    """An oscillator under a force that jumps."""
    system = System(
        simulation={"stop_time": STOP, **simulation},
        slaves={"source": {}, "oscillator": {}},
        connections=[("source.y", "oscillator.u")],
    )
    can = replace(ALL, max_output_derivative_order=1)
    slaves = {"source": JumpingSource(jumps), "oscillator": OSCILLATOR.slave(capabilities=can)}
    run = run_slaves(system, slaves)
    if run.error is not None:
        raise run.error
    return run.result


def largest_error(result: Result, jumps: Jumps) -> float:
    """Of the oscillator's states, at all points of the result."""
    exact = np.zeros((len(result.time), 2))
    for i, time in enumerate(result.time.tolist()):
        for begin, jump in jumps:
            if time > begin:
                exact[i] += OSCILLATOR.propagate(np.zeros(2), np.array([[jump]]), time - begin)
    y = np.column_stack([result["oscillator.x"], result["oscillator.v"]])
    return float(np.abs(y - exact).max())


WITHOUT_SHRINKING = (Phase.explicit, Phase.reuse, Phase.generate)
"""What is drawn is simple as it is."""


@settings(max_examples=40, phases=WITHOUT_SHRINKING)
@given(
    st.sampled_from(["rich", "mod"]),
    st.sampled_from(["auto", 0, 1, 2, 3]),
    st.floats(0.1, 2.9),
    st.sampled_from([1.0, -0.05, 30.0]),
)
def test_a_jump_is_found_wherever_it_is(
    estimator: str, order: Any, time: float, jump: float
) -> None:
    """Law: at any time, of any size above the tolerance, with any order up to 2.

    With a given order of 3 the estimates say so little of a small jump that steps may get over it
    first (docs/numerics.md, section 16). The input is constant before and behind it, so that
    nothing else is an error: what is left is the smallest step's.
    """
    assume(order != 3 or abs(jump) >= 1.0)
    jumps = [(time, jump)]
    result = driven(jumps, estimator=estimator, order=order)
    assert result.summary["discontinuities"] == 1
    assert largest_error(result, jumps) < 1e-5 * abs(jump)


@settings(max_examples=15, phases=WITHOUT_SHRINKING)
@example([1.6804408697559372, 1.7175634198155068])
@example([0.11253358143414634, 2.0333014966714726, 2.0, 0.4394135589371576])
@given(
    st.lists(st.floats(0.1, 2.9), min_size=1, max_size=4, unique=True).filter(
        lambda times: np.diff([0.0, *sorted(times)]).min() > 0.01
    )
)
def test_the_error_stays_small_over_a_staircase(times: list[float]) -> None:
    """Law: several jumps, each found; one soon behind another may be met by small steps as well."""
    jumps = [(time, 1.0) for time in sorted(times)]
    result = driven(jumps)
    assert 1 <= result.summary["discontinuities"] <= len(jumps)
    assert largest_error(result, jumps) < 2e-2


def test_declared_events_serve_a_gauss_seidel_sequence() -> None:
    """There inputs known ahead are interpolated, and a jump may go unnoticed: it is declared."""
    result = driven([(0.7, 1.0)], sequence="gauss-seidel", events=(0.7,))
    assert result.summary["discontinuities"] == 1
    assert largest_error(result, [(0.7, 1.0)]) < 1e-4
