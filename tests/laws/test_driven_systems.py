"""One slave drives another: nothing comes back, so only what is handed on tells of an error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import Phase, assume, example, given, settings
from hypothesis import strategies as st

from master_node import Result, System
from tests.support.jump_models import ExactSlave
from tests.support.quarter_car_case import ALL, LinearSystem, run_slaves

Jumps = Sequence[tuple[float, float]]
STOP = 3.0

OSCILLATOR = LinearSystem(
    a=np.array([[0.0, 1.0], [-30.0, -1.0]]),
    b=np.array([[0.0], [30.0]]),
    c=np.zeros(2),
    inputs=("u",),
    outputs=("x", "v"),
)


class JumpingSource(ExactSlave):
    """y jumps by a at t_i, for each (t_i, a); from t_i on it has the new value."""

    def __init__(self, jumps: Jumps) -> None:
        self.jumps = jumps
        super().__init__((), ("y",), derivatives=True)

    def read(self, t: float, x: np.ndarray, u: np.ndarray) -> Sequence[Sequence[float]]:
        """See `ExactSlave`."""
        return [[sum(jump for time, jump in self.jumps if t >= time)], [0.0]]


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
    """Largest error of the oscillator's states, at all points of the result."""
    exact = np.zeros((len(result.time), 2))
    for i, time in enumerate(result.time.tolist()):
        for begin, jump in jumps:
            if time > begin:
                exact[i] += OSCILLATOR.propagate(np.zeros(2), np.array([[jump]]), time - begin)
    y = np.column_stack([result["oscillator.x"], result["oscillator.v"]])
    return float(np.abs(y - exact).max())


WITHOUT_SHRINKING = (Phase.explicit, Phase.reuse, Phase.generate)
"""Drawn examples are simple as they are."""


@settings(max_examples=15, phases=WITHOUT_SHRINKING)
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


@settings(max_examples=5, phases=WITHOUT_SHRINKING)
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
