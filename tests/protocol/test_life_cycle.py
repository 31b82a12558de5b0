"""The life cycle of a slave, walked as a table, and what the executor does besides the table."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.calls import (
    CALLS,
    Call,
    Configure,
    Describe,
    DeserializeState,
    DoStep,
    Examine,
    ExitInitializationMode,
    FreeState,
    GetDiscreteOutputs,
    GetOutputs,
    GetRecordedVariables,
    GetState,
    Initialize,
    RecordedValues,
    Reset,
    SerializeState,
    SetDiscreteInputs,
    SetInputs,
    SetState,
    SetValues,
    StepResult,
    StepStatus,
    Terminate,
)
from protocol.description import SlaveDescription
from protocol.errors import (
    DoublestepError,
    FatalSlaveError,
    LifeCycleError,
    ModelError,
    SlaveError,
    StepRejectedError,
)
from protocol.life_cycle import LIFE_CYCLE, LifeCycleState
from protocol.signals import FloatArray
from protocol.slave import Slave
from protocol.variables import StartValue
from slave_node.execution.executor import Executor
from slave_node.execution.snapshots import LIMIT


class Recorder(Slave):
    """A slave that writes down what it is asked, fails on demand and counts its saved states."""

    description = SlaveDescription("Recorder", "Python model", ())

    def __init__(self) -> None:
        self.heard: list[str] = []
        self.fails: dict[str, Exception] = {}
        self.step = StepStatus.OK
        self.live: set[int] = set()
        self.made = 0
        self.misused: list[str] = []

    def _hear(self, verb: str) -> None:
        self.heard.append(verb)
        if verb in self.fails:
            raise self.fails[verb]

    def _use(self, verb: str, state: object) -> None:
        self._hear(verb)
        if state not in self.live:
            self.misused.append(f"{verb} {state}")

    def _make(self, verb: str) -> int:
        self._hear(verb)
        self.made += 1
        self.live.add(self.made)
        return self.made

    def initialize(self, experiment: Initialize) -> None:
        self._hear("initialize")

    def exit_initialization_mode(self) -> None:
        self._hear("exit_initialization_mode")

    def set_inputs(self, derivatives: FloatArray) -> None:
        self._hear("set_inputs")

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        self._hear("do_step")
        return StepResult(self.step, communication_point + step_size)

    def get_outputs(self, order: int) -> FloatArray:
        self._hear("get_outputs")
        return np.zeros((order + 1, 0))

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        self._hear("set_discrete_inputs")

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        self._hear("set_values")

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        self._hear("get_discrete_outputs")
        return ()

    def record(self, names: Sequence[str]) -> None:
        if names:
            self._hear("record")

    def get_recorded_variables(self) -> RecordedValues:
        self._hear("get_recorded_variables")
        return RecordedValues(np.zeros((1, 0)), ())

    def get_state(self) -> object:
        return self._make("get_state")

    def set_state(self, state: object) -> None:
        self._use("set_state", state)

    def free_state(self, state: object) -> None:
        self._use("free_state", state)
        self.live.discard(state)  # type: ignore[arg-type]

    def serialize_state(self, state: object) -> bytes:
        self._use("serialize_state", state)
        return b"state"

    def deserialize_state(self, data: bytes) -> object:
        return self._make("deserialize_state")

    def terminate(self) -> None:
        self._hear("terminate")

    def reset(self) -> None:
        self._hear("reset")

    def close(self) -> None:
        self._hear("close")


STEP = DoStep(0.5, 0.25)
START = [Initialize(), ExitInitializationMode(), GetState(1)]
EXAMPLES: dict[type[Call], Call] = {
    type(call): call
    for call in (
        Describe(),
        Configure(),
        Initialize(),
        ExitInitializationMode(),
        Examine(0.5, 0.25),
        SetDiscreteInputs((1,)),
        SetValues({"p": 1.0}),
        GetDiscreteOutputs(),
        GetRecordedVariables(),
        SetInputs(np.zeros((1, 0))),
        STEP,
        GetOutputs(),
        GetState(2),
        SetState(1),
        FreeState(1),
        SerializeState(1),
        DeserializeState(2, b"state"),
        Terminate(),
        Reset(),
    )
}


def standing_in(state: LifeCycleState) -> tuple[Executor, Recorder]:
    """A slave brought into ``state`` by calls, with a state saved under number 1 if it can be."""
    slave = Recorder()
    executor = Executor(slave)
    program: list[Call] = {
        LifeCycleState.INSTANTIATED: [],
        LifeCycleState.INITIALIZATION_MODE: [Initialize()],
        LifeCycleState.STEP_COMPLETE: START,
        LifeCycleState.TERMINATED: [*START, Terminate()],
    }.get(state, [*START, STEP])
    match state:
        case LifeCycleState.STEP_FAILED:
            slave.step = StepStatus.DISCARD
        case LifeCycleState.ERROR:
            slave.fails["do_step"] = SlaveError("no")
        case LifeCycleState.FATAL:
            slave.fails["do_step"] = FatalSlaveError("no")
    executor.execute(program)
    assert executor.state is state
    slave.fails.clear()
    slave.step = StepStatus.OK
    return executor, slave


# ---- The table ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "kind"),
    [
        pytest.param(state, kind, id=f"{state} - {kind.verb}")
        for state, kind in itertools.product(LifeCycleState, CALLS)
    ],
)
def test_every_call_in_every_state(state: LifeCycleState, kind: type[Call]) -> None:
    """Calls in the table lead where it says; all others are refused unheard by the slave."""
    executor, slave = standing_in(state)
    heard, saved = len(slave.heard), executor.saved_states
    reply = executor.execute([EXAMPLES[kind]])
    following = LIFE_CYCLE[state].get(kind)
    if following is not None:
        assert reply.error is None
        assert len(reply.results) == 1
        assert executor.state is following
        unheard = kind in (Describe, Configure, Examine)  # nothing to configure or to examine
        assert slave.heard[heard:] == ([] if unheard else [kind.verb]) or kind is Reset
    else:
        assert type(reply.error) is LifeCycleError
        assert reply.error.phase == kind.verb
        assert f"not allowed in state '{state}'" in reply.error.cause
        assert reply.results == []
        assert executor.state is state
        assert len(slave.heard) == heard
        assert executor.saved_states == saved


def test_the_table_speaks_of_every_state_and_only_of_calls() -> None:
    """No state is forgotten, and all can be described; from all but fatal there is a way back."""
    assert set(LIFE_CYCLE) == set(LifeCycleState)
    for state, allowed in LIFE_CYCLE.items():
        assert set(allowed) <= set(CALLS)
        assert allowed[Describe] is state
        if state is not LifeCycleState.FATAL:
            assert allowed[Reset] is LifeCycleState.INSTANTIATED


# ---- Configurations ----------------------------------------------------------------------------


def test_another_configuration_is_another_slave() -> None:
    """The model is loaded anew, once, and the slave before it closed; the same again is no call."""
    slaves: list[Recorder] = []

    def load(configuration: Configure) -> Recorder:
        slaves.append(Recorder())
        slaves[-1].description = replace(Recorder.description, model=configuration.state_kind)
        return slaves[-1]

    executor = Executor(first := Recorder(), load)
    for _ in range(2):
        reply = executor.execute([Configure("replay"), Initialize()])
        assert reply.error is None
        assert reply.results[0] is executor.description
        executor.execute([Reset()])
    assert executor.description.model == "replay"
    assert first.heard == ["close"]
    assert [slave.heard for slave in slaves] == [["initialize", "reset"] * 2]


def test_a_slave_that_cannot_be_loaded_again_is_gone() -> None:
    """Its error is told, nothing but `Describe` is possible, and it is closed only once."""

    def load(_: Configure) -> Slave:
        raise ModelError("no licence")

    executor = Executor(slave := Recorder(), load)
    reply = executor.execute([Configure("fork")])
    assert type(reply.error) is ModelError
    assert reply.error.phase == "configure"
    assert executor.state is LifeCycleState.FATAL
    executor.close()
    assert slave.heard == ["close"]


def test_a_state_can_be_freed_with_its_restoring() -> None:
    """After that it is not there any more, and was freed once."""
    executor, slave = standing_in(LifeCycleState.STEP_COMPLETE)
    assert executor.execute([SetState(1, free=True)]).error is None
    assert slave.heard[-2:] == ["set_state", "free_state"]
    assert executor.saved_states == 0
    assert not slave.live
    assert isinstance(executor.execute([SetState(1)]).error, SlaveError)
    assert not slave.misused


# ---- Besides the table -------------------------------------------------------------------------


@pytest.mark.parametrize("status", [status for status in StepStatus if status is not StepStatus.OK])
def test_a_step_that_is_not_ok_ends_the_program(status: StepStatus) -> None:
    """Its result is the last one and no error; the next calls are not made."""
    executor, slave = standing_in(LifeCycleState.STEP_COMPLETE)
    slave.step = status
    reply = executor.execute([STEP, GetOutputs(), STEP])
    assert reply.error is None
    assert reply.results == [StepResult(status, 0.75)]
    assert executor.state is LifeCycleState.STEP_FAILED
    assert slave.heard[-1] == "do_step"


@pytest.mark.parametrize("failure", [StepRejectedError("no"), SlaveError("no"), ModelError("no")])
def test_a_failed_call_can_be_undone(failure: DoublestepError) -> None:
    """The error names call, t and H; what was done before it is told; a saved state leads back."""
    executor, slave = standing_in(LifeCycleState.STEP_COMPLETE)
    slave.fails["do_step"] = failure
    reply = executor.execute([GetOutputs(), STEP, GetOutputs()])
    assert reply.error is failure
    assert str(failure) == "do_step at t=0.5 s, H=0.25 s: no"
    assert len(reply.results) == 1
    assert executor.state is LifeCycleState.ERROR

    slave.fails.clear()
    reply = executor.execute([SetState(1), STEP])
    assert reply.error is None
    assert executor.state is LifeCycleState.STEP_COMPLETE


def test_a_fatal_slave_is_never_called_again() -> None:
    """Neither by a call nor by close: fmi2Fatal says that even freeing is not safe."""
    executor, slave = standing_in(LifeCycleState.STEP_COMPLETE)
    slave.fails["do_step"] = FatalSlaveError("no")
    executor.execute([STEP])
    heard = len(slave.heard)
    for call in EXAMPLES.values():
        executor.execute([call])
    executor.close()
    assert executor.state is LifeCycleState.FATAL
    assert len(slave.heard) == heard


def test_a_strange_exception_is_an_error_of_the_slave() -> None:
    """A defect in a model is reported with its class, and does not get out of the executor."""
    executor, slave = standing_in(LifeCycleState.STEP_COMPLETE)
    slave.fails["get_outputs"] = ZeroDivisionError("division by zero")
    reply = executor.execute([GetOutputs()])
    assert type(reply.error) is SlaveError
    assert str(reply.error) == "get_outputs: ZeroDivisionError: division by zero"
    assert executor.state is LifeCycleState.ERROR


def test_time_is_measured() -> None:
    """The time in the reply is the slave's own, by a monotonic clock."""
    executor, _ = standing_in(LifeCycleState.STEP_COMPLETE)
    assert 0.0 <= executor.execute([STEP]).compute_time < 1.0
    assert math.isfinite(executor.execute([]).compute_time)


# ---- Closing -----------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [s for s in LifeCycleState if s is not LifeCycleState.FATAL])
def test_closing_frees_everything_once(state: LifeCycleState) -> None:
    """From every state: saved states are freed, the slave is closed last and only once."""
    executor, slave = standing_in(state)
    executor.close()
    executor.close()
    assert slave.heard.count("close") == 1
    assert slave.heard[-1] == "close"
    assert slave.heard.count("terminate") == (
        state
        in (LifeCycleState.STEP_COMPLETE, LifeCycleState.STEP_FAILED, LifeCycleState.TERMINATED)
    )
    assert (slave.live, slave.misused) == (set(), [])


@pytest.mark.parametrize("verb", ["free_state", "terminate"])
def test_closing_ends_even_when_the_slave_objects(verb: str) -> None:
    """An error while freeing or terminating does not keep the slave from being closed."""
    executor, slave = standing_in(LifeCycleState.STEP_COMPLETE)
    slave.fails[verb] = SlaveError("no")
    executor.close()
    assert slave.heard[-1] == "close"


# ---- Saved states ------------------------------------------------------------------------------


def test_saved_states_are_bounded() -> None:
    """A master that forgets to free them is told so, and the slave makes no more."""
    executor, slave = standing_in(LifeCycleState.STEP_COMPLETE)
    assert executor.execute([GetState(i) for i in range(2, LIMIT + 1)]).error is None
    made = slave.made
    for call in (GetState(999), DeserializeState(999, b"state")):
        executor.execute([SetState(1)])
        reply = executor.execute([call])
        assert type(reply.error) is SlaveError
        assert f"{LIMIT} states are saved already; free" in str(reply.error)
    assert slave.made == made
    assert executor.execute([SetState(1), FreeState(2), GetState(99)]).error is None


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (SetState(7), "no state is saved under number 7; saved: 1, 2"),
        (FreeState(7), "no state is saved under number 7"),
        (SerializeState(7), "no state is saved under number 7"),
    ],
)
def test_a_wrong_number_is_named(call: Call, message: str) -> None:
    """A number that nothing is saved under is the master's mistake; no state is lost by it."""
    executor, slave = standing_in(LifeCycleState.STEP_COMPLETE)
    executor.execute([GetState(2)])
    reply = executor.execute([call])
    assert reply.error is not None
    assert message in reply.error.cause
    assert len(slave.live) == executor.saved_states == 2


@pytest.mark.parametrize("call", [GetState(1), DeserializeState(1, b"state")])
def test_a_number_can_be_used_again(call: Call) -> None:
    """The state that was saved under it is freed once the new one is there, and not if it fails."""
    executor, slave = standing_in(LifeCycleState.STEP_COMPLETE)
    (old,) = slave.live
    assert executor.execute([call]).error is None
    assert slave.live == {old + 1}
    assert slave.heard[-2:] == [call.verb, "free_state"]

    slave.fails[call.verb] = SlaveError("no")
    assert executor.execute([call]).error is not None
    assert slave.live == {old + 1}
    assert executor.execute([SetState(1)]).error is None
    assert slave.misused == []


@given(
    program=st.lists(
        st.one_of(
            *(
                st.builds(cls, st.integers(0, 4))
                for cls in (GetState, SetState, FreeState, SerializeState)
            ),
            st.builds(DeserializeState, st.integers(0, 4), st.just(b"state")),
            st.sampled_from([STEP, Reset(), Initialize(), ExitInitializationMode(), Terminate()]),
        ),
        max_size=40,
    ),
    failing=st.sets(st.sampled_from(["do_step", "get_state", "deserialize_state", "set_state"])),
)
@settings(max_examples=200)
def test_each_saved_state_is_freed_exactly_once(program: list[Call], failing: set[str]) -> None:
    """Whatever is called and whatever fails: none is leaked, none is used after it was freed."""
    slave = Recorder()
    executor = Executor(slave)
    executor.execute(START)
    slave.fails = {verb: SlaveError("no") for verb in failing}
    for call in program:
        executor.execute([call])
        assert len(slave.live) == executor.saved_states <= LIMIT
    executor.close()
    assert slave.live == set()
    assert slave.heard.count("free_state") == slave.made
    assert slave.misused == []
