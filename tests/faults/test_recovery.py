"""Slaves that are lost in mid run come back, and the run goes on to the same bits.

Real processes meet real signals, at times that were drawn once and for all. What is compared are
the files of the same run without an accident, byte for byte.
"""

from __future__ import annotations

import logging
import random
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from master_node import System, load_system, simulate
from master_node.slaves.call_log import CallLog, LoggedStep
from master_node.slaves.link import LocalSlave, SlaveLink
from master_node.slaves.restorable import RestorableSlave
from protocol.calls import (
    Call,
    DeserializeState,
    DoStep,
    ExitInitializationMode,
    GetOutputs,
    GetState,
    Initialize,
    Reply,
    SerializeState,
    SetInputs,
    SetState,
)
from protocol.errors import (
    DeadlineError,
    DoublestepError,
    SlaveCrashedError,
    SlaveError,
    SlaveLostError,
)
from slave_node.loading import load_executor
from tests.faults.test_processes import Start, endpoints, start, system_file, worker_of
from tests.support.places import SUPPORT
from tests.support.quarter_car_case import EXAMPLES
from tests.support.slow import quick_at

__all__ = ["start"]

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="uses signals and /proc"),
    pytest.mark.usefixtures("no_process_left"),
]

TRAPPED = f"{SUPPORT / 'trap_models.py'}:Trapped"
SMALL_STEPS = "stop_time = 0.4\nlargest_step_size = 1e-3\n"
"""More than a hundred double steps: states are saved on the way."""

FEW_STEPS = "stop_time = 0.06\nlargest_step_size = 1e-3\n"


def car(folder: Path, simulation: str = SMALL_STEPS, bus: str = "", **traps: Any) -> System:
    """The quarter car with a chassis that has ``traps``."""
    folder.mkdir(parents=True, exist_ok=True)
    parameters = {"folder": folder, **traps}
    file = system_file(
        folder, TRAPPED, simulation=simulation, bus=bus, chassis_parameters=parameters
    )
    return load_system(file)


def files(system: System, folder: Path, **options: Any) -> tuple[bytes, bytes]:
    """Results and steps of a run."""
    simulate(system, output=folder / "out", **options)
    return (
        (folder / "out" / "results.csv").read_bytes(),
        (folder / "out" / "steps.csv").read_bytes(),
    )


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Warnings that the user got."""
    return [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]


def drawn_traps(number: int, seed: int) -> str:
    """Kills at times that were drawn from as many parts of the run, of node and worker in turn."""
    draw, part = random.Random(seed), 0.4 / number
    times = [(i + draw.random()) * part for i in range(number)]
    return ", ".join(
        f"{time:.4f} kill {'worker' if i % 2 else 'node'}" for i, time in enumerate(times)
    )


# ---- Processes that are killed ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seed", "settings"),
    [
        (1, 'estimator = "mod"\n'),
        pytest.param(2, 'estimator = "rich"\nsequence = "gauss-seidel"\n', marks=pytest.mark.slow),
        pytest.param(3, 'estimator = "none"\n', marks=pytest.mark.slow),
    ],
)
def test_killed_slaves_come_back(
    seed: int, settings: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """SIGKILL of worker and node in mid step, twice: the same files, and one warning each."""
    simulation = SMALL_STEPS + settings
    traps = drawn_traps(2, seed)
    undisturbed = files(car(tmp_path / "a", simulation), tmp_path / "a", in_process=True)
    caplog.clear()
    assert files(car(tmp_path / "b", simulation, traps=traps), tmp_path / "b") == undisturbed
    told = warnings(caplog)
    assert len(told) == 2
    for text in told:
        assert re.match(r"chassis: do_step at t=\S+ s, H=\S+ s: .* (SIGKILL|signal 9)", text)
        assert re.search(r"; started again and restored in \d+\.\d s: the run goes on$", text)


@pytest.mark.slow
def test_killed_holders_come_back(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A model in a process that forks is killed in mid step: no rejected step, the same files."""
    simulation = FEW_STEPS + 'estimator = "mod"\n'
    system = car(tmp_path / "b", simulation, traps="0.02 kill worker, 0.04 kill worker")
    chassis = system.slaves["chassis"].model_copy(update={"state": "fork"})
    forking = system.model_copy(update={"slaves": {**system.slaves, "chassis": chassis}})
    undisturbed = files(car(tmp_path / "a", simulation), tmp_path / "a", in_process=True)
    caplog.clear()
    assert files(forking, tmp_path / "b") == undisturbed
    told = warnings(caplog)
    assert len(told) == 2
    for text in told:
        assert re.match(r"chassis: do_step at t=\S+ s, H=\S+ s: .* SIGKILL; started again", text)


def test_killed_fmus_come_back_from_their_saved_states(
    tmp_path: Path, fmu_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The other slave is an FMU, and killed from outside at any time: the same files."""
    simulation = SMALL_STEPS + 'estimator = "rich"\n'

    class Killer:
        """Kills the FMU's worker after some attempts."""

        def __init__(self, numbers: Sequence[int]) -> None:
            self.numbers, self.number = set(numbers), 0

        def started(self, _: object) -> None:
            pass

        def attempted(self, _: object) -> None:
            self.number += 1
            if self.number in self.numbers:
                worker_of(node_of("wheel")).kill()

        def ended(self, _: object) -> None:
            pass

    (tmp_path / "a").mkdir()
    system = load_system(
        system_file(
            tmp_path / "a", fmu_dir / "chassis.fmu", fmu_dir / "wheel.fmu", simulation=simulation
        )
    )
    undisturbed = files(system, tmp_path / "a", in_process=True)
    caplog.clear()
    killer = Killer([7, 150])
    assert files(system, tmp_path / "b", observers=(killer,)) == undisturbed
    assert len(warnings(caplog)) == 2


class HolderKiller:
    """Kills the processes that hold the states of the wheel, all but the keeper, now and then."""

    def __init__(self, seed: int) -> None:
        self.draw, self.number, self.kills = random.Random(seed), 0, 0

    def started(self, _: object) -> None:
        pass

    def attempted(self, _: object) -> None:
        self.number += 1
        if self.number % 40 == 0:
            worker = worker_of(node_of("wheel"))
            keepers = [p for p in worker.children() if p.children()]
            holders = [p for keeper in keepers for p in keeper.children(recursive=True)]
            self.kills += len(holders) > 1
            self.draw.choice(holders).kill()

    def ended(self, _: object) -> None:
        pass


@pytest.mark.parametrize(
    ("seed", "estimator"), quick_at([(1, "mod")], [(1, "mod"), (2, "rich"), (3, "mod")])
)
def test_killed_saved_states_change_nothing(
    seed: int, estimator: str, tmp_path: Path, fmu_dir: Path
) -> None:
    """Kills as of a kernel out of memory: the same files, whichever process they meet.

    Most of them have not been asked for anything yet when they are killed.
    """
    simulation = f'{SMALL_STEPS}estimator = "{estimator}"\n'
    (tmp_path / "a").mkdir()
    file = system_file(
        tmp_path / "a", fmu_dir / "chassis.fmu", fmu_dir / "wheel.fmu", simulation=simulation
    )
    undisturbed = files(load_system(file), tmp_path / "a", in_process=True)
    file.write_text(file.read_text().replace("[slaves.wheel]", '[slaves.wheel]\nstate = "fork"'))
    killer = HolderKiller(seed)
    assert files(load_system(file), tmp_path / "b", observers=(killer,)) == undisturbed
    assert killer.kills >= 2


def node_of(name: str) -> psutil.Process:
    """The node that this process launched for a slave."""
    for child in psutil.Process().children():
        words = child.cmdline()
        if "slave_node" in words and name in words:
            return child
    raise AssertionError(f"no node of {name}")


def test_a_worker_of_a_slave_that_was_started_by_hand(start: Start, tmp_path: Path) -> None:
    """Its node still answers and starts another worker; the run goes on to the same bits."""
    (endpoint,) = endpoints(1)
    system = car(tmp_path, traps="0.1 kill worker")
    parameters = system.slaves["chassis"].parameters
    words = [f"{name}={value}" for name, value in parameters.items()]
    assert words[0].startswith("folder=")
    slave = start(
        *("slave_node", "serve", TRAPPED, "--name", "chassis", "--connect", endpoint),
    )
    result = system.with_bus(listen=(endpoint,))
    found = result.model_copy(
        update={
            "slaves": {
                **result.slaves,
                "chassis": result.slaves["chassis"].model_copy(update={"model": None}),
            }
        }
    )
    undisturbed = files(car(tmp_path / "a"), tmp_path / "a", in_process=True)
    assert files(found, tmp_path / "b") == undisturbed
    slave.wait_for("died by SIGKILL")
    slave.wait_for("released by")


def test_a_slave_that_is_killed_again_and_again(tmp_path: Path) -> None:
    """After three times the run ends: exit code 3 with slave, t and H, and the results are kept."""
    system = car(tmp_path, always=0.1, what="kill worker")
    with pytest.raises(SlaveCrashedError) as info:
        simulate(system, output=tmp_path / "out")
    assert info.value.exit_code == 3
    assert re.match(r"chassis: do_step at t=0\.09\S+ s, H=0.001 s: .* SIGKILL", str(info.value))
    rows = (tmp_path / "out" / "results.csv").read_text().splitlines()
    last = float(rows[-1].split(",")[0])
    assert 0.097 < last <= info.value.time


MORTAL = """
import os, signal, time
from pathlib import Path
from slave_node.python.loading import load_model_class
folder = Path(__file__).parent
(folder / f"node {{os.getppid()}}").touch()
if len(list(folder.glob("node *"))) in {deadly}:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60.0)
Trapped = load_model_class({model!r}, folder)
"""
"""A model that kills its node where that is one of certain numbers to load it."""


def mortal(folder: Path, deadly: set[int]) -> System:
    """The quarter car with a chassis that is lost once, and again while it is started again."""
    folder.mkdir()
    (folder / "mortal.py").write_text(MORTAL.format(deadly=deadly, model=TRAPPED))
    file = system_file(
        folder,
        f"{folder / 'mortal.py'}:Trapped",
        simulation=FEW_STEPS,
        chassis_parameters={"folder": folder, "traps": "0.03 kill node"},
    )
    return load_system(file)


def test_a_slave_that_is_killed_while_it_is_started_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Twice in one recovery: neither this slave nor a healthy one is given up for that."""
    undisturbed = files(car(tmp_path / "a", FEW_STEPS), tmp_path / "a", in_process=True)
    caplog.clear()
    assert files(mortal(tmp_path / "b", {2, 3}), tmp_path / "b") == undisturbed
    (told,) = warnings(caplog)
    assert re.match(r"chassis: do_step at .* signal 9.*; started again and restored", told)
    assert len(list((tmp_path / "b").glob("node *"))) == 4


def test_a_slave_that_is_killed_whenever_it_is_started_again(tmp_path: Path) -> None:
    """Three times, then exit code 3 with slave, t, H and cause."""
    with pytest.raises(SlaveLostError, match=r"^chassis: do_step at t=0\.0\S+ s, H=") as info:
        simulate(mortal(tmp_path / "b", {2, 3, 4, 5, 6}), output=tmp_path / "out")
    assert "it could not be started again and restored: its process died by signal 9" in str(
        info.value
    )
    assert len(list((tmp_path / "b").glob("node *"))) == 4


@pytest.mark.parametrize("what", quick_at(["kill node"], ["kill worker", "kill node"]))
def test_a_slave_that_is_lost_in_its_initialization(
    what: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It was ready, and its worker or its node is killed before T_0: started again, once."""
    undisturbed = files(car(tmp_path / "a", FEW_STEPS), tmp_path / "a", in_process=True)
    caplog.clear()
    system = car(tmp_path / "b", FEW_STEPS, traps=f"-1.0 {what}")
    assert files(system, tmp_path / "b") == undisturbed
    (told,) = warnings(caplog)
    assert re.match(r"chassis: .* (SIGKILL|signal 9).*; started again and restored", told), told


def test_a_slave_that_dies_in_every_initialization(tmp_path: Path) -> None:
    """Exit code 4 at once, with slave, call and signal: no smaller step could help."""
    system = car(tmp_path, FEW_STEPS, always=-2.0, what="crash")
    with pytest.raises(SlaveCrashedError, match=r"^chassis: .*initialize.* SIGSEGV") as info:
        simulate(system, output=tmp_path / "out")
    assert info.value.exit_code == 4


def test_without_recovery_it_ends_the_run(tmp_path: Path) -> None:
    """``recovery = "off"``: exit code 3 at the first time."""
    system = car(tmp_path, SMALL_STEPS + 'recovery = "off"\n', traps="0.1 kill node")
    with pytest.raises(SlaveLostError, match=r"^chassis: do_step at t=0\.09\S+ s, H=0\.001 s: "):
        simulate(system)


# ---- Models that end their process --------------------------------------------------------------


@pytest.mark.parametrize(
    ("traps", "words"),
    [
        ("0.03 crash", "died by SIGSEGV"),
        pytest.param("0.03 abort", "died by SIGABRT", marks=pytest.mark.slow),
        ("0.03 hang, 0.03 hang", "no reply within 2 s"),
    ],
)
def test_a_crash_is_a_rejected_step(
    traps: str, words: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """SIGSEGV, SIGABRT, or twice without an end: from the snapshot it is tried smaller.

    The results are those of the same model that returns an error in the same step, bit for bit.
    """
    refused, _ = files(
        car(tmp_path / "a", FEW_STEPS, traps="0.03 refuse"), tmp_path / "a", in_process=True
    )
    caplog.clear()
    bus = "step_timeout = 2.0\n" if "hang" in traps else ""
    system = car(tmp_path / "b", FEW_STEPS, bus, traps=traps)
    results, steps = files(system, tmp_path / "b")
    assert results == refused
    told = warnings(caplog)
    assert len(told) == traps.count("0.03")
    assert all(words in text for text in told)
    (rejected,) = [row for row in steps.decode().splitlines() if "false" in row]
    assert words in rejected


@pytest.mark.parametrize("estimator", ["mod", "none"])
def test_a_step_that_once_did_not_end_is_repeated_as_it_was(
    estimator: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A host that stood still is not the model's doing: the files of an undisturbed run."""
    simulation = FEW_STEPS + f'estimator = "{estimator}"\n'
    undisturbed = files(car(tmp_path / "a", simulation), tmp_path / "a", in_process=True)
    caplog.clear()
    system = car(tmp_path / "b", simulation, "step_timeout = 2.0\n", traps="0.03 hang")
    assert files(system, tmp_path / "b") == undisturbed
    (told,) = warnings(caplog)
    assert "no reply within 2 s; started again and restored" in told


def test_a_model_that_crashes_always(tmp_path: Path) -> None:
    """At the smallest step size: exit code 4 with the signal's name."""
    simulation = SMALL_STEPS + "smallest_step_size = 5e-4\n"
    with pytest.raises(SlaveCrashedError, match=r"H=0\.0005 s: .*SIGSEGV") as info:
        simulate(car(tmp_path, simulation, always=0.1, what="crash"))
    assert (info.value.exit_code, info.value.slave) == (4, "chassis")


@pytest.mark.slow
def test_a_model_that_hangs_always(tmp_path: Path) -> None:
    """Repeated once as it was and once smaller, then exit code 5; no process is left."""
    simulation = SMALL_STEPS + "smallest_step_size = 5e-4\n"
    system = car(tmp_path, simulation, "step_timeout = 1.0\n", always=0.0981, what="hang")
    with pytest.raises(DeadlineError) as info:
        simulate(system, output=tmp_path / "out")
    assert (info.value.exit_code, info.value.slave) == (5, "chassis")
    steps = (tmp_path / "out" / "steps.csv").read_text().splitlines()
    assert len([row for row in steps if "no reply" in row]) == 1


@pytest.mark.parametrize(("what", "code"), [("crash", 4), ("hang", 5)])
def test_without_an_estimator_nothing_is_repeated(what: str, code: int, tmp_path: Path) -> None:
    """A fixed step cannot be made smaller: the run ends with what happened."""
    simulation = "stop_time = 0.4\nestimator = 'none'\n"
    system = car(tmp_path, simulation, "step_timeout = 2.0\n", always=0.1, what=what)
    with pytest.raises(DoublestepError, match=r"^chassis: do_step at t=0\.\S+ s, H=") as info:
        simulate(system)
    assert info.value.exit_code == code


# ---- The log of calls ---------------------------------------------------------------------------


def wheel(scratch: Path) -> SlaveLink:
    """A fresh slave."""
    scratch.mkdir(parents=True, exist_ok=True)
    return LocalSlave(load_executor("quarter_car.py:Wheel", EXAMPLES, "wheel", scratch))


def told(link: SlaveLink, *calls: Call) -> Reply:
    """Reply of a slave to ``calls``."""
    link.start(calls)
    return link.finish()


def executed(link: SlaveLink, *calls: Call) -> list[object]:
    """Results of calls that must succeed."""
    reply = told(link, *calls)
    assert reply.error is None
    return reply.results


BEGINNING = (
    Initialize(inputs=("x_c", "v_c"), outputs=("x", "v")),
    ExitInitializationMode(),
)


def drawn_step(draw: random.Random, time: float, h: float) -> tuple[Call, ...]:
    """Set inputs, step, read."""
    u = np.array([[draw.uniform(-1, 1), draw.uniform(-1, 1)] for _ in range(3)])
    return (SetInputs(u), DoStep(time, h, True), GetOutputs(1))


@pytest.mark.parametrize("seed", quick_at([0, 1], range(8)))
def test_the_log_makes_the_same_slave(seed: int, tmp_path: Path) -> None:
    """Law: whatever was tried and taken back, the log leads a fresh slave to the same bits.

    Double steps with rejections, comparison solutions and saved states, as estimators make them,
    are broken off anywhere; as bytes the log says the same.
    """
    draw = random.Random(seed)
    link, log, time, h = wheel(tmp_path / "a"), CallLog(is_compact=bool(seed % 2)), 0.0, 1e-3

    def run(*calls: Call) -> None:
        log.note(calls, executed(link, *calls))

    run(*BEGINNING)
    for number in range(12):
        middle = time + h
        run(GetState(0), *drawn_step(draw, time, h))
        while draw.random() < 0.4:
            run(SetState(0), *drawn_step(draw, time, h))
        run(GetState(1), *drawn_step(draw, middle, h))
        if draw.random() < 0.7:
            run(SetState(1), *drawn_step(draw, middle, h))
        if number == 11:
            break
        log.settle()
        time = middle + h
        if number == 5:
            run(GetState(2))
            (data,) = executed(link, SerializeState(2))
            assert isinstance(data, bytes)
            log.save(data)
    assert log.number == 11
    assert log.state is not None
    for use_state in (True, False):
        fresh = wheel(tmp_path / f"fresh {use_state}")
        executed(fresh, *log.beginning)
        begin = 0
        if use_state:
            begin = log.state.number
            executed(fresh, DeserializeState(9, log.state.data), SetState(9))
        for step in (*log.steps(begin), log.present):
            again = LoggedStep.from_bytes(step.to_bytes())
            assert again.digest == step.digest
            assert len(again.calls) == len(step.calls)
            executed(fresh, *again.calls)
        for state, begin in enumerate((time, time + h)):
            calls = (SetState(state), *drawn_step(random.Random(99), begin, h))
            expected, found = executed(link, *calls)[-1], executed(fresh, *calls)[-1]
            assert isinstance(expected, np.ndarray)
            assert isinstance(found, np.ndarray)
            assert found.tobytes() == expected.tobytes()


def test_what_was_taken_back_is_not_kept(tmp_path: Path) -> None:
    """A thousand rejections leave no trace: memory grows with accepted steps alone."""
    link, log = wheel(tmp_path), CallLog()
    log.note(BEGINNING, executed(link, *BEGINNING))
    calls: tuple[Call, ...] = (GetState(0), *drawn_step(random.Random(0), 0.0, 1e-3))
    for _ in range(1000):
        log.note(calls, executed(link, *calls))
        calls = (SetState(0), *drawn_step(random.Random(0), 0.0, 1e-3))
    assert len(log.present.calls) == 5


class Forgetful:
    """A link to a slave whose states lose something when they are serialised."""

    def __init__(self, link: SlaveLink) -> None:
        self.link = link

    def start(self, calls: Sequence[Call]) -> None:
        """Makes another state out of the bytes."""
        if type(calls[0]) is DeserializeState:
            calls = (GetState(calls[0].state), *calls[1:])
        self.link.start(calls)

    def finish(self) -> Reply:
        """Handed on to the link."""
        return self.link.finish()


class Mortal:
    """A link that is lost when it is told."""

    def __init__(self, link: SlaveLink) -> None:
        self.link = link
        self.is_dead = False

    def start(self, calls: Sequence[Call]) -> None:
        """Handed on to the link."""
        self.link.start(calls)

    def finish(self) -> Reply:
        """Handed on to the link, if it lives."""
        if self.is_dead:
            raise SlaveLostError("it died")
        return self.link.finish()


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[Any]:
    """Makes slaves."""
    numbers = iter(range(100))
    return (wheel(tmp_path / str(number)) for number in numbers)


@pytest.mark.parametrize("forgets", [False, True])
def test_a_saved_state_is_trusted_by_its_outputs(
    forgets: bool, fresh: Iterator[SlaveLink], caplog: pytest.LogCaptureFixture
) -> None:
    """States that lead to other outputs are not used: the steps from T_0 on are taken again."""
    first = Mortal(next(fresh))
    description = first.link._executor.description

    def restart() -> SlaveLink:
        return Forgetful(next(fresh)) if forgets else next(fresh)

    slave, twin = RestorableSlave("wheel", first, description, restart), next(fresh)
    draw, again, time = random.Random(5), random.Random(5), 0.0
    for link in (slave, twin):
        executed(link, *BEGINNING)
    for number in range(6):
        assert_equal(
            executed(slave, *drawn_step(draw, time, 1e-2)),
            executed(twin, *drawn_step(again, time, 1e-2)),
        )
        slave.settle()
        time += 1e-2
        if number == 2:
            slave.start_saving()
            slave.finish_saving()
    first.is_dead = True
    assert_equal(
        executed(slave, *drawn_step(draw, time, 1e-2)),
        executed(twin, *drawn_step(again, time, 1e-2)),
    )
    texts = warnings(caplog)
    assert ("cannot be used in another process" in texts[0]) == forgets
    assert "it died; started again and restored" in texts[-1]
    assert slave.restarts == 1 + forgets
    assert slave.can_serialize != forgets


def assert_equal(a: list[object], b: list[object]) -> None:
    """Asserts that two replies end in equal outputs, bit for bit."""
    assert isinstance(a[-1], np.ndarray)
    assert isinstance(b[-1], np.ndarray)
    assert a[-1].tobytes() == b[-1].tobytes()


def test_another_model_is_not_taken(fresh: Iterator[SlaveLink], tmp_path: Path) -> None:
    """A file that has changed since the run began would go on to other results: refused."""
    first = Mortal(next(fresh))

    def restart() -> SlaveLink:
        (tmp_path / "other").mkdir()
        return LocalSlave(load_executor(TRAPPED, EXAMPLES, "wheel", tmp_path / "other"))

    slave = RestorableSlave("wheel", first, first.link._executor.description, restart)
    executed(slave, *BEGINNING)
    first.is_dead = True
    slave.start(drawn_step(random.Random(0), 0.0, 1e-2))
    with pytest.raises(SlaveLostError, match=r"it died; it could not be started again .* changed"):
        slave.finish()


def test_the_loss_of_another_slave_is_not_its_own(fresh: Iterator[SlaveLink]) -> None:
    """A slave is not started again when the run ends because of another slave."""

    class Abandoned(Mortal):
        def finish(self) -> Reply:
            raise SlaveLostError("it died", slave="chassis")

    first = Abandoned(next(fresh))
    description = first.link._executor.description
    slave = RestorableSlave("wheel", first, description, lambda: next(fresh))
    slave.start(BEGINNING)
    with pytest.raises(SlaveLostError, match=r"^chassis: it died"):
        slave.finish()
    assert slave.restarts == 0


@pytest.mark.parametrize("failures", [0, 2, 3])
@pytest.mark.parametrize("kind", [SlaveLostError, DeadlineError])
def test_a_slave_is_given_up_when_it_is_given_up(
    failures: int, kind: type[DoublestepError], fresh: Iterator[SlaveLink]
) -> None:
    """Other slaves hear of it after the third failure, once, and never before."""
    attempts, given_up = [], []

    def restart() -> SlaveLink:
        attempts.append(len(attempts))
        if len(attempts) <= failures:
            raise kind("not now")
        return next(fresh)

    first = Mortal(next(fresh))
    description = first.link._executor.description
    slave = RestorableSlave("wheel", first, description, restart, given_up.append)
    executed(slave, *BEGINNING)
    first.is_dead = True
    slave.start(drawn_step(random.Random(0), 0.0, 1e-2))
    if failures < 3:
        assert slave.finish().error is None
        assert not given_up
    else:
        with pytest.raises(SlaveLostError, match="it died; it could not be started again"):
            slave.finish()
        assert given_up == ["it died; it could not be started again and restored: not now"]
    assert len(attempts) == min(failures + 1, 3)


class Dying(Mortal):
    """A link to a slave that answers with an error when its state is serialised."""

    def __init__(self, link: SlaveLink, error: DoublestepError) -> None:
        super().__init__(link)
        self.error = error
        self.is_saving = False

    def start(self, calls: Sequence[Call]) -> None:
        """Handed on to the link, unless the slave dies of that."""
        self.is_saving = any(type(call) is SerializeState for call in calls)
        self.is_dead = self.is_dead or self.is_saving
        if not self.is_dead:
            super().start(calls)

    def finish(self) -> Reply:
        """The error, then nothing."""
        return Reply([], self.error, 0.0) if self.is_saving else super().finish()


def test_a_model_that_crashes_while_its_state_is_serialised(fresh: Iterator[SlaveLink]) -> None:
    """It is restored, the next step is not rejected, and its state not asked for again."""
    first = Dying(next(fresh), SlaveCrashedError("died by SIGSEGV"))
    twin, restarts = next(fresh), []

    def restart() -> SlaveLink:
        restarts.append(1)
        return next(fresh)

    description = first.link._executor.description
    slave = RestorableSlave("wheel", first, description, restart)
    draw, again = random.Random(5), random.Random(5)
    for link in (slave, twin):
        executed(link, *BEGINNING)
    for time in (0.0, 1e-2):
        assert_equal(
            executed(slave, *drawn_step(draw, time, 1e-2)),
            executed(twin, *drawn_step(again, time, 1e-2)),
        )
        slave.settle()
        if not time:
            slave.start_saving()
            slave.finish_saving()
    assert len(restarts) == 1
    assert not slave.can_serialize


def test_a_broken_state_of_a_slave_that_cannot_be_started_again(
    fresh: Iterator[SlaveLink],
) -> None:
    """To resume is to say so where the bits would not be the same."""
    link = next(fresh)
    slave = RestorableSlave("wheel", link, link._executor.description, None)
    executed(slave, *BEGINNING)
    steps = [LoggedStep(drawn_step(random.Random(1), 0.0, 1e-2), b"12345678")]
    with pytest.raises(SlaveError, match="cannot be brought to where the run was interrupted"):
        slave.resume(None, 0, steps)
