"""States saved by forking: the same bits as natively, nothing leaks, nothing survives, and what
cannot be forked is refused by name.
"""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from master_node import System, simulate
from master_node.results import Result
from protocol.calls import (
    DoStep,
    ExitInitializationMode,
    GetState,
    Initialize,
    Reset,
    SetInputs,
    SetState,
    StepStatus,
)
from protocol.description import SlaveDescription, StateKind
from protocol.errors import (
    FatalSlaveError,
    ModelError,
    SlaveCrashedError,
    SlaveError,
    SlaveKilledError,
    StepRejectedError,
)
from protocol.slave import Slave
from protocol.variables import Causality, VariableType
from protocol.wire.programs import encode_program
from protocol.wire.replies import decode_reply
from slave_node.execution.exit_codes import OWN_FAILURE, death
from slave_node.states.channel import Channel, Message
from slave_node.states.fork_habits import Event, Habits
from slave_node.states.held_process import HeldProcess
from slave_node.worker.process import ModelReference, WorkerProcess
from tests.support.quarter_car_case import DISPLACEMENT
from tests.support.slow import quick_at
from tests.support.state_programs import MODELS, begin, fragile, loaded, wander, wheel
from tests.support.trial_slaves import examine
from tests.support.waiting import BOUND, wait_until

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="forks"),
    pytest.mark.usefixtures("no_process_left"),
]

ONE = np.array([[0.5]])
DEADLY = np.array([[1.5]])
ENDLESS = np.array([[2.5]])


def family(process: psutil.Process | None = None) -> set[psutil.Process]:
    """All processes below this one that tests may meet."""
    return {
        child
        for child in (process or psutil.Process()).children(recursive=True)
        if not any("resource_tracker" in word for word in _command_line(child))
    }


def _command_line(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []


def living(processes: set[psutil.Process]) -> set[psutil.Process]:
    """Those that are neither gone nor dead and unburied."""
    return {p for p in processes if p.is_running() and _status(p) != psutil.STATUS_ZOMBIE}


def waits(processes: set[psutil.Process]) -> bool:
    """True if all of them wait to be asked: they have told their numbers then."""
    return all(_status(process) == psutil.STATUS_SLEEPING for process in processes)


def _status(process: psutil.Process) -> str:
    try:
        return str(process.status())
    except psutil.NoSuchProcess:
        return str(psutil.STATUS_ZOMBIE)


# ---- The same bits ------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", quick_at([0], range(3)))
def test_a_random_walk_through_states_meets_the_same_bits_as_natively(
    fmu_dir: Path, seed: int
) -> None:
    """Whatever is saved, restored, given up and stepped, in whatever order."""
    walks = []
    for kind in ("native", "fork"):
        with wheel(fmu_dir, kind) as slave:
            walks.append(wander(slave, seed, 100))
    assert len(walks[0]) > 30
    assert walks[0] == walks[1]


def car(folder: Path, state: str | None, chassis: str = "chassis", wheel: str = "wheel") -> System:
    """The quarter car, with a first step that is rejected."""
    return System(
        simulation={"stop_time": 0.5, "initial_step_size": 0.1, "order": 1},
        slaves={
            name: {"model": f"{model}.fmu", **({"state": state} if state else {})}
            for name, model in (("chassis", chassis), ("wheel", wheel))
        },
        connections=DISPLACEMENT,
        base=folder,
    )


def results(system: System, output: Path, kind: str, **options: Any) -> bytes:
    """Results file of a run that rejects double steps and saves states in the way ``kind``."""
    result = simulate(system, output=output, **options)
    assert result.summary["rejected_double_steps"] > 0
    models = Result.load(output).summary["settings"]["models"]
    assert {model["state_kind"] for model in models.values()} == {kind}
    return (output / "results.csv").read_bytes()


@pytest.mark.parametrize("estimator", quick_at(["mod"], ["mod", "rich"]))
def test_a_run_gives_the_same_file_however_states_are_saved(
    fmu_dir: Path, tmp_path: Path, estimator: str
) -> None:
    """With rejected double steps, in this process."""
    files = {
        results(car(fmu_dir, kind), tmp_path / kind, kind, estimator=estimator, in_process=True)
        for kind in ("native", "fork", "replay")
    }
    assert len(files) == 1


@pytest.mark.slow
def test_real_slave_processes_write_the_same_file(fmu_dir: Path, tmp_path: Path) -> None:
    """Over Zenoh, each slave a node, a worker and a family of holders."""
    files = {results(car(fmu_dir, "native"), tmp_path / "here", "native", in_process=True)} | {
        results(car(fmu_dir, kind), tmp_path / kind, kind) for kind in ("fork", "replay")
    }
    assert len(files) == 1


def test_fmus_that_cannot_save_their_state_are_controlled_all_the_same(
    capability_dir: Path, tmp_path: Path
) -> None:
    """`bare` is `no_derivatives` without saved states: forked by default, with the same file."""
    files = []
    for kind, variant in (("native", "no_derivatives"), ("fork", "bare")):
        system = car(capability_dir, None, f"chassis_{variant}", f"wheel_{variant}")
        files.append(results(system, tmp_path / variant, kind, in_process=True))
    assert files[0] == files[1]


def _names(
    described: SlaveDescription, causality: Causality
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Continuous and discrete variables; clocks are not exchanged."""
    variables = [v for v in described.of(causality) if v.type is not VariableType.CLOCK]
    return (
        tuple(v.name for v in variables if v.is_continuous_real),
        tuple(v.name for v in variables if not v.is_continuous_real),
    )


@pytest.mark.parametrize(
    "fmu", ["all_types2", "all_types3", "wheel_fmi1", "wheel_fmi3_bare", "wheel_me2", "event_mode3"]
)
def test_every_kind_of_fmu_and_value_is_forked_and_replayed(capability_dir: Path, fmu: str) -> None:
    """With values of all types that change with time, forth and back, the same outputs."""
    seen = []
    for kind in ("fork", "replay"):
        with loaded(capability_dir / f"{fmu}.fmu", kind) as slave:
            described = slave.description
            inputs, outputs = (_names(described, c) for c in (Causality.INPUT, Causality.OUTPUT))
            starts = [described.variable(name).start for name in inputs[1]]
            slave.reset()
            begin(slave, inputs[0], outputs[0], discrete=(inputs[1], outputs[1]))
            seen.append([])

            def step(time: float, value: float) -> None:
                slave.set_inputs(np.full((1, len(inputs[0])), value))  # noqa: B023
                slave.set_discrete_inputs(starts)  # noqa: B023
                slave.do_step(time, 0.2, False)
                seen[-1].append((slave.get_outputs(0).tobytes(), slave.get_discrete_outputs()))

            step(0.0, 0.1)
            state = slave.get_state()
            step(0.2, 0.2)
            step(0.4, 0.3)
            slave.set_state(state)
            step(0.2, 0.2)
            step(0.4, 0.3)
            slave.set_state_and_free(state)
            seen[-1].append((slave.get_outputs(0).tobytes(), slave.get_discrete_outputs()))
    assert seen[0] == seen[1]
    first, second, third, again, and_again, back = seen[0]
    assert (second, third, first) == (again, and_again, back)
    assert len({*map(repr, (first, second, third))}) == 3


def test_a_state_that_the_fmu_does_not_restore_is_restored_by_forking(capability_dir: Path) -> None:
    """The FMU forgets its state silently; the examination tells, and calls the fork exact."""
    verdicts = {}
    for kind in ("native", "fork"):
        fmu = capability_dir / "broken_state.fmu"
        with loaded(fmu, kind, inputs=("u",), outputs=("y",)) as slave:
            slave.set_inputs(np.array([[0.0]]))
            verdicts[kind] = str(examine(slave, 0.0, 0.01).state_verdict)
    assert verdicts["native"] != "exact"
    assert verdicts["fork"] == "exact"


def test_a_file_that_is_read_is_read_again_from_where_it_stood(tmp_path: Path) -> None:
    """The copies have one file each: none moves the place of another."""
    numbers = tmp_path / "numbers"
    numbers.write_text("".join(f"{number:7d}\n" for number in range(1000)))
    with loaded(f"{MODELS}:Reader", "fork", outputs=("y",), file=str(numbers)) as slave:

        def next_numbers() -> list[float]:
            numbers = []
            for time in (0.0, 1.0, 2.0):
                slave.do_step(time, 1.0, True)
                numbers.append(float(slave.get_outputs(0)[0, 0]))
            return numbers

        state = slave.get_state()
        first = next_numbers()
        slave.set_state(state)
        again = next_numbers()
        slave.set_state_and_free(state)
        assert first == again == next_numbers()
        assert len(set(first)) == 3


# ---- Which processes there are ------------------------------------------------------------------


def test_a_state_that_is_given_up_becomes_the_slave_without_a_fork(fmu_dir: Path) -> None:
    """Processes before and after: a restore that keeps the state makes one, the other none."""
    with wheel(fmu_dir, "fork") as slave:
        keeper_and_slave = family()
        assert len(keeper_and_slave) == 2
        state = slave.get_state()
        (saved,) = family() - keeper_and_slave
        slave.set_state(state)
        wait_until(lambda: len(living(family())) == 3)
        (copy,) = living(family()) - keeper_and_slave - {saved}
        slave.set_state_and_free(state)
        wait_until(lambda: len(living(family())) == 2)
        assert saved in living(family())
        assert copy not in living(family())


def test_freed_states_and_closed_slaves_leave_no_process(fmu_dir: Path) -> None:
    """Not even a dead one that nobody buried."""
    with wheel(fmu_dir, "fork") as slave:
        states = [slave.get_state() for _ in range(5)]
        wait_until(lambda: len(family()) == 7)
        for state in states:
            slave.free_state(state)
        slave.do_step(0.0, 1e-3, True)
        wait_until(lambda: len(family()) == 2)
        slave.get_state()
        slave.reset()
        wait_until(lambda: len(family()) == 2)
        slave.get_state()
    assert family() == set()


@pytest.mark.parametrize(
    ("kind", "cycles"),
    [
        ("native", 10_000),
        ("fork", 200),
        pytest.param("fork", 2_000, marks=pytest.mark.slow),
    ],
)
def test_nothing_leaks(fmu_dir: Path, kind: str, cycles: int) -> None:
    """Save, step, restore, step, free: memory, descriptors and processes stay as they are.

    But for what CPython leaves behind with each fork, the locks of before: half a KiB.
    """
    left_by_forks = 1024 * cycles if kind == "fork" else 0

    def measure() -> tuple[int, list[int], int]:
        processes = [psutil.Process(), *family()]
        memory = sum(process.memory_info().rss for process in processes)
        return len(processes), [p.num_fds() for p in processes[:1]], memory

    with wheel(fmu_dir, kind) as slave:
        inputs = np.array([[0.1, 0.0]])
        before: tuple[int, list[int], int] | None = None
        for cycle in range(cycles):
            state = slave.get_state()
            slave.set_inputs(inputs)
            slave.do_step(0.0, 1e-3, True)
            slave.get_outputs(0)
            slave.set_state(state)
            slave.set_inputs(inputs)
            slave.do_step(0.0, 1e-3, True)
            if cycle % 2:
                slave.set_state_and_free(state)
            else:
                slave.set_state(state)
                slave.free_state(state)
            if cycle == cycles // 10:
                if kind == "fork":
                    wait_until(lambda: len(family()) == 2)
                before = measure()
        if kind == "fork":
            wait_until(lambda: len(family()) == 2)
        after = measure()
    assert before is not None
    assert after[:2] == before[:2]
    assert after[2] - before[2] < 2 * 2**20 + left_by_forks


@pytest.fixture
def no_step_is_dear(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow this machine is just now, steps are done again rather than copied."""
    monkeypatch.setattr("slave_node.states.fork_trail._LONGEST", BOUND)


@pytest.mark.usefixtures("no_step_is_dear")
@pytest.mark.parametrize("estimator", quick_at(["mod"], ["mod", "rich"]))
def test_a_double_step_copies_each_process_once(
    fmu_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, estimator: str
) -> None:
    """Three solutions need two copies; that of a state which is never restored is spared. Trial
    steps before them would count too.
    """
    copies = []
    copy = HeldProcess.copy
    monkeypatch.setattr(HeldProcess, "copy", lambda self: copies.append(self) or copy(self))
    system = car(fmu_dir, "fork").with_simulation(
        initial_step_size=1e-3, largest_step_size=2e-3, examine=False
    )
    summary = simulate(
        system, output=tmp_path / "r", estimator=estimator, in_process=True, stop_time=0.4
    ).summary
    accepted = summary["communication_steps"] // 2
    assert accepted > 90
    assert len(copies) < 1.2 * 2 * accepted + 4 * 2 * summary["rejected_double_steps"]


def saved_by_a_trail(slave: Slave) -> tuple[object, float]:
    """A state for which there is no process, as none before it was restored; and its time."""
    state: object = None
    for time in range(6):
        before, state = state, slave.get_state()
        if before is not None:
            slave.free_state(before)
        slave.do_step(1e-3 * time, 1e-3, True)
        slave.get_outputs(0)
    last = slave.get_state()
    slave.free_state(state)
    wait_until(lambda: len(family()) == 3)  # keeper, slave, origin
    return last, 6e-3


@pytest.mark.usefixtures("no_step_is_dear")
def test_a_state_that_is_not_expected_to_be_restored_is_restored_all_the_same(
    fmu_dir: Path,
) -> None:
    """By doing again what was done since an earlier one, to the same bits, twice."""
    with wheel(fmu_dir, "fork") as slave:
        slave.set_inputs(np.array([[0.1, 0.0], [0.2, 1.0]]))
        state, time = saved_by_a_trail(slave)
        ends = []
        for restore in (None, slave.set_state, slave.set_state_and_free):
            if restore is not None:
                restore(state)
            slave.do_step(time, 1e-3, True)
            ends.append(slave.get_outputs(0).tobytes())
        wait_until(lambda: len(family()) == 2)
    assert len(set(ends)) == 1


@pytest.mark.usefixtures("no_step_is_dear")
def test_a_model_that_does_not_repeat_is_not_restored_elsewhere(tmp_path: Path) -> None:
    """A file that changed under a model is an error, and gives no other state."""
    numbers = tmp_path / "numbers"
    numbers.write_text("".join(f"{number:7d}\n" for number in range(1000)))
    with loaded(f"{MODELS}:Reader", "fork", outputs=("y",), file=str(numbers)) as slave:
        state, _ = saved_by_a_trail(slave)
        with numbers.open("r+") as file:
            file.write("".join(f"{number:7d}\n" for number in range(1000, 2000)))
        with pytest.raises(SlaveError, match="the model does not repeat"):
            slave.set_state(state)


def test_habits_know_what_came_the_last_time() -> None:
    """In the same situation: the same events and as many states as before; else nothing."""
    habits = Habits()
    for event, expected in (
        (Event.SAVE, None),
        (Event.STEP, None),
        (Event.GIVE_UP, None),
        (Event.STEP, None),
        (Event.SAVE, Event.STEP),
        (Event.STEP, Event.GIVE_UP),
    ):
        habits.note(event, 1)
        assert habits.expected is expected
    habits.note(Event.STEP, 2)
    assert habits.expected is None


def test_habits_know_what_states_were_used_for() -> None:
    """The first state in a situation is expected to be restored, the most expensive use."""
    habits = Habits()
    situation = habits.situation
    assert habits.use(situation) is Event.GIVE_UP
    for use in (None, Event.RESTORE):
        habits.note_use(situation, use)
        assert habits.use(situation) is use


# ---- Deaths -------------------------------------------------------------------------------------


def test_a_crash_in_a_trial_step_is_undone() -> None:
    """The model dies, its saved state does not: the step is rejected and tried otherwise."""
    with fragile() as slave:
        state = slave.get_state()
        slave.set_inputs(DEADLY)
        with pytest.raises(StepRejectedError, match="died by SIGSEGV"):
            slave.do_step(0.0, 0.1, True)
        with pytest.raises(SlaveCrashedError, match="restore a saved state"):
            slave.get_outputs(0)
        slave.set_state(state)
        slave.set_inputs(ONE)
        assert slave.do_step(0.0, 0.1, True).status is StepStatus.OK
        assert slave.get_outputs(0)[0, 0] == pytest.approx(0.5 + 0.5 * np.exp(-0.1), abs=1e-6)


def test_a_crash_without_a_saved_state_is_the_end_until_a_reset() -> None:
    """There is nothing to go back to, but the model can be loaded anew."""
    with fragile() as slave:
        slave.set_inputs(DEADLY)
        with pytest.raises(FatalSlaveError, match="died by SIGSEGV"):
            slave.do_step(0.0, 0.1, True)
        slave.reset()
        begin(slave, ("u",), ("y",))
        slave.set_inputs(ONE)
        assert slave.do_step(0.0, 0.1, True).status is StepStatus.OK


def test_a_killed_saved_state_is_named(fmu_dir: Path) -> None:
    """A saved state that is killed, as by a kernel out of memory, is named."""
    with wheel(fmu_dir, "fork") as slave:
        before = family()
        state = slave.get_state()
        (saved,) = family() - before
        wait_until(lambda: waits({saved}))
        saved.kill()
        with pytest.raises(SlaveKilledError, match="died by SIGKILL"):
            slave.set_state(state)
        assert slave.do_step(0.0, 1e-3, True).status is StepStatus.OK


def test_a_killed_saved_state_is_named_when_its_death_was_told_long_ago(fmu_dir: Path) -> None:
    """A death is remembered while other copies are made, and taken for that of none of them."""
    with wheel(fmu_dir, "fork") as slave:
        before = family()
        state = slave.get_state()
        (saved,) = family() - before
        wait_until(lambda: waits({saved}))
        saved.kill()
        wait_until(lambda: not saved.is_running())  # buried, so that its death is told
        others = [slave.get_state() for _ in range(3)]
        with pytest.raises(SlaveKilledError, match="died by SIGKILL"):
            slave.set_state(state)
        for other in others:
            slave.set_state(other)
            assert slave.do_step(0.0, 1e-3, True).status is StepStatus.OK


@pytest.mark.usefixtures("no_step_is_dear")
def test_a_saved_state_that_is_killed_before_it_was_asked_anything(fmu_dir: Path) -> None:
    """Its number stands unread in its socket. The step after it is not the one to blame."""
    with wheel(fmu_dir, "fork") as slave:
        slave.get_state()  # the only one that is waited for
        slave.do_step(0.0, 1e-3, True)
        before = family()
        state = slave.get_state()
        wait_until(lambda: len(family()) > len(before))
        victims = family() - before
        wait_until(lambda: waits(victims))
        for victim in victims:
            victim.kill()
        wait_until(lambda: not living(victims))
        slave.set_state(state)
        with pytest.raises(SlaveKilledError, match="died by SIGKILL"):
            slave.do_step(1e-3, 1e-3, True)


def test_a_holder_that_dies_unasked_is_not_the_doing_of_the_next_step(fmu_dir: Path) -> None:
    """Not even by a signal that models die of."""
    with wheel(fmu_dir, "fork") as slave:
        slave.get_state()
        (holder,) = {p for p in family() if p.pid == slave._active._process}
        holder.send_signal(signal.SIGSEGV)
        wait_until(lambda: not living({holder}))
        with pytest.raises(SlaveKilledError, match="died by SIGSEGV"):
            slave.do_step(0.0, 1e-3, True)


def test_an_interrupt_is_not_for_holders(fmu_dir: Path) -> None:
    """SIGINT, to keeper and holders: all go on."""
    with wheel(fmu_dir, "fork") as slave:
        state = slave.get_state()
        for process in family():
            process.send_signal(signal.SIGINT)
        for time in (0.0, 1e-3):
            assert slave.do_step(time, 1e-3, True).status is StepStatus.OK
        slave.set_state(state)
        assert slave.do_step(0.0, 1e-3, True).status is StepStatus.OK
        wait_until(lambda: len(living(family())) == 3)  # the one that went back ends by itself


def test_a_worker_that_dies_unasked_is_not_the_doing_of_the_next_step(tmp_path: Path) -> None:
    """Models in the worker itself die with its cause; a worker that is gone has none."""
    worker = WorkerProcess(ModelReference(f"{MODELS}:Fragile", tmp_path, "x", state_kind="none"))
    worker.start()
    assert worker.pid is not None
    psutil.Process(worker.pid).send_signal(signal.SIGSEGV)
    assert worker._pipe is not None
    assert worker._pipe.has_message(BOUND)
    for words in ("died by SIGSEGV", "is gone"):
        with pytest.raises(SlaveKilledError, match=words):
            worker.execute(encode_program([Reset()]))
    worker.stop()


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (None, SlaveKilledError),
        (OWN_FAILURE, SlaveKilledError),
        *((-number, SlaveKilledError) for number in (1, 2, 3, 9, 10, 12, 14, 15, 24, 25, 34)),
        *((-number, SlaveCrashedError) for number in (4, 5, 6, 7, 8, 11, 31)),
        (0, SlaveCrashedError),
        (1, SlaveCrashedError),
    ],
)
def test_only_what_is_known_to_be_the_model_s_doing_is_a_crash(
    code: int | None, kind: type[SlaveCrashedError]
) -> None:
    """All other deaths, and unknown ones, restore the slave and reject nothing."""
    assert type(death(code)) is kind


def test_a_holder_that_does_not_read_is_not_dead() -> None:
    """A long message to one that computes, or was stopped, waits; it is no sign of a death."""
    ours, theirs = socket.socketpair()
    payload = bytes(2**22)
    received: list[object] = []
    reader = threading.Thread(target=lambda: received.append(Channel(theirs).receive()))
    idle = 0

    def wait() -> None:
        nonlocal idle
        idle += 1
        if idle == 3:
            reader.start()

    channel = Channel(ours, wait, 0.01)
    channel.send(Message.PROGRAM, payload)
    reader.join(BOUND)
    assert received == [(Message.PROGRAM, payload)]
    channel.close()
    theirs.close()


def test_a_killed_keeper_takes_nobody_along_and_leaves_nobody(fmu_dir: Path) -> None:
    """The slave goes on; without a keeper it ends its processes itself."""
    with wheel(fmu_dir, "fork") as slave:
        state = slave.get_state()
        processes = family()
        keeper = next(child for child in psutil.Process().children() if child in processes)
        keeper.kill()
        slave.set_state_and_free(state)
        assert slave.do_step(0.0, 1e-3, True).status is StepStatus.OK
        slave.get_state()
    wait_until(lambda: not living(processes))


def worker_in_an_endless_step(
    tmp_path: Path,
) -> tuple[WorkerProcess, psutil.Process, list[object]]:
    """A worker with a saved state, its holder that does not come back, and how that will end."""
    sign = tmp_path / "in the step"
    worker = WorkerProcess(
        ModelReference(f"{MODELS}:Fragile", tmp_path, "x", {"sign": str(sign)}, state_kind="fork")
    )
    description = worker.start()
    assert description.state_kind is StateKind.FORK
    program = [
        Initialize(inputs=("u",), outputs=("y",)),
        ExitInitializationMode(),
        GetState(0),
        SetInputs(ONE),
        DoStep(0.0, 0.1),
        SetState(0),
        SetInputs(ENDLESS),
        DoStep(0.0, 0.1),
    ]
    ends: list[object] = []

    def execute() -> None:
        try:
            ends.append(worker.execute(encode_program(program)))
        except SlaveCrashedError as error:
            ends.append(error)

    threading.Thread(target=execute, daemon=True).start()
    wait_until(lambda: sign.exists() and bool(sign.read_text()))
    return worker, psutil.Process(int(sign.read_text())), ends


def test_a_worker_that_is_killed_in_an_endless_step_leaves_nobody(tmp_path: Path) -> None:
    """A worker that is killed in an endless step, as on abort, leaves no process."""
    worker, _, ends = worker_in_an_endless_step(tmp_path)
    wait_until(lambda: len(living(family())) == 4)  # worker, keeper, state, slave
    processes = family()
    worker.kill()
    wait_until(lambda: not living(processes))
    wait_until(lambda: bool(ends))
    assert isinstance(ends[0], SlaveCrashedError)
    worker.stop()


def test_a_killed_holder_is_an_error_of_the_slave_and_the_worker_goes_on(tmp_path: Path) -> None:
    """Its name and its signal reach the master; the state brings it back."""
    worker, holder, ends = worker_in_an_endless_step(tmp_path)
    holder.kill()
    wait_until(lambda: bool(ends))
    assert isinstance(ends[0], bytes)
    assert b"SlaveKilledError" in ends[0]
    assert b"died by SIGKILL" in ends[0]
    again = [SetState(0), SetInputs(ONE), DoStep(0.0, 0.1)]
    answer = decode_reply(again, worker.execute(encode_program(again)))
    assert answer.error is None
    worker.stop()


def test_a_killed_node_leaves_nobody(fmu_dir: Path, endpoint: str) -> None:
    """Node, worker, keeper and holder are one family."""
    command = [sys.executable, "-m", "slave_node", "serve", str(fmu_dir / "wheel.fmu")]
    node = subprocess.Popen(
        [*command, "--listen", endpoint, "--state", "fork"], stderr=subprocess.PIPE, text=True
    )
    try:
        assert node.stderr is not None
        assert any("ready" in line for line in node.stderr)
        processes = family(psutil.Process(node.pid))
        assert len(processes) == 3  # worker, keeper, holder
    finally:
        node.kill()
        node.wait(BOUND)
        assert node.stderr is not None
        node.stderr.close()
    wait_until(lambda: not living(processes))


def test_ctrl_c_in_process_ends_an_endless_step(tmp_path: Path) -> None:
    """The step is in another process, so that this one is free to end."""
    sign = tmp_path / "in the step"
    system = tmp_path / "system.toml"
    system.write_text(f"""
        [simulation]
        stop_time = 1.0
        initial_step_size = 0.1
        [slaves.source]
        model = "{MODELS}:Fragile"
        [slaves.sink]
        model = "{MODELS}:Fragile"
        state = "fork"
        parameters = {{ sign = "{sign}" }}
        [[connections]]
        from = "source.y"
        to = "sink.u"
        factor = 3.0
    """)
    words = ["run", system, "--in-process", "--quiet", "--no-plot", "--output", tmp_path / "r"]
    master = subprocess.Popen(
        [sys.executable, "-m", "master_node", *map(str, words)], stderr=subprocess.PIPE, text=True
    )
    try:
        wait_until(lambda: sign.exists() or master.poll() is not None)
        assert master.poll() is None, master.communicate()
        master.send_signal(signal.SIGINT)
        assert master.wait(BOUND) == 130
    finally:
        master.kill()
        master.communicate()


# ---- Refusals -----------------------------------------------------------------------------------


def refused(slave: Slave) -> str:
    """Why no state is saved; a second attempt says the same, and the slave can still step."""
    with pytest.raises(SlaveError) as first:
        slave.get_state()
    with pytest.raises(SlaveError) as second:
        slave.get_state()
    assert str(first.value) == str(second.value)
    assert 'state = "replay"' in str(first.value)
    slave.do_step(0.0, 1e-3, True)
    return str(first.value)


@pytest.mark.parametrize(
    ("fmu", "reason"),
    [
        ("starts_thread", "the model runs 1 more thread"),
        ("writes_file", r"the model writes to the file .*steps\.txt"),
    ],
)
def test_fmus_that_cannot_be_forked_are_refused_by_name(
    capability_dir: Path, fmu: str, reason: str
) -> None:
    """Before the first fork, with what they have and what to do."""
    with loaded(capability_dir / f"{fmu}.fmu", "", inputs=("u",), outputs=("y",)) as slave:
        assert slave.description.state_kind is StateKind.FORK
        assert pytest.approx(1.0) == slave.get_outputs(0)[0, 0]
        assert re.search(reason, refused(slave))


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("socket", "holds a socket"),
        ("pipe", "holds a device or a pipe"),
        ("terminal", "holds a device or a pipe"),
    ],
)
def test_models_with_connections_to_elsewhere_are_refused(what: str, reason: str) -> None:
    """A copy would use the same connection."""
    with loaded(f"{MODELS}:Holder", "fork", inputs=("u",), outputs=("y",), what=what) as slave:
        slave.set_inputs(ONE)
        assert reason in refused(slave)


def test_a_model_that_cannot_be_loaded_says_so_from_its_process(tmp_path: Path) -> None:
    """The error of the other process is the error of the loading."""
    (tmp_path / "broken.py").write_text("from slave_node.model import Model\nclass M(Model): x\n")
    with (
        pytest.raises(ModelError, match="broken"),
        loaded(f"{tmp_path / 'broken.py'}:M", "fork"),
    ):
        pass


def test_serialization_is_refused(fmu_dir: Path) -> None:
    """A process is no bytes."""
    with wheel(fmu_dir, "fork") as slave:
        state = slave.get_state()
        with pytest.raises(SlaveError, match="not bytes"):
            slave.serialize_state(state)
        with pytest.raises(SlaveError, match="not bytes"):
            slave.deserialize_state(b"")
        slave.free_state(state)
        for use in (slave.set_state, slave.set_state_and_free, slave.free_state):
            with pytest.raises(SlaveError, match="no such state"):
                _use(use, state)


def _use(call: Callable[[object], None], state: object) -> None:
    call(state)
