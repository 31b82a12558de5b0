"""States restored by doing everything again: the same bits, a record of known size, and an error
where a model does not repeat.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.calls import (
    Call,
    DoStep,
    ExitInitializationMode,
    GetDiscreteOutputs,
    GetOutputs,
    Initialize,
    SetDiscreteInputs,
    SetInputs,
    SetValues,
    StepResult,
    StepStatus,
)
from protocol.description import StateKind
from protocol.errors import SlaveError
from slave_node.states.call_record import CallRecord
from slave_node.states.replay_slave import ReplaySlave
from tests.support.quarter_car_case import WHEEL, LinearSlave
from tests.support.slow import quick_at
from tests.support.state_programs import begin, loaded, wander, wheel


@pytest.mark.parametrize("seed", quick_at([0], range(5)))
def test_a_random_walk_through_states_meets_the_same_bits_as_natively(
    fmu_dir: Path, seed: int
) -> None:
    """Also states that lie beyond one that was restored keep what they are."""
    walks = []
    for kind in ("native", "replay"):
        with wheel(fmu_dir, kind) as slave:
            walks.append(wander(slave, seed, 200))
    assert len(walks[0]) > 60
    assert walks[0] == walks[1]


def test_another_process_goes_on_from_the_bytes(fmu_dir: Path) -> None:
    """The record says all that there is to say of a state."""
    inputs = np.array([[0.1, 0.2], [0.0, 0.3]])
    with wheel(fmu_dir, "replay") as slave, wheel(fmu_dir, "replay") as other:
        slave.set_inputs(inputs)
        slave.do_step(0.0, 0.01, False)
        data = slave.serialize_state(slave.get_state())
        other.set_state(other.deserialize_state(data))
        ends = []
        for each in (slave, other):
            each.set_inputs(-inputs)
            each.do_step(0.01, 0.01, False)
            ends.append(each.get_outputs(1).tobytes())
        assert ends[0] == ends[1]


# ---- The record ---------------------------------------------------------------------------------

INITIALIZE = Initialize(
    start_values={"m": 1.0},
    inputs=("a", "b"),
    outputs=("y",),
    discrete_inputs=("n", "s"),
    discrete_outputs=("z",),
)
_numbers = st.floats(allow_nan=False)
_calls: st.SearchStrategy[Call] = st.one_of(
    st.builds(
        SetInputs,
        st.integers(1, 4).flatmap(
            lambda rows: st.lists(_numbers, min_size=2 * rows, max_size=2 * rows).map(
                lambda row: np.array(row).reshape(-1, 2)
            )
        ),
    ),
    st.builds(DoStep, _numbers, _numbers, st.booleans()),
    st.builds(GetOutputs, st.integers(0, 3)),
    st.builds(SetDiscreteInputs, st.tuples(st.integers(-5, 5), st.text(max_size=5))),
    st.builds(SetValues, st.dictionaries(st.text(max_size=5), st.integers(-5, 5), max_size=2)),
    st.just(GetDiscreteOutputs()),
    st.just(ExitInitializationMode()),
)


def same(a: Call, b: Call) -> bool:
    """Equal, bit for bit."""
    if isinstance(a, SetInputs) and isinstance(b, SetInputs):
        return a.derivatives.shape == b.derivatives.shape and (
            a.derivatives.tobytes() == b.derivatives.tobytes()
        )
    return a == b


@given(calls=st.lists(_calls, max_size=30), length=st.integers(0, 30))
def test_a_record_gives_its_calls_again(calls: list[Call], length: int) -> None:
    """Also a copy of its beginning, also from bytes; each call takes a byte, each number eight."""
    record = CallRecord(INITIALIZE)
    for call in calls:
        record.add(call)
    length = min(length, len(calls))
    copy = record.copy(length)
    for each, expected in (
        (record, calls),
        (copy, calls[:length]),
        (CallRecord.from_bytes(record.to_bytes()), calls),
    ):
        first, *rest = each.calls()
        assert first == INITIALIZE
        assert len(rest) == len(expected) == len(each)
        assert all(map(same, rest, expected))
    numbers = sum(
        call.derivatives.size if isinstance(call, SetInputs) else 2 * isinstance(call, DoStep)
        for call in calls
    )
    assert record.size == len(calls) + 8 * numbers


@given(data=st.data())
def test_damaged_bytes_are_refused(data: st.DataObject) -> None:
    """Whatever byte is another one, wherever they end: an error, never a wrong past."""
    record = CallRecord(INITIALIZE)
    for call in (ExitInitializationMode(), SetInputs(np.ones((1, 2))), DoStep(0.0, 1.0)):
        record.add(call)
    whole = record.to_bytes()
    place = data.draw(st.integers(0, len(whole) - 1))
    changed = bytearray(whole)
    changed[place] ^= data.draw(st.integers(1, 255))
    for damaged in (bytes(changed), whole[:place], whole + b"\0"):
        with pytest.raises(SlaveError, match="not a saved state"):
            CallRecord.from_bytes(damaged)


# ---- Models that are not as they should be ------------------------------------------------------


class Moody(LinearSlave):
    """A wheel that need not reset, and need not repeat its second step."""

    def __init__(self, *, resets: bool = True, second_time: Callable[[], object] = int) -> None:
        super().__init__(WHEEL, np.zeros(2))
        self._resets = resets
        self._second_time = second_time
        self._steps = 0

    def reset(self) -> None:
        """Or not."""
        if not getattr(self, "_resets", True):
            raise SlaveError("fmi2Reset returned fmi2Error")
        super().reset()

    def do_step(self, *step: Any) -> StepResult:
        """The third one is the second one done again."""
        self._steps += 1
        if self._steps == 3:
            result = self._second_time()
            if isinstance(result, StepResult):
                return result
        return super().do_step(*step)


def step_twice_and_go_back(slave: ReplaySlave) -> np.ndarray:
    """Outputs after one step, after a second one and the way back."""
    begin(slave, WHEEL.inputs, WHEEL.outputs)
    slave.do_step(0.0, 0.1, False)
    state = slave.get_state()
    slave.do_step(0.1, 0.1, False)
    slave.set_state(state)
    return slave.get_outputs(0)


def test_a_model_that_cannot_be_reset_is_loaded_anew() -> None:
    """With the same outputs as after a reset."""
    loads = []

    def load(*, resets: bool) -> Moody:
        loads.append(resets)
        return Moody(resets=resets)

    outputs = [
        step_twice_and_go_back(ReplaySlave(lambda resets=resets: load(resets=resets), ""))
        for resets in (True, False)
    ]
    assert loads == [True, False, False]
    assert outputs[0].tobytes() == outputs[1].tobytes()


def fails() -> object:
    """An error in the step."""
    raise SlaveError("fmi2DoStep returned fmi2Error")


@pytest.mark.parametrize(
    ("second_time", "how"),
    [
        (lambda: StepResult(StepStatus.DISCARD, 0.05), "discard"),
        (fails, "fmi2DoStep returned fmi2Error"),
    ],
)
def test_a_step_that_does_not_end_as_before_is_an_error(
    second_time: Callable[[], object], how: str
) -> None:
    """It says which step, how it ended, and what else to choose; it is no step to be rejected."""
    slave = ReplaySlave(lambda: Moody(second_time=second_time), "")
    with pytest.raises(SlaveError, match=f"does not repeat: do_step from 0.0 s.*{how}") as error:
        step_twice_and_go_back(slave)
    assert type(error.value) is SlaveError
    assert 'state = "fork"' in error.value.remedy


def test_the_price_is_said(fmu_dir: Path) -> None:
    """In the description: the kind, the reason, and that a restore costs the whole past."""
    with loaded(fmu_dir / "wheel.fmu", "replay") as slave:
        assert slave.description.state_kind is StateKind.REPLAY
        assert slave.description.state_reason == "the configuration asks for it"
        assert any("cost grows with the time" in r for r in slave.description.remarks)
