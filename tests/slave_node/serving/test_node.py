"""Promises of a slave on the bus to its masters, with a real worker process behind it."""

from __future__ import annotations

import os
import re
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import psutil
import pytest

from master_node.hosts.opening import describe
from master_node.slaves.remote import RemoteSlave
from master_node.slaves.request_bounds import RequestBounds
from master_node.slaves.restorable import RestorableSlave
from protocol.bus.bus import Bus, InProcessBus
from protocol.bus.endpoints import Endpoints
from protocol.bus.zenoh import ZenohBus
from protocol.calls import (
    Call,
    Describe,
    DoStep,
    ExitInitializationMode,
    GetOutputs,
    Initialize,
    Reply,
    Reset,
)
from protocol.description import SlaveDescription
from protocol.errors import (
    ConfigurationError,
    DoublestepError,
    FatalSlaveError,
    MalformedMessageError,
    ModelError,
    SequenceError,
    SlaveBusyError,
    SlaveCrashedError,
    SlaveKilledError,
    SlaveLostError,
    VersionError,
)
from protocol.host.processes import has_ended
from protocol.wire.administration import MAX_ORPHAN_TIME, Claim
from protocol.wire.keys import (
    ABORT,
    CLAIM,
    EXECUTE,
    RELEASE,
    STATUS,
    SlaveKey,
    alive_master,
    alive_slaves,
)
from protocol.wire.packing import PROTOCOL_VERSION
from protocol.wire.programs import encode_program, encode_request
from protocol.wire.records import decode_map, encode_map
from protocol.wire.replies import decode_reply
from slave_node.serving.node import SlaveNode
from slave_node.worker.process import ModelReference, WorkerProcess
from tests.support.waiting import BOUND, is_quick, wait_until

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses named pipes and signals"),
    pytest.mark.usefixtures("no_process_left"),
]


KEY = SlaveKey("slave", "0123abcd")

MODELS = '''
import os
import sys
from protocol.errors import FatalSlaveError
from protocol.variables import Variable, VariableType
from slave_node.model import Model, real

class Integrator(Model):
    states = (real("x"),)
    outputs = states
    parameters = (real("rate", start=1.0),)

    def derivatives(self, t, x, u):
        return [self.rate]

class Late(Integrator):
    """Does something strange from t = 1 s on."""

    parameters = (*Integrator.parameters, Variable("what", type=VariableType.STRING, start=""))

    def derivatives(self, t, x, u):
        if t >= 1.0:
            getattr(self, self.what)()
        return [self.rate]

    def abort(self):
        os.abort()

    def leave(self):
        sys.exit(7)

    def fatal(self):
        raise FatalSlaveError("broken for good")

class Slow(Integrator):
    """Says through a pipe that it is in a step, and waits for another one: for ever, if need be."""

    parameters = (
        *Integrator.parameters,
        Variable("begun", type=VariableType.STRING, start=""),
        Variable("go", type=VariableType.STRING, start=""),
    )
    said = False

    def derivatives(self, t, x, u):
        if not self.said:
            self.said = True
            with open(self.begun, "w") as pipe:
                pipe.write("x")
            with open(self.go) as pipe:
                pipe.read()
        return [self.rate]
'''


HELPED = """
import os
import signal
import time
from pathlib import Path
from slave_node.model import Model, real

child = os.fork()
if child:
    Path(__file__).with_name("helper").write_text(str(child))
else:
    time.sleep(60.0)
    os._exit(0)

class Helped(Model):
    states = (real("x"),)
    outputs = states

    def derivatives(self, t, x, u):
        os.kill(os.getpid(), signal.SIGSEGV)
"""


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with models."""
    path = tmp_path_factory.mktemp("models") / "models.py"
    path.write_text(MODELS)
    return path


class Pipe:
    """A named pipe by which a model in another process says one thing or waits for it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        os.mkfifo(path)
        self._reading = os.open(path, os.O_RDONLY | os.O_NONBLOCK)

    def wait(self) -> None:
        """Until the model has said it."""
        ready, _, _ = select.select([self._reading], [], [], BOUND)
        assert ready

    def open(self) -> None:
        """Let the model go on."""
        os.close(os.open(self.path, os.O_WRONLY | os.O_NONBLOCK))

    def close(self) -> None:
        """Free it."""
        os.close(self._reading)


@pytest.fixture
def begun(tmp_path: Path) -> Iterator[Pipe]:
    """Pipe into which a `Slow` model writes when it is in a step."""
    pipe = Pipe(tmp_path / "begun")
    yield pipe
    pipe.close()


@pytest.fixture
def go(tmp_path: Path) -> Path:
    """Pipe that a `Slow` model waits for until the test writes to it."""
    path = tmp_path / "go"
    os.mkfifo(path)
    return path


@dataclass
class Master:
    """Claims a slave and numbers its requests."""

    bus: Bus
    run: str = "run-1"
    pid: int = field(default_factory=os.getpid)
    host: str = field(default_factory=socket.gethostname)
    orphan_time: float | None = None
    epoch: int = 0
    sequence: int = 0

    def ask(self, verb: str, payload: bytes = b"") -> bytes:
        """One request to the slave."""
        return self.bus.caller(KEY.verb(verb), BOUND).request(payload)

    def claim(self) -> Master:
        """Hold the slave."""
        claim = Claim(self.run, self.host, self.pid, self.orphan_time).to_message()
        epoch = decode_map(self.ask(CLAIM, encode_map(claim)))["epoch"]
        assert isinstance(epoch, int)
        self.epoch, self.sequence = epoch, 0
        return self

    def execute(self, *calls: Call) -> Reply:
        """The next request."""
        self.sequence += 1
        return self.again(calls)

    def again(self, calls: Sequence[Call]) -> Reply:
        """Reply to the last request, sent once more."""
        request = encode_request(self.epoch, self.sequence, encode_program(calls))
        return decode_reply(calls, self.ask(EXECUTE, request))

    def start(self, **start_values: Any) -> Master:
        """Bring the slave to its first communication point, t = 0."""
        reply = self.execute(
            Initialize(start_values=start_values, outputs=("x",)), ExitInitializationMode()
        )
        assert reply.error is None
        return self

    def release(self) -> None:
        """Give the slave back."""
        decode_map(self.ask(RELEASE, encode_map({"epoch": self.epoch})))

    def status(self) -> dict[str, Any]:
        """Status of the slave."""
        return dict(decode_map(self.ask(STATUS)))


def value(reply: Reply) -> float:
    """The only output in the last result."""
    assert reply.error is None
    return float(reply.results[-1][0, 0])  # type: ignore[index]


@dataclass
class Served:
    """A slave on a bus, seen from the other side."""

    bus: Bus
    worker: WorkerProcess
    make_bus: Callable[[], Bus]

    def master(self, run: str = "run-1", **place: Any) -> Master:
        """A master that has not claimed anything."""
        return Master(self.bus, run, **place)


Serve = Callable[..., Served]

# What does not depend on the bus is tested over one of them.
in_process = pytest.mark.parametrize("serve", ["in process"], indirect=True)
over_zenoh = pytest.mark.parametrize("serve", ["zenoh"], indirect=True)


@pytest.fixture(params=["in process", "zenoh"])
def serve(request: pytest.FixtureRequest, models: Path, endpoint: str) -> Iterator[Serve]:
    """``serve(model)`` puts a slave on both kinds of bus and waits until it is alive."""
    buses: list[Bus] = []
    workers: list[WorkerProcess] = []
    threads: list[threading.Thread] = []
    shared = InProcessBus()

    def make_bus(*, listen: bool = False) -> Bus:
        if request.param == "in process":
            return shared
        where = {"listen" if listen else "connect": (endpoint,)}
        buses.append(ZenohBus(Endpoints(**where)))
        return buses[-1]

    def make(
        model: str = "Integrator",
        orphan_time: float = 5.0,
        parameters: dict[str, Any] | None = None,
    ) -> Served:
        worker = WorkerProcess(
            ModelReference(f"{models}:{model}", Path(), KEY.name, parameters or {})
        )
        workers.append(worker)
        description = worker.start()
        node_bus, bus = make_bus(listen=True), make_bus()  # the node sees each of its masters
        node = SlaveNode(node_bus, worker, KEY, description, orphan_time)
        alive = threading.Event()
        bus.watch(KEY.alive, lambda _, up: alive.set() if up else None)
        threads.append(threading.Thread(target=node.serve))
        threads[-1].start()
        assert alive.wait(BOUND)
        return Served(bus, worker, make_bus)

    yield make
    for bus in (shared, *buses):
        bus.close()
    for worker in workers:
        worker.kill()
    for thread in threads:
        thread.join(BOUND)
        assert not thread.is_alive()
    for worker in workers:
        worker.stop()


@pytest.fixture
def background() -> Iterator[Callable[[Callable[[], object]], list[object]]]:
    """Runs something beside the test and collects its result; all have ended after the test."""
    threads: list[threading.Thread] = []

    def run(action: Callable[[], object]) -> list[object]:
        outcome: list[object] = []

        def act() -> None:
            try:
                outcome.append(action())
            except DoublestepError as error:
                outcome.append(error)

        threads.append(threading.Thread(target=act))
        threads[-1].start()
        return outcome

    yield run
    for thread in threads:
        thread.join(BOUND)
        assert not thread.is_alive()


Background = Callable[[Callable[[], object]], list[object]]


# ---- Claim, execute, release -------------------------------------------------------------------


def test_a_slave_is_claimed_driven_and_given_back(serve: Serve) -> None:
    """The whole way; the next master finds the slave as good as new, under another epoch."""
    served = serve(parameters={"rate": 2.0})
    first = served.master().claim().start()
    assert value(first.execute(DoStep(0.0, 0.5), GetOutputs())) == pytest.approx(1.0)
    first.release()
    second = served.master("run-2").claim()
    assert second.epoch != first.epoch
    second.start(rate=3.0)
    assert value(second.execute(DoStep(0.0, 0.5), GetOutputs())) == pytest.approx(1.5)
    assert isinstance(second.execute(Describe()).results[0], SlaveDescription)

    # A repeated request gets the stored reply, and a late one of the first master nothing.
    step = [DoStep(0.5, 0.5), GetOutputs()]
    done = second.execute(*step)
    again = second.again(step)
    assert value(done) == value(again) == pytest.approx(3.0)
    assert done.compute_time == again.compute_time
    assert value(second.execute(GetOutputs())) == pytest.approx(3.0)
    late = first.execute(DoStep(0.5, 0.5))
    assert type(late.error) is SequenceError
    with pytest.raises(SequenceError):
        first.release()
    second.release()


def test_a_second_master_is_told_who_holds_the_slave(serve: Serve) -> None:
    """Busy, with run, host, process and time; the same run asking again changes nothing."""
    served = serve()
    first = served.master("run-1").claim().start()
    with pytest.raises(SlaveBusyError) as caught:
        served.master("run-2", pid=1).claim()
    text = str(caught.value)
    assert text.startswith(
        f"slave: claim: busy: held by run run-1 on {socket.gethostname()} (pid {os.getpid()})"
    )
    epoch = first.epoch
    again = served.master("run-1").claim()
    assert again.epoch == epoch
    assert value(first.execute(GetOutputs())) == 0.0
    assert first.status()["holder"] in text
    first.release()
    served.master("run-2").claim().release()


def by_hand(master: Master, verb: str, **values: Any) -> dict[str, Any]:
    """One verb, as any Zenoh client with a MessagePack library calls it."""
    answer = msgpack.unpackb(master.ask(verb, msgpack.packb(values) if values else b""))
    assert isinstance(answer, dict)
    return answer


def test_verbs_can_be_called_by_hand_while_nobody_holds_the_slave(serve: Serve) -> None:
    """Each on its own key, with a map of its fields; refused with the holder while it is held."""
    served = serve()
    master = served.master()
    assert by_hand(master, "describe")["result"]["model"] == "Integrator"
    assert by_hand(master, "initialize", outputs=["x"], start_values={"rate": 4}) == {
        "result": None
    }
    assert by_hand(master, "exit_initialization_mode") == {"result": None}
    step = {"communication_point": 0.0, "step_size": 0.25}
    assert by_hand(master, "do_step", **step) == {"result": ["ok", 0.25]}
    rows, data = by_hand(master, "get_outputs")["result"]
    assert (rows, memoryview(data).cast("d")[0]) == (1, pytest.approx(1.0))
    refused = by_hand(master, "initialize")
    assert refused["error"]["error"] == "LifeCycleError"
    assert by_hand(master, "do_step", step=1)["error"]["error"] == "MalformedMessageError"

    master.claim()
    busy = by_hand(served.master(), "do_step", **step)
    assert busy["error"]["error"] == "SlaveBusyError"
    assert "run-1" in busy["error"]["cause"]
    assert value(master.start().execute(GetOutputs())) == 0.0  # the claim began anew
    master.release()
    assert by_hand(master, "initialize") == {"result": None}


def test_malformed_messages_are_answered_and_nothing_else_happens(serve: Serve) -> None:
    """Whatever arrives on whatever key: an error in the form of that key, and the slave lives."""
    served = serve()
    master = served.master().claim().start()
    infinite = msgpack.packb({"version": PROTOCOL_VERSION, "run": "r", "host": "h", "pid": 1e999})
    for verb in (CLAIM, RELEASE, ABORT):
        for payload in (
            b"\xc1",
            b"\x91" * 5000,
            encode_map({}),
            encode_map({"epoch": "x", "run": "r", "host": "h", "pid": "x"}),
            encode_map({"epoch": 1e999, "run": "a/*/b", "host": "h", "pid": 1}),
            encode_map({"epoch": 2**62, "run": "", "host": "h", "pid": 1}),
            infinite,
        ):
            with pytest.raises((MalformedMessageError, SequenceError, ConfigurationError)):
                decode_map(master.ask(verb, payload))
    for payload, expected in (
        (b"\xc1", MalformedMessageError),
        (b"", MalformedMessageError),
        (msgpack.packb([PROTOCOL_VERSION + 1, 0, 0, b""]), VersionError),
        (encode_request(master.epoch, 7, b""), SequenceError),
        (encode_request(master.epoch + 1, 2, b""), SequenceError),
    ):
        assert type(decode_reply([], master.ask(EXECUTE, payload)).error) is expected
    for program in (b"", b"\xc1", b"\x90" * 3, encode_program([])):
        master.sequence += 1
        data = encode_request(master.epoch, master.sequence, program)
        error = decode_reply([], master.ask(EXECUTE, data)).error
        assert error is None or type(error) is MalformedMessageError
    assert value(master.execute(DoStep(0.0, 0.5), GetOutputs())) == pytest.approx(0.5)
    assert master.status()["worker"] == "alive"
    master.release()


def test_a_name_is_on_the_bus_only_once(serve: Serve) -> None:
    """A second slave of the same name is refused before it serves, and told who is there."""
    served = serve()
    with pytest.raises(
        ConfigurationError, match=r"named 'slave' is on the bus already: .*0123abcd"
    ):
        SlaveNode(
            served.make_bus(),
            served.worker,
            SlaveKey("slave", "another"),
            SlaveDescription("Model", "Python model", ()),
        ).serve()
    assert served.bus.alive(alive_slaves("slave"), BOUND) == [KEY.alive]


# ---- A worker that dies ------------------------------------------------------------------------


@over_zenoh
@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("abort", "the process that held the model died by SIGABRT"),
        ("leave", "the process that held the model ended with exit code 7"),
    ],
)
def test_a_crash_of_the_model_is_an_answer(serve: Serve, what: str, words: str) -> None:
    """It comes at once with the cause; the node goes on, and the next claim revives the slave."""
    served = serve("Late", parameters={"what": what})
    first = served.master().claim().start()
    old = served.worker.pid
    assert first.execute(DoStep(0.0, 0.5)).error is None
    begin = time.perf_counter()
    crashed = first.execute(DoStep(0.5, 1.0))
    assert is_quick(time.perf_counter() - begin, 2.0)
    assert type(crashed.error) is SlaveCrashedError
    assert words in str(crashed.error)
    assert type(first.execute(GetOutputs()).error) is SlaveKilledError
    assert first.status()["worker"] == "dead"
    first.release()

    second = served.master("run-2").claim().start()
    assert second.status()["worker"] == "alive"
    assert served.worker.pid not in (None, old)
    assert value(second.execute(DoStep(0.0, 0.5), GetOutputs())) == pytest.approx(0.5)
    second.release()


@in_process
def test_a_worker_that_died_unnoticed_is_revived_too(serve: Serve) -> None:
    """Killed from outside while nobody looked: neither a verb by hand nor a claim fails for it."""
    served = serve()
    master = served.master()
    for use in (lambda: master.claim().start().release(), lambda: by_hand(master, "describe")):
        old = served.worker.pid
        assert old is not None
        process = psutil.Process(old)
        process.kill()
        psutil.wait_procs([process], timeout=BOUND)
        use()
    master.claim().start().release()
    assert served.worker.pid not in (None, old)


@in_process
def test_a_fatal_slave_is_loaded_again_for_the_next_master(serve: Serve) -> None:
    """fmi2Fatal forbids every further call, a reset too, so the next claim gets a new process."""
    served = serve("Late", parameters={"what": "fatal"})
    first = served.master().claim().start()
    old = served.worker.pid
    assert type(first.execute(DoStep(0.0, 2.0)).error) is FatalSlaveError
    first.release()
    served.master("run-2").claim().start().release()
    assert served.worker.pid not in (None, old)


@in_process
def test_a_model_that_cannot_be_loaded_again_leaves_the_slave_free(
    serve: Serve, models: Path
) -> None:
    """A refused claim holds nothing: once the file is back, the next claim is granted."""
    served = serve()
    master = served.master()
    decode_map(master.ask(ABORT))
    hidden = models.rename(models.with_suffix(".hidden"))
    try:
        with pytest.raises(ModelError, match=r"slave: claim: no file .*models\.py"):
            master.claim()
        assert master.status()["state"] == "free"
    finally:
        hidden.rename(models)
    served.master("run-2").claim().start().release()


# ---- Long and endless steps --------------------------------------------------------------------


def test_status_is_answered_during_a_long_step(
    serve: Serve, background: Background, begun: Pipe, go: Path
) -> None:
    """A slave that computes is alive and says so; then the step ends as if nothing had been."""
    served = serve("Slow", parameters={"begun": str(begun.path), "go": str(go)})
    master = served.master().claim().start()
    assert not master.status()["busy"]
    outcome = background(lambda: master.execute(DoStep(0.0, 0.5), GetOutputs()))
    begun.wait()
    begin = time.perf_counter()
    status = master.status()
    assert is_quick(time.perf_counter() - begin, 0.5)
    assert status["busy"]
    assert status["state"] == "held"
    assert "run-1" in status["holder"]
    assert status["kind"] == "Python model"
    assert (status["name"], status["instance"]) == (KEY.name, KEY.instance)
    go.write_text("go")
    wait_until(lambda: bool(outcome))
    (reply,) = outcome
    assert isinstance(reply, Reply)
    assert value(reply) == pytest.approx(0.5)
    wait_until(lambda: not master.status()["busy"])
    master.release()


@over_zenoh
def test_abort_ends_an_endless_step(
    serve: Serve, background: Background, begun: Pipe, go: Path
) -> None:
    """The step's request is answered with the crash; an abort of another epoch ends nothing."""
    served = serve("Slow", parameters={"begun": str(begun.path), "go": str(go)})
    master = served.master().claim().start()
    outcome = background(lambda: master.execute(DoStep(0.0, 0.5)))
    begun.wait()
    with pytest.raises(SequenceError):
        decode_map(master.ask(ABORT, encode_map({"epoch": master.epoch + 1})))
    assert outcome == []
    begin = time.perf_counter()
    decode_map(master.ask(ABORT, encode_map({"epoch": master.epoch})))
    wait_until(lambda: bool(outcome))
    assert is_quick(time.perf_counter() - begin, 2.0)
    (reply,) = outcome
    assert isinstance(reply, Reply)
    assert type(reply.error) is SlaveKilledError
    assert "SIGKILL" in str(reply.error)
    assert master.status()["worker"] == "dead"
    master.release()
    served.master("run-2").claim().start().release()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it cannot be told")
@pytest.mark.parametrize("end", ["crash", "stop"])
@pytest.mark.slow
def test_what_a_model_has_started_ends_with_it(end: str, tmp_path: Path) -> None:
    """A program beside the model holds the worker's end of the pipe: the crash is seen all the
    same, with its signal, and the program does not outlive the worker.
    """
    file = tmp_path / "helped.py"
    file.write_text(HELPED)
    worker = WorkerProcess(ModelReference(f"{file}:Helped", tmp_path, "x"))
    worker.start()
    helper = int((tmp_path / "helper").read_text())
    assert not has_ended(socket.gethostname(), helper)
    if end == "crash":
        with pytest.raises(SlaveCrashedError, match="died by SIGSEGV"):
            worker.execute(
                encode_program(
                    [Initialize(outputs=("x",)), ExitInitializationMode(), DoStep(0.0, 0.1)]
                )
            )
    worker.stop()
    wait_until(lambda: has_ended(socket.gethostname(), helper))


# ---- Masters that vanish -----------------------------------------------------------------------


@pytest.fixture
def mortal() -> Iterator[subprocess.Popen[bytes]]:
    """A process for a master."""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    yield process
    process.kill()
    process.communicate()


def vanishing(served: Served, run: str, **place: Any) -> tuple[Master, Callable[[], None]]:
    """A master that holds the slave with its token up, and how to make it vanish."""
    bus, token = served.make_bus(), alive_master(run)
    reached = threading.Event()
    bus.watch(KEY.alive, lambda *_: reached.set())
    assert reached.wait(BOUND)
    bus.announce(token)
    master = Master(bus, run, **place).claim()
    if isinstance(bus, InProcessBus):
        return master, lambda: bus.withdraw(token)
    return master, bus.close


@over_zenoh
@pytest.mark.parametrize("dies", ["before its token goes", "after that"])
def test_a_slave_of_a_dead_master_is_free_at_once(
    serve: Serve, mortal: subprocess.Popen[bytes], dies: str
) -> None:
    """Same host, dead process: there is nothing to wait for; the old epoch is worth nothing."""
    served = serve(orphan_time=1000.0)
    master, vanish = vanishing(served, "run-1", pid=mortal.pid)
    master.start()
    other = served.master("run-2")
    for act in (mortal.kill, vanish) if dies == "before its token goes" else (vanish, mortal.kill):
        act()
    mortal.wait(BOUND)
    begin = time.perf_counter()
    wait_until(lambda: other.status()["state"] == "free")
    assert is_quick(time.perf_counter() - begin, 2.0)
    late = Master(served.bus, "run-1", epoch=master.epoch, sequence=master.sequence)
    assert type(late.execute(GetOutputs()).error) is SequenceError
    other.claim().start().release()


@in_process
def test_a_master_that_may_live_has_time_to_come_back(serve: Serve) -> None:
    """Gone from the bus but not dead for certain: held, until the orphan time is over."""
    served = serve(orphan_time=0.3)
    _, vanish = vanishing(served, "run-1", host="elsewhere", pid=1)
    begin = time.perf_counter()
    vanish()
    wait_until(lambda: served.master().status()["state"] == "free")
    assert time.perf_counter() - begin > 0.25


@in_process
def test_a_master_says_how_long_it_is_to_be_waited_for(serve: Serve) -> None:
    """The claim's orphan time is used in place of the slave's own, within a bound."""
    served = serve(orphan_time=1000.0)
    _, vanish = vanishing(served, "run-1", host="elsewhere", pid=1, orphan_time=0.3)
    begin = time.perf_counter()
    vanish()
    wait_until(lambda: served.master().status()["state"] == "free")
    assert time.perf_counter() - begin > 0.25
    for wrong in (-1.0, MAX_ORPHAN_TIME * 1.01, float("nan"), float("inf"), "1", True, 10**400):
        with pytest.raises(MalformedMessageError, match="orphan_time must be from 0 to 3600 s"):
            Claim.from_message({"run": "r", "host": "h", "pid": 1, "orphan_time": wrong})
    assert served.master().status()["state"] == "free"


@in_process
def test_a_master_that_came_back_is_waited_for_anew(serve: Serve) -> None:
    """The rest of an earlier absence does not count.

    On a busy machine an absence may get too long; then both are repeated with more time.
    """
    served = serve()
    bus = served.bus
    assert isinstance(bus, InProcessBus)
    for orphan_time in (0.6, 2.4, 9.6, 38.4):
        place = {"host": "elsewhere", "pid": 1, "orphan_time": orphan_time}
        master, vanish = vanishing(served, "run-1", **place)
        begins = [time.monotonic()]
        vanish()
        time.sleep(0.7 * orphan_time)
        bus.announce(alive_master("run-1"))
        begins.append(time.monotonic())
        bus.withdraw(alive_master("run-1"))
        time.sleep(0.7 * orphan_time)  # 1.4 times the orphan time since the first absence began
        state = master.status()["state"]
        begins.append(time.monotonic())
        wait_until(lambda: master.status()["state"] == "free")  # noqa: B023  called here only
        if begins[1] - begins[0] < orphan_time > begins[2] - begins[1]:
            break
    assert state == "held"


@in_process
@pytest.mark.parametrize("holder", ["", "run-2"])
def test_a_master_whose_slave_was_given_back_takes_it_again(
    serve: Serve, holder: str, caplog: pytest.LogCaptureFixture
) -> None:
    """It was out of reach for longer than the slave waits: claimed and restored, the same values.

    Where another run holds the slave meanwhile, that is the end, with its name.
    """
    served = serve()
    remote = RemoteSlave(
        served.bus, KEY, run="run-1", bounds=RequestBounds(BOUND, BOUND, BOUND), reconnect_time=1.0
    )

    def restart() -> RemoteSlave:
        remote.renew()
        return remote

    slave = RestorableSlave("slave", remote, describe({"slave": remote})["slave"], restart)

    def execute(*calls: Call) -> Reply:
        slave.start(calls)
        return slave.finish()

    execute(Initialize(outputs=("x",)), ExitInitializationMode())
    assert value(execute(DoStep(0.0, 0.5), GetOutputs())) == pytest.approx(0.5)
    slave.settle()
    Master(served.bus, "run-1", epoch=remote._epoch).release()
    if holder:
        served.master(holder, host="elsewhere", pid=1).claim()
        with pytest.raises(SlaveLostError, match=r"which is not the present.*busy: held by run ru"):
            execute(DoStep(0.5, 0.5), GetOutputs())
        return
    assert value(execute(DoStep(0.5, 0.5), GetOutputs())) == pytest.approx(1.0)
    assert slave.restarts == 1
    (told,) = [r.getMessage() for r in caplog.records if r.name == "master_node"]
    assert re.match(r"slave: do_step at t=0.5 s, H=0.5 s: .* was given back.*; started again", told)
    remote.release()


@over_zenoh
def test_a_dead_master_frees_a_slave_in_an_endless_step(
    serve: Serve,
    background: Background,
    begun: Pipe,
    go: Path,
    mortal: subprocess.Popen[bytes],
) -> None:
    """An endless step of a dead master is ended, and the slave is free."""
    served = serve("Slow", parameters={"begun": str(begun.path), "go": str(go)})
    master, vanish = vanishing(served, "run-1", pid=mortal.pid)
    master.start()
    mortal.kill()
    mortal.wait(BOUND)
    outcome = background(lambda: master.execute(DoStep(0.0, 0.5)))
    begun.wait()
    vanish()
    wait_until(lambda: served.master().status()["state"] == "free")
    wait_until(lambda: bool(outcome))
    served.master("run-2").claim().start().release()


@in_process
def test_another_master_that_leaves_changes_nothing(serve: Serve) -> None:
    """Only the holder's token matters, and a master that was back in time keeps its slave."""
    served = serve(orphan_time=0.1)
    other, leave = vanishing(served, "run-2")
    other.release()
    holder, vanish = vanishing(served, "run-1")
    leave()
    holder.start()
    assert holder.status()["state"] == "held"
    assert value(holder.execute(GetOutputs())) == 0.0
    holder.release()
    assert type(holder.execute(Reset()).error) is SequenceError
    vanish()
