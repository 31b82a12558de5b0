"""``slave-node`` as a user, a service manager and a master see it: real processes."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import msgpack
import psutil
import pytest
from typer.testing import CliRunner

from protocol.bus.endpoints import Endpoints
from protocol.bus.zenoh import ZenohBus
from protocol.wire.keys import STATUS, SlaveKey
from protocol.wire.records import decode_map
from slave_node.cli.app import app
from tests.support.slow import quick_at
from tests.support.waiting import BOUND, is_quick

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses named pipes and signals"),
    pytest.mark.usefixtures("no_process_left"),
]


MODELS = """
import signal
from protocol.variables import Variable, VariableType
from slave_node.model import Model, real

class Endless(Model):
    '''Says through a pipe that it is in a step, and never ends it.'''
    states = (real("x", "m", start=float("inf"), description="Position"),)
    outputs = states
    parameters = (Variable("begun", type=VariableType.STRING, start=""),)

    def derivatives(self, t, x, u):
        with open(self.begun, "w") as pipe:
            pipe.write("x")
        while True:
            signal.pause()
"""


class Node:
    """A ``slave-node serve`` process, its log and its worker."""

    def __init__(self, *arguments: str, environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "slave_node", "serve", *arguments],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            start_new_session=True,
        )
        self.log: list[str] = []
        self._lines: SimpleQueue[str] = SimpleQueue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._lines.put(line)
        self._lines.put("")

    def wait_for(self, words: str) -> str:
        """The first line of the log with these words."""
        while line := self._lines.get(timeout=BOUND):
            self.log.append(line)
            if words in line:
                return line
        raise AssertionError(f"ended without {words!r}: {self.log}")

    def ready(self) -> Node:
        """Wait until it serves."""
        self.wait_for(" ready: ")
        return self

    @property
    def worker(self) -> psutil.Process:
        """The process that holds the model."""
        (worker,) = (
            child
            for child in psutil.Process(self.process.pid).children()
            if "resource_tracker" not in " ".join(child.cmdline())
        )
        return worker

    def ended(self) -> tuple[int, float]:
        """Exit code, and the seconds that it took from now."""
        begin = time.perf_counter()
        code = self.process.wait(BOUND)
        took = time.perf_counter() - begin
        self._reader.join(BOUND)
        while line := self._lines.get(timeout=BOUND):
            self.log.append(line)
        return code, took

    def clean_up(self) -> None:
        """Whatever a failed test left."""
        self.process.kill()
        self.process.wait(BOUND)
        self._reader.join(BOUND)
        for pipe in (self.process.stdin, self.process.stderr):
            assert pipe is not None
            pipe.close()


Start = Callable[..., Node]


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    """Where the processes put their temporary files."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    return folder


@pytest.fixture
def start(endpoint: str, scratch: Path) -> Iterator[Start]:
    """``start(model, …)`` begins to serve; whatever is left is ended after the test."""
    nodes: list[Node] = []

    def make(model: str | Path, *arguments: str) -> Node:
        where = () if "--listen" in arguments else ("--connect", endpoint)
        environment = {**os.environ, "TMPDIR": str(scratch)}
        nodes.append(
            Node(str(model), *where, "--name", "slave", *arguments, environment=environment)
        )
        return nodes[-1]

    yield make
    for node in nodes:
        node.clean_up()


@pytest.fixture
def bus(endpoint: str) -> Iterator[ZenohBus]:
    """A master's bus."""
    bus = ZenohBus(Endpoints(listen=(endpoint,)))
    yield bus
    bus.close()


@pytest.fixture
def endless(bus: ZenohBus, start: Start, tmp_path: Path) -> Node:
    """A node in the middle of an endless step."""
    models, begun = tmp_path / "models.py", tmp_path / "begun"
    models.write_text(MODELS)
    os.mkfifo(begun)
    reading = os.open(begun, os.O_RDONLY | os.O_NONBLOCK)
    node = start(
        f"{models}:Endless",
        "--instance",
        "0123abcd",
        "--parameter",
        f"begun={begun}",
        "--parameter",
        "x=0.0",
        "--stay-with-parent",
    )
    key = SlaveKey("slave", "0123abcd")
    alive = threading.Event()
    bus.watch(key.alive, lambda *_: alive.set())
    assert alive.wait(BOUND)
    callers = {v: bus.caller(key.verb(v), BOUND) for v in ("initialize", "do_step", STATUS)}
    callers["exit"] = bus.caller(key.verb("exit_initialization_mode"), BOUND)
    for verb in ("initialize", "exit"):
        assert msgpack.unpackb(callers[verb].request(b"")) == {"result": None}
    callers["do_step"].send(msgpack.packb({"communication_point": 0.0, "step_size": 1.0}))
    ready, _, _ = select.select([reading], [], [], BOUND)
    assert ready
    os.close(reading)
    assert decode_map(callers[STATUS].request(b""))["busy"] is True
    return node


def is_gone(process: psutil.Process) -> bool:
    """True when the process ends in a bounded short time."""
    begin = time.perf_counter()
    _, alive = psutil.wait_procs([process], timeout=BOUND)
    return not alive and is_quick(time.perf_counter() - begin, 2.0)


# ---- Serving -----------------------------------------------------------------------------------


def test_a_slave_says_when_it_is_ready(start: Start, fmu_dir: Path, bus: ZenohBus) -> None:
    """One line says what was loaded and where it is served, one that it serves."""
    node = start(fmu_dir / "wheel.fmu", "--instance", "0123abcd")
    assert "on the bus to tcp/127.0.0.1:" in node.wait_for("wheel.fmu loaded")
    line = node.wait_for(" ready: ")
    assert "slave: ready: FMI 2.0 co-simulation, instance 0123abcd" in line
    key = SlaveKey("slave", "0123abcd")
    alive = threading.Event()
    bus.watch(key.alive, lambda *_: alive.set())
    assert alive.wait(BOUND)
    status = decode_map(bus.caller(key.verb(STATUS), BOUND).request(b""))
    assert status["pid"] == node.process.pid
    assert status["state"] == "free"


@pytest.mark.parametrize(
    "number", quick_at([signal.SIGTERM], [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
)
def test_a_signal_ends_it_orderly(
    start: Start, fmu_dir: Path, scratch: Path, number: signal.Signals
) -> None:
    """Code 0 in less than two seconds, with a word about it; no process and no file is left."""
    node = start(fmu_dir / "wheel.fmu").ready()
    worker = node.worker
    assert list(scratch.iterdir()) != []
    node.process.send_signal(number)
    code, took = node.ended()
    assert (code, is_quick(took, 2.0)) == (0, True)
    assert any(f"ending: {number.name}" in line for line in node.log)
    assert node.log[-1].endswith("slave: ended\n")
    assert not any("Traceback" in line for line in node.log)
    assert is_gone(worker)
    assert list(scratch.iterdir()) == []


def test_ctrl_c_in_a_terminal_ends_it_orderly(start: Start, fmu_dir: Path) -> None:
    """There the signal goes to the worker too, which leaves the ending to the node."""
    node = start(fmu_dir / "wheel.fmu").ready()
    worker = node.worker
    os.killpg(node.process.pid, signal.SIGINT)
    code, took = node.ended()
    assert (code, is_quick(took, 2.0)) == (0, True)
    assert not any("Traceback" in line for line in node.log)
    assert is_gone(worker)


def test_it_ends_with_its_parent_on_request(start: Start, fmu_dir: Path) -> None:
    """Standard input is the parent's hand: when it lets go, the slave ends."""
    node = start(fmu_dir / "wheel.fmu", "--stay-with-parent").ready()
    worker = node.worker
    assert node.process.stdin is not None
    node.process.stdin.close()
    code, took = node.ended()
    assert (code, is_quick(took, 2.0)) == (0, True)
    assert is_gone(worker)


def test_without_the_request_standard_input_does_not_matter(start: Start, fmu_dir: Path) -> None:
    """Under a service manager there is none."""
    node = start(fmu_dir / "wheel.fmu")
    assert node.process.stdin is not None
    node.process.stdin.close()
    node.ready()
    assert node.process.poll() is None


@pytest.mark.parametrize("how", quick_at(["SIGTERM", "parent"], ["SIGTERM", "SIGINT", "parent"]))
def test_it_ends_in_the_middle_of_a_step(endless: Node, how: str) -> None:
    """An endless step delays the ending no more than an idle slave does."""
    worker = endless.worker
    if how == "parent":
        assert endless.process.stdin is not None
        endless.process.stdin.close()
    else:
        endless.process.send_signal(signal.Signals[how])
    code, took = endless.ended()
    assert (code, is_quick(took, 2.0)) == (0, True), endless.log
    assert not any("Traceback" in line for line in endless.log)
    assert is_gone(worker)


def test_a_killed_node_leaves_no_worker(start: Start, fmu_dir: Path) -> None:
    """SIGKILL gives the node no chance, and still nothing goes on."""
    node = start(fmu_dir / "wheel.fmu").ready()
    worker = node.worker
    node.process.kill()
    assert is_gone(worker)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere only an idle worker notices")
def test_a_killed_node_leaves_no_worker_in_a_step(endless: Node) -> None:
    """The kernel ends the worker with the node, whatever the model is doing."""
    worker = endless.worker
    endless.process.kill()
    assert is_gone(worker)


def test_it_ends_while_the_model_is_loading(start: Start, tmp_path: Path) -> None:
    """A signal ends the node while a model takes its time to load."""
    begun = tmp_path / "begun"
    os.mkfifo(begun)
    models = tmp_path / "models.py"
    models.write_text(
        f"import signal\nopen({str(begun)!r}, 'w').write('x')\nwhile True: signal.pause()\n"
    )
    reading = os.open(begun, os.O_RDONLY | os.O_NONBLOCK)
    node = start(f"{models}:Model")
    ready, _, _ = select.select([reading], [], [], BOUND)
    os.close(reading)
    assert ready
    worker = node.worker
    node.process.terminate()
    code, took = node.ended()
    assert (code, is_quick(took, 2.0)) == (0, True), node.log
    assert is_gone(worker)


# ---- Mistakes ----------------------------------------------------------------------------------


def failure(node: Node) -> str:
    """Line of a node that ends with code 2."""
    code, _ = node.ended()
    assert code == 2, node.log
    (line,) = [line for line in node.log if line.startswith("slave-node: ")]
    assert not any("Traceback" in line for line in node.log)
    return line


def test_a_missing_model_is_one_line(start: Start, tmp_path: Path, scratch: Path) -> None:
    """Code 2 and nothing else to read; no file is left."""
    node = start(tmp_path / "nowhere.fmu")
    assert failure(node).endswith("nowhere.fmu: no such file\n")
    assert len(node.log) == 1
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--parameter", "m"), "--parameter m: write name=value"),
        (("--parameter", "=3"), "--parameter =3: write name=value"),
        (("--parameter", "m=[1]"), "--parameter m=[1]: not a number, boolean or string"),
        (("--parameter", "m=2020-01-01"), "not a number, boolean or string"),
        (("--name", "a/b"), "'a/b' is not a valid slave name"),
        (("--name", ".."), "'..' is not a valid slave name"),
        (("--listen", "tcp/0.0.0.0:1"), "is not a loopback address"),
        (("--listen", "7447"), "'7447' is not an endpoint"),
    ],
)
def test_a_wrong_option_is_one_line(
    start: Start, fmu_dir: Path, arguments: tuple[str, ...], message: str
) -> None:
    """Refused before the model is loaded, with what to write."""
    node = start(fmu_dir / "wheel.fmu", *arguments)
    assert message in failure(node)
    assert len(node.log) == 1


@pytest.mark.parametrize("command", [("serve", "wheel.fmu"), ("agent", "--models", ".")])
def test_slaves_and_agents_are_no_routers(command: tuple[str, ...]) -> None:
    """Their modes are those of the documents: a router is a command of its own."""
    refused = CliRunner().invoke(app, [*command, "--mode", "router"])
    assert refused.exit_code == 2
    assert "'router' is not one of 'peer', 'client'" in refused.output


def test_a_port_in_use_is_named(
    start: Start, fmu_dir: Path, endpoint: str, bus: ZenohBus, scratch: Path
) -> None:
    """The endpoint and the remedy; the worker that was loaded already is ended."""
    line = failure(start(fmu_dir / "wheel.fmu", "--listen", endpoint))
    assert endpoint in line
    assert "in use" in line
    assert list(scratch.iterdir()) == []


def test_a_second_slave_of_a_name_is_refused(start: Start, fmu_dir: Path, endpoint: str) -> None:
    """Where one can see the other, the second one does not even begin to serve."""
    start(fmu_dir / "wheel.fmu", "--listen", endpoint, "--instance", "0123abcd").ready()
    line = failure(start(fmu_dir / "chassis.fmu"))
    assert "a slave named 'slave' is on the bus already" in line
    assert "0123abcd" in line
    assert "--name" in line


# ---- inspect -----------------------------------------------------------------------------------


def inspect(*arguments: str, code: int = 0) -> str:
    """Output of ``slave-node inspect``."""
    result = subprocess.run(
        [sys.executable, "-m", "slave_node", "inspect", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=BOUND,
        env={**os.environ, "COLUMNS": "160"},
    )
    assert result.returncode == code, result.stderr
    return result.stderr if code else result.stdout


def test_inspect_shows_what_a_user_asks_first(fmu_dir: Path) -> None:
    """Capabilities, feed-through, units and how the state can be saved."""
    text = inspect(str(fmu_dir / "wheel_force.fmu"))
    for words in (
        "wheel_force",
        "FMI 2.0 co-simulation",
        "saved and restored by the model itself",
        "output derivatives up to order",
        "variable communication step size",
        "F of x_c, v_c",
        "N.s/m",
        "Displacement of the chassis",
    ):
        assert words in text


def test_inspect_shows_which_values_a_variable_can_have(capability_dir: Path) -> None:
    """Bounds, and the items of enumerations with their numbers; starts by the names of items."""
    lines = inspect(str(capability_dir / "drive2.fmu")).splitlines()
    gain, mode = (next(line for line in lines if line.split()[:1] == [n]) for n in ("gain", "mode"))
    assert "0.0 to 10.0" in gain
    assert "forward" in mode
    assert "reverse = -1" in mode


def strict(text: str) -> Any:
    """JSON as the standard has it, without NaN and Infinity."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_inspect_prints_json_for_programs(fmu_dir: Path, tmp_path: Path) -> None:
    """Valid for every reader, also where a start value is no number that JSON has."""
    description = strict(inspect(str(fmu_dir / "wheel.fmu"), "--json"))
    assert description["capabilities"]["can_get_and_set_state"] is True
    assert description["model"] == "wheel"
    assert {v["name"] for v in description["variables"]} >= {"x_c", "v_c", "x", "v", "m"}

    models = tmp_path / "models.py"
    models.write_text(MODELS)
    description = strict(inspect(f"{models}:Endless", "--json"))
    (x,) = (v for v in description["variables"] if v["name"] == "x")
    assert (x["causality"], x["unit"], x["start"]) == ("output", "m", "inf")


def test_inspect_of_nothing_is_one_line(tmp_path: Path) -> None:
    """Code 2, the name, and a hint at what can be named."""
    lines = inspect(str(tmp_path / "nowhere.fmu"), code=2).splitlines()
    assert len(lines) == 1
    assert "no such file" in lines[0]
    lines = inspect("wheel", code=2).splitlines()
    assert len(lines) == 1
    assert "'wheel' is not a model; name an .fmu file" in lines[0]
