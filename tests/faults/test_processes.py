"""Real processes over real Zenoh: the same bits everywhere, and every fault a clear end.

Each test starts the commands as a user does. Nothing may be left running after any of them.
"""

from __future__ import annotations

import math
import os
import queue
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import psutil
import pytest
import tomli_w

from master_node import Result, load_system, simulate
from master_node.cli.app import main
from protocol.errors import ResultsError
from protocol.host.processes import ending_signals
from tests.support.places import SUPPORT
from tests.support.quarter_car_case import DISPLACEMENT, EXAMPLES, global_errors
from tests.support.waiting import BOUND, is_quick, wait_until

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals"),
    pytest.mark.usefixtures("no_process_left"),
]


MODELS = SUPPORT / "quarter_car_models.py"
WITHOUT_RECOVERY = "recovery = 'off'\n"
FOREVER = "stop_time = 1e6\nlargest_step_size = 1e-3\nsmallest_step_size = 1e-9\n"


class Command:
    """A command in a process of its own; its standard error is read as it comes."""

    def __init__(
        self, scratch: Path, module: str, *words: object, prefix: Sequence[str] = ()
    ) -> None:
        self._process = subprocess.Popen(
            [*prefix, sys.executable, "-m", module, *map(str, words)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "COLUMNS": "500", "MPLBACKEND": "Agg", "TMPDIR": str(scratch)},
        )
        self._lines: queue.Queue[str | None] = queue.Queue()
        self.text = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)
        self._lines.put(None)

    @property
    def process(self) -> psutil.Process:
        """To look at its children."""
        return psutil.Process(self._process.pid)

    def wait_for(self, words: str) -> None:
        """Until it says so."""
        end = time.monotonic() + BOUND
        while True:
            line = self._lines.get(timeout=max(0.0, end - time.monotonic()))
            assert line is not None, f"it ended without {words!r}:\n{self.text}"
            self.text += line
            if words in line:
                return

    def wait(self, timeout: float = BOUND) -> int:
        """Its exit code; what it had to say is in ``text``."""
        code = self._process.wait(timeout)
        while (line := self._lines.get(timeout=BOUND)) is not None:
            self.text += line
        return code

    def send(self, number: signal.Signals) -> None:
        """A signal."""
        self._process.send_signal(number)

    @property
    def killed(self) -> bool:
        """True when a signal ended the command before it could react."""
        code = self._process.poll()
        return code is not None and code < 0

    def close(self) -> None:
        """End it, whatever it does."""
        self._process.kill()
        self._process.wait(BOUND)
        self._reader.join(BOUND)
        assert self._process.stdout is not None
        self._process.stdout.close()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Command]]:
    """``start("master_node", "run", ...)``; what still runs after the test is ended.

    No command that ended by itself may leave a temporary file behind, whatever became of its
    slaves.
    """
    commands: list[Command] = []

    def start_command(module: str, *words: object) -> Command:
        scratch = tmp_path / f"scratch {len(commands)}"
        scratch.mkdir()
        commands.append(Command(scratch, module, *words))
        return commands[-1]

    yield start_command
    for command in commands:
        command.close()
    left = [
        path
        for number, command in enumerate(commands)
        if not command.killed
        for path in (tmp_path / f"scratch {number}").iterdir()
    ]
    assert left == []


Start = Callable[..., Command]


@pytest.fixture
def command(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., tuple[int, str]]]:
    """``command("plot", ...)`` is ``master-node plot ...`` in this process: exit code and words."""
    monkeypatch.setenv("COLUMNS", "500")
    monkeypatch.setenv("MPLBACKEND", "Agg")
    handlers = {number: signal.getsignal(number) for number in ending_signals()}

    def run(*words: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["master-node", *map(str, words)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as info:
            main()
        return info.value.code, "".join(capfd.readouterr())

    yield run
    for number, handler in handlers.items():
        signal.signal(number, handler)


MainCommand = Callable[..., tuple[int, str]]


def toml(value: object) -> str:
    """A value in TOML's notation."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + " }"
    return f'"{value}"' if isinstance(value, str | Path) else str(value)


def system_file(
    folder: Path,
    chassis: object = "quarter_car.py:Chassis",
    wheel: object = "quarter_car.py:Wheel",
    *,
    simulation: str = "stop_time = 0.3\n",
    bus: str = "",
    chassis_parameters: dict[str, Any] | None = None,
    connections: Sequence[tuple[str, str]] = DISPLACEMENT,
) -> Path:
    """The quarter car as a system file; a slave without a model is looked for on the bus."""
    text = f"[simulation]\ninitial_step_size = 1e-3\n{simulation}"
    for name, model in (("chassis", chassis), ("wheel", wheel)):
        text += f"[slaves.{name}]\n"
        if model is not None:
            text += f"model = {toml(EXAMPLES / str(model))}\n"
        if name == "chassis" and chassis_parameters:
            text += f"parameters = {toml(chassis_parameters)}\n"
    for source, target in connections:
        text += f'[[connections]]\nfrom = "{source}"\nto = "{target}"\n'
    path = folder / "car.toml"
    path.write_text(f"{text}[bus]\n{bus}")
    return path


class Gates:
    """The gates of a `quarter_car_models.Gated`: where a run stops until the test lets it go on.

    Args:
        folder: for the files by which the two understand each other.
        times: the gates [s], rising.
    """

    model = f"{MODELS}:Gated"

    def __init__(self, folder: Path, *times: float) -> None:
        self._folder = folder
        self.parameters = {"gates": ", ".join(map(str, times)), "folder": str(folder)}

    def is_at(self, number: int) -> bool:
        """True from when the run has come to the gate."""
        return (self._folder / f"at gate {number}").exists()

    def wait_at(self, number: int) -> None:
        """Until the run has come to the gate."""
        wait_until(lambda: self.is_at(number))

    def open(self, number: int) -> None:
        """Let it go on."""
        (self._folder / f"gate {number} is open").touch()


def endpoints(number: int) -> list[str]:
    """Addresses on loopback that nobody listens on."""
    probes = [socket.create_server(("127.0.0.1", 0)) for _ in range(number)]
    ports = [probe.getsockname()[1] for probe in probes]
    for probe in probes:
        probe.close()
    return [f"tcp/127.0.0.1:{port}" for port in ports]


def has_stepped(directory: Path) -> bool:
    """True when steps have reached the disk."""
    try:
        return len(Result.load(directory).steps) > 0
    except ResultsError:  # not begun
        return False


def slave_processes(master: Command) -> dict[str, psutil.Process]:
    """The nodes that a master launched, by the names of their slaves."""
    nodes = {}
    for child in master.process.children(recursive=True):
        words = child.cmdline()
        if "slave_node" in words and "--name" in words:
            nodes[words[words.index("--name") + 1]] = child
    return nodes


def worker_of(node: psutil.Process) -> psutil.Process:
    """The process that holds the model."""
    (worker,) = [
        child
        for child in node.children()
        if any("spawn_main" in word for word in child.cmdline())
        and not any("resource_tracker" in word for word in child.cmdline())
    ]
    return worker


def assert_readable(directory: Path) -> Result:
    """Results up to the last accepted step: whole rows, and as many as the steps say."""
    result = Result.load(directory)
    taken = result.steps[result.steps["accepted"]]
    assert len(result.time) == 1 + 2 * len(taken)
    assert (np.diff(result.time) > 0.0).all()
    assert global_errors(result).max() < 5e-3
    return result


def assert_summary(directory: Path, outcome: str) -> Result:
    """Asserts readable results with a summary that agrees, and returns them."""
    result = assert_readable(directory)
    assert result.summary["outcome"] == outcome
    assert result.summary["communication_steps"] == len(result.time) - 1
    return result


# ---- The same bits ------------------------------------------------------------------------------


def test_the_same_bits_in_process_launched_and_by_hand(
    start: Start, tmp_path: Path, fmu_dir: Path, endpoint: str
) -> None:
    """Law: results.csv and steps.csv do not depend on where the slaves are."""
    models = {name: fmu_dir / f"{name}.fmu" for name in ("chassis", "wheel")}
    file = system_file(tmp_path, **models, simulation="stop_time = 0.3\norder = 2\n")
    common = ("master_node", "run", file, "--no-plot", "--output")
    by_hand = [
        start("slave_node", "serve", model, "--name", name, "--connect", endpoint)
        for name, model in models.items()
    ]
    masters = [
        start(*common, tmp_path / "launched"),
        start(*common, tmp_path / "by hand", "--no-launch", "--listen", endpoint),
    ]
    simulate(load_system(file), output=tmp_path / "in process", in_process=True)
    for master in masters:
        assert master.wait() == 0, master.text
    for file_name in ("results.csv", "steps.csv"):
        contents = {path: (tmp_path / path / file_name).read_bytes() for path in ("in process",)}
        for path in ("launched", "by hand"):
            assert (tmp_path / path / file_name).read_bytes() == contents["in process"]
    result = assert_summary(tmp_path / "launched", "completed")
    assert result.time[-1] == 0.3
    attempts = len(result.steps)
    assert result.summary["requests"] == {"chassis": 2 * attempts, "wheel": 2 * attempts}
    for slave in by_hand:  # they wait for the next master
        slave.send(signal.SIGTERM)
        assert slave.wait() == 0
        assert "claimed by" in slave.text
        assert "released by" in slave.text


def test_the_same_bits_whatever_the_version_of_fmi(tmp_path: Path, capability_dir: Path) -> None:
    """Law: the halves of the quarter car in FMI 3.0 give the results of those in FMI 2.0."""
    contents = []
    for variant in ("no_derivatives", "fmi3"):
        models = {name: capability_dir / f"{name}_{variant}.fmu" for name in ("chassis", "wheel")}
        file = system_file(
            tmp_path, **models, simulation="stop_time = 0.3\norder = 0\nderivative_points = 0\n"
        )
        output = tmp_path / variant
        simulate(load_system(file), output=output, in_process=True)
        assert_summary(output, "completed")
        contents.append([(output / name).read_bytes() for name in ("results.csv", "steps.csv")])
    assert contents[0] == contents[1]


@pytest.mark.parametrize(
    ("chassis", "wheel"),
    [("chassis_fmi3_intermediate", "wheel_me2")],
)
def test_adapters_of_all_kinds_work_together(
    tmp_path: Path, capability_dir: Path, chassis: str, wheel: str
) -> None:
    """Model exchange and intermediate updates under polynomial inputs: the exact solution."""
    file = system_file(tmp_path, capability_dir / f"{chassis}.fmu", capability_dir / f"{wheel}.fmu")
    simulate(load_system(file), output=tmp_path / "results")
    result = assert_summary(tmp_path / "results", "completed")
    assert max(result.steps["order"]) >= 2


def test_halves_of_fmi_1_run(tmp_path: Path, capability_dir: Path) -> None:
    """With fixed steps and k = 1 they are of second order, whether they take derivatives or not."""
    models = {name: capability_dir / f"{name}_fmi1.fmu" for name in ("chassis", "wheel")}
    file = system_file(tmp_path, **models)
    errors = []
    for step_size in (2e-3, 1e-3):
        fixed = {"estimator": "none", "initial_step_size": step_size}
        result = simulate(load_system(file), in_process=True, **fixed)
        assert result.time[-1] == pytest.approx(0.3)
        errors.append(global_errors(result).max())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


def test_events_of_fmus_are_stepped_up_to(tmp_path: Path, capability_dir: Path) -> None:
    """Bounces of a ball in model exchange, and steps of a staircase with event mode: each is a
    communication point, 4 and 5 of them in 2 s.
    """
    file = tmp_path / "events.toml"
    file.write_text(
        "[simulation]\nstop_time = 2.0\n"
        + "".join(
            f"[slaves.{name}]\nmodel = {toml(capability_dir / f'{model}.fmu')}\n"
            for name, model in (
                ("ball", "bouncing_ball_me3"),
                ("stairs", "event_mode3"),
                ("lag", "discards"),
            )
        )
        + '[[connections]]\nfrom = "stairs.y"\nto = "lag.u"\n'
    )
    result = simulate(load_system(file), in_process=True)
    assert result.summary["discontinuities"] == 9
    fall, speed = math.sqrt(2.0 / 9.81), 0.7 * math.sqrt(2.0 * 9.81)
    bounces = fall + np.cumsum([0.0, *(2.0 * 0.7**i * speed / 9.81 for i in range(3))])
    steps = 0.35 * np.arange(1, 6)
    for event in (*bounces, *steps):
        assert np.abs(result.time - event).min() < 1e-4


def test_values_of_all_types_cross_the_versions(
    command: MainCommand, tmp_path: Path, capability_dir: Path
) -> None:
    """The example, from FMI 3.0 to 2.0 and back over Zenoh: each output is that of its rule; a
    clock is told of and left out.
    """
    file = Path(shutil.copy(EXAMPLES.parent / "capabilities" / "all_types.toml", tmp_path))
    for version in (2, 3):
        name = f"all_types{version}.fmu"
        (tmp_path / name).symlink_to(capability_dir / name)
    output = tmp_path / "results"
    code, text = command("run", file, "--no-plot", "--output", output)
    assert code == 0, text
    clock = "a: clock clock (triggered) is ignored"
    assert clock in text
    assert clock in (output / "logs" / "a.log").read_text()
    result = Result.load(output)
    end = {name: values[-1] for name, values in result.discrete.items()}
    assert (end["a.int8_out"], end["b.integer_out"], end["c.int64_out"]) == (1, 2, 3)
    assert end["c.string_out"] == "got got got "
    assert not any("clock" in name for name in end)


def test_simulate_launches_slaves_too(tmp_path: Path, fmu_dir: Path) -> None:
    """From Python: over Zenoh the same bits as in process, with direct feed-through."""
    system = load_system(EXAMPLES / "displacement_force_python.toml")
    options = {"stop_time": 0.2, "order": 2, "estimator": "rich"}
    a = simulate(system, **options)
    b = simulate(system, in_process=True, **options)
    assert a.time.tobytes() == b.time.tobytes()
    assert a.outputs.tobytes() == b.outputs.tobytes()
    assert a.steps.tolist() == b.steps.tolist()


def test_a_run_leaves_all_files_and_the_commands_read_them(
    command: MainCommand, tmp_path: Path
) -> None:
    """run, plot, compare: what the readme shows, from a system file to a picture."""
    file = system_file(tmp_path)
    fine, coarse = tmp_path / "fine", tmp_path / "coarse"
    code, text = command("run", file, "--in-process", "--output", fine)
    assert code == 0, text
    assert "communication steps" in text
    assert f"results in {fine}" in text
    code, text = command(
        *("run", file, "--in-process", "--output", coarse, "--no-plot"),
        *("--relative-tolerance", "1e-2", "--absolute-tolerance", "1e-2", "--order", "0"),
        *("--estimator", "rich", "--stop-time", "0.2", "--step-size", "2e-3"),
    )
    assert code == 0, text
    files = {"results.csv", "steps.csv", "summary.json", "results.png"}
    assert {path.name for path in fine.iterdir()} == files
    summary = Result.load(coarse).summary
    assert (summary["order"], summary["estimator"], summary["stop_time"]) == (0, "rich", 0.2)
    assert not (coarse / "results.png").exists()

    picture = tmp_path / "wheel.png"
    assert command("plot", coarse) == (0, f"{coarse / 'results.png'}\n")
    assert command("plot", fine, "--variable", "wheel.x", "--file", picture)[0] == 0
    for path in (coarse / "results.png", picture):
        assert path.read_bytes().startswith(b"\x89PNG")
    code, text = command("compare", fine, fine)
    assert code == 0
    assert "equal bit for bit" in text
    code, text = command("compare", coarse, fine, "--rtol", "1e-9", "--atol", "1e-12")
    assert code == 1
    assert "wheel.x" in text
    assert command("compare", coarse, fine, "--rtol", "0.5", "--atol", "1.0")[0] == 0
    code, text = command("compare", fine, tmp_path / "nothing")
    assert code == 7
    assert text.startswith("master-node: cannot read ")


# ---- A slave dies -------------------------------------------------------------------------------


@pytest.mark.parametrize("victim", [pytest.param("node", marks=pytest.mark.slow), "worker"])
def test_a_killed_slave_ends_the_run(
    victim: str, start: Start, tmp_path: Path, fmu_dir: Path
) -> None:
    """SIGKILL without recovery: slave, t, H and cause in one line, results kept, nothing left."""
    file = system_file(
        tmp_path,
        fmu_dir / "chassis.fmu",
        fmu_dir / "wheel.fmu",
        simulation=FOREVER + WITHOUT_RECOVERY,
    )
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out")
    master.wait_for("simulating")
    wait_until(lambda: has_stepped(tmp_path / "out"))
    node = slave_processes(master)["wheel"]
    begin = time.monotonic()
    (node if victim == "node" else worker_of(node)).kill()
    assert master.wait() == 3
    assert is_quick(time.monotonic() - begin, 5.0)
    last = master.text.splitlines()[-1]
    assert re.match(r"master-node: wheel: do_step at t=[0-9.e-]+ s, H=[0-9.e-]+ s: ", last), last
    assert ("died by signal 9" if victim == "node" else "died by SIGKILL") in last
    result = assert_summary(tmp_path / "out", "failed")
    assert result.summary["message"].startswith("wheel: ")
    (told,) = re.findall(r" at t=(\S+) s, ", last)
    assert result.time[-1] <= float(told) < result.time[-1] + 2e-3


def test_a_killed_slave_that_was_started_by_hand(
    start: Start, tmp_path: Path, endpoint: str
) -> None:
    """Its death is seen through its liveliness token; the others are given back."""
    for name in ("Chassis", "Wheel"):
        model = EXAMPLES / f"quarter_car.py:{name}"
        slave = start("slave_node", "serve", model, "--name", name.lower(), "--connect", endpoint)
        if name == "Chassis":
            survivor = slave
    file = system_file(tmp_path, None, None, simulation=FOREVER + WITHOUT_RECOVERY)
    master = start(
        "master_node", "run", file, "--no-plot", "--listen", endpoint, "--output", tmp_path / "out"
    )
    master.wait_for("simulating")
    begin = time.monotonic()
    slave.send(signal.SIGKILL)
    assert master.wait() == 3
    assert is_quick(time.monotonic() - begin, 3.0)
    assert re.search(r"master-node: wheel: do_step at t=.* s, H=.* s: .*died", master.text)
    survivor.wait_for("released by")


def test_a_killed_slave_is_not_waited_for_while_another_is_in_a_long_step(
    start: Start, tmp_path: Path
) -> None:
    """Without recovery the end comes soon and names the dead slave, not the other one."""
    file = system_file(
        tmp_path,
        f"{MODELS}:Sleeper",
        simulation=FOREVER + WITHOUT_RECOVERY,
        chassis_parameters={"sleeps_at": 0.02, "nap": 3600.0, "bed": str(tmp_path / "asleep")},
    )
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out")
    master.wait_for("simulating")
    wait_until((tmp_path / "asleep").exists)
    begin = time.monotonic()
    slave_processes(master)["wheel"].kill()
    assert master.wait() == 3
    assert is_quick(time.monotonic() - begin, 5.0)
    last = master.text.splitlines()[-1]
    assert re.match(r"master-node: wheel: do_step at t=.* s, H=.* s: its process died by", last)
    assert assert_summary(tmp_path / "out", "failed").summary["message"].startswith("wheel: ")


def test_slaves_end_with_a_killed_master(start: Start, tmp_path: Path) -> None:
    """SIGKILL of the master: what it launched ends with it, and what was flushed is readable."""
    master = start(
        *("master_node", "run", system_file(tmp_path, simulation=FOREVER)),
        *("--output", tmp_path / "out", "--no-plot"),
    )
    master.wait_for("simulating")
    wait_until(lambda: has_stepped(tmp_path / "out"))
    slaves = list(slave_processes(master).values())
    slaves += [worker_of(slave) for slave in slaves]
    assert len(slaves) == 4
    master.send(signal.SIGKILL)
    master.wait()
    assert psutil.wait_procs(slaves, timeout=BOUND)[1] == []
    assert Result.load(tmp_path / "out").summary == {}
    assert len(Result.load(tmp_path / "out").time) > 1


def test_a_step_beyond_the_deadline_ends_the_run(start: Start, tmp_path: Path) -> None:
    """A slave that computes for ever: exit code 5 soon after ``step_timeout``, nothing is left."""
    file = system_file(
        tmp_path,
        f"{MODELS}:Sleeper",
        simulation="stop_time = 0.5\n" + WITHOUT_RECOVERY,
        bus="step_timeout = 0.6\n",
        chassis_parameters={"sleeps_at": 0.02, "nap": 3600.0, "bed": str(tmp_path / "asleep")},
    )
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out")
    master.wait_for("simulating")
    wait_until((tmp_path / "asleep").exists)
    begin = time.monotonic()
    assert master.wait() == 5
    assert is_quick(time.monotonic() - begin, 5.0)
    last = master.text.splitlines()[-1]
    assert re.match(r"master-node: chassis: do_step at t=.* s, H=.* s: .*0\.6 s", last), last
    assert assert_summary(tmp_path / "out", "failed").time[-1] <= 0.02


# ---- The end on request -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "where"),
    [
        (signal.SIGINT, "launched"),
        pytest.param(signal.SIGTERM, "launched", marks=pytest.mark.slow),
        (signal.SIGHUP, "in process"),
        pytest.param(signal.SIGINT, "in process", marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, "in a long step", marks=pytest.mark.slow),
        (signal.SIGTERM, "in a long step"),
    ],
)
def test_ctrl_c_and_sigterm(
    number: signal.Signals, where: str, start: Start, tmp_path: Path
) -> None:
    """Exit code 130 within a second, results closed and marked, even when a slave is in a step."""
    sleepy = where == "in a long step"
    asleep = tmp_path / "asleep"
    file = system_file(
        tmp_path,
        f"{MODELS}:Sleeper" if sleepy else "quarter_car.py:Chassis",
        simulation=FOREVER,
        chassis_parameters={"sleeps_at": 0.02, "nap": 60.0, "bed": str(asleep)} if sleepy else {},
    )
    options = ["--in-process"] if where == "in process" else []
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out", *options)
    master.wait_for("simulating")
    if sleepy:
        wait_until(asleep.exists)
    else:
        wait_until(lambda: has_stepped(tmp_path / "out"))
    begin = time.monotonic()
    master.send(number)
    assert master.wait() == 130, master.text
    assert is_quick(time.monotonic() - begin, 1.0)
    assert "interrupted at t=" in master.text.splitlines()[-1]
    assert "Traceback" not in master.text
    assert_summary(tmp_path / "out", "interrupted")


def test_ctrl_c_before_the_first_step(start: Start, tmp_path: Path, endpoint: str) -> None:
    """While slaves are waited for there is nothing to keep, and nothing is left running."""
    file = system_file(tmp_path, None)
    master = start(
        "master_node", "run", file, "--no-plot", "--listen", endpoint, "--output", tmp_path / "out"
    )
    host, port = endpoint.removeprefix("tcp/").split(":")

    def listens() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex((host, int(port))) == 0

    wait_until(listens)
    begin = time.monotonic()
    master.send(signal.SIGINT)
    assert master.wait() == 130, master.text
    assert is_quick(time.monotonic() - begin, 1.0)
    assert "interrupted before the first step" in master.text


# ---- Who holds a slave, and which slave is meant ------------------------------------------------


def test_a_second_master_is_refused_and_the_first_goes_on(
    start: Start, command: MainCommand, tmp_path: Path
) -> None:
    """Exit code 6 naming the holder; afterwards the slaves serve another master."""
    where = endpoints(2)
    slaves = []
    for name, endpoint in zip(("Chassis", "Wheel"), where, strict=True):
        model = EXAMPLES / f"quarter_car.py:{name}"
        slaves.append(
            start("slave_node", "serve", model, "--name", name.lower(), "--listen", endpoint)
        )
    connect = [word for endpoint in where for word in ("--connect", endpoint)]
    file = system_file(tmp_path, None, None, simulation=FOREVER)
    common = ("run", file, "--no-plot", *connect, "--output")
    first = start("master_node", *common, tmp_path / "first")
    first.wait_for("simulating")
    code, text = command(*common, tmp_path / "second")
    assert code == 6
    assert re.search(
        rf"master-node: chassis: claim: busy: held by run \w+ on .* \(pid {first.process.pid}\)",
        text,
    ), text
    rows = len(Result.load(tmp_path / "first").time)
    wait_until(lambda: len(Result.load(tmp_path / "first").time) > rows)
    first.send(signal.SIGINT)
    assert first.wait() == 130
    code, text = command(*common, tmp_path / "third", "--stop-time", "0.1")
    assert code == 0, text
    assert_summary(tmp_path / "first", "interrupted")
    assert_summary(tmp_path / "third", "completed")


def test_two_slaves_of_one_name_are_refused(
    start: Start, command: MainCommand, tmp_path: Path, endpoint: str
) -> None:
    """Exit code 6 naming both by host and process id, before anything is stepped.

    The two are there first and connect within a fraction of a second; the master still waits
    for the wheel that it launches.
    """
    model = EXAMPLES / "quarter_car.py:Chassis"
    twins = [
        start("slave_node", "serve", model, "--name", "chassis", "--connect", endpoint)
        for _ in range(2)
    ]
    for twin in twins:
        twin.wait_for("ready")
    file = system_file(tmp_path, None)
    code, text = command("run", file, "--listen", endpoint, "--output", tmp_path / "out")
    assert code == 6
    last = text.splitlines()[-1]
    assert "2 instances of 'chassis': " in last
    for twin in twins:
        assert f"{socket.gethostname()}/{twin.process.pid}" in last
    assert not (tmp_path / "out" / "results.csv").exists()


def test_a_slave_that_never_appears(
    start: Start, command: MainCommand, tmp_path: Path, endpoint: str
) -> None:
    """Exit code 3 after the stated time, naming who is missing and who was found."""
    model = EXAMPLES / "quarter_car.py:Chassis"
    chassis = start("slave_node", "serve", model, "--name", "chassis", "--connect", endpoint)
    chassis.wait_for("ready")
    begin = time.monotonic()
    code, text = command(
        *("run", system_file(tmp_path, None, None), "--listen", endpoint),
        *("--timeout", "1", "--output", tmp_path / "out"),
    )
    assert code == 3
    taken = time.monotonic() - begin
    assert taken > 1.0
    assert is_quick(taken, 8.0)
    assert (
        "master-node: wheel: discovery: did not appear within 1 s; found on the bus: chassis; "
        "start it with `slave-node serve" in text
    )


# ---- Bad input ----------------------------------------------------------------------------------


def test_a_port_in_use(command: MainCommand, tmp_path: Path) -> None:
    """Exit code 2 with the address and the remedy."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        file = system_file(tmp_path, None)
        code, text = command("run", file, "--listen", endpoint, "--output", tmp_path / "out")
    assert code == 2
    assert f"cannot open the bus at {endpoint}" in text
    assert "another process may use the port" in text


def _missing(path: Path) -> None:
    """Nothing there."""


def _corrupt(path: Path) -> None:
    """A zip that was cut off."""
    path.write_bytes(b"PK\x03\x04 and then nothing of use")


@pytest.mark.parametrize("make", [_missing, _corrupt])
@pytest.mark.parametrize("options", [[], ["--in-process"]])
def test_an_fmu_that_cannot_be_used(
    make: Callable[[Path], None], options: list[str], command: MainCommand, tmp_path: Path
) -> None:
    """Exit code 2 with slave and path, launched as in process; the other slave is ended too."""
    fmu = tmp_path / "broken.fmu"
    make(fmu)
    file = system_file(tmp_path, fmu)
    code, text = command("run", file, "--output", tmp_path / "out", *options)
    assert code == 2, text
    last = text.splitlines()[-1]
    assert last.startswith("master-node: chassis: ")
    assert "broken.fmu" in last
    assert "Traceback" not in text


@pytest.mark.parametrize(
    ("model", "timeout", "code", "words"),
    [
        ("--help", "30", 2, "chassis: '--help' is not a model"),
        ("aborts.py:Model", "30", 4, "chassis: load: the process that held the model died by"),
        ("sleeps.py:Model", "3", 5, "the model was not loaded within 3 s"),
    ],
)
def test_a_model_that_does_not_get_loaded(  # noqa: PLR0917
    model: str, timeout: str, code: int, words: str, command: MainCommand, tmp_path: Path
) -> None:
    """A name is never an option of the slave's command; who crashes while it is loaded is told
    from who is lost, and who takes too long from who was not started.
    """
    (tmp_path / "aborts.py").write_text("import os\nos.abort()\n")
    (tmp_path / "sleeps.py").write_text("import time\ntime.sleep(60)\n")
    file = system_file(tmp_path)
    tables = tomllib.loads(file.read_text())
    tables["slaves"]["chassis"] = {"model": model}
    tables["bus"]["load_timeout"] = float(timeout)
    file.write_text(tomli_w.dumps(tables))
    options = ("--timeout", timeout, "--output", tmp_path / "out")
    ended, text = command("run", file, *options)
    assert ended == code, text
    assert words in text.splitlines()[-1]


def test_a_misspelt_variable(command: MainCommand, tmp_path: Path) -> None:
    """Exit code 2 with the file, the connection and the nearest name; no step is taken."""
    file = system_file(tmp_path, connections=[*DISPLACEMENT[:3], ("wheel.v", "chassis.vw")])
    code, text = command("run", file, "--in-process", "--output", tmp_path / "out")
    assert code == 2
    assert text.splitlines()[-1] == (
        f"master-node: {file}: [[connections]] number 4: to = 'chassis.vw': "
        "chassis has no variable 'vw'; did you mean 'v_w' or 'v'?"
    )
    assert not (tmp_path / "out" / "results.csv").exists()


def test_an_output_directory_that_cannot_be_written(
    command: MainCommand, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Exit code 7 with the path, before a slave is started."""
    (tmp_path / "file").touch()
    monkeypatch.setattr(subprocess, "Popen", None)
    code, text = command("run", system_file(tmp_path), "--output", tmp_path / "file/out")
    assert code == 7
    assert str(tmp_path / "file") in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--order", "4"], "order = 4: input should be 0, 1, 2, 3 or 'auto'"),
        (["--preset", "papers"], "preset = 'papers'"),
        (["--sequence", "gauss"], "'jacobi' or 'gauss-seidel'"),
        (["--step-size", "0"], "initial_step_size = 0.0"),
        (["--stop-time", "-1"], "stop_time -1 must be after start_time 0"),
        (["--relative-tolerance", "-1"], "relative_tolerance = -1.0"),
        (["--estimator", "richardson"], "'rich', 'mod' or 'none'"),
        (["--listen", "7447"], "'7447' is not an endpoint"),
        (["--listen", "tcp/0.0.0.0:7447"], "--insecure"),
        (["--timeout", "0"], "discovery_timeout = 0.0"),
        (["--in-process", "--no-launch"], "leave out --no-launch or --in-process"),
        (["--in-process", "--timeout", "0"], "--timeout is for slaves on the bus"),
    ],
)
def test_a_wrong_command_line(
    words: list[str], message: str, command: MainCommand, tmp_path: Path
) -> None:
    """Exit code 2, and what would be right."""
    code, text = command("run", system_file(tmp_path), "--output", tmp_path / "out", *words)
    assert code == 2
    assert message in text
    assert not (tmp_path / "out" / "results.csv").exists()


# ---- Who reads what a command says --------------------------------------------------------------


def help_into(output: IO[bytes], module: str) -> subprocess.CompletedProcess[bytes]:
    """Help text of a command, written to ``output``."""
    return subprocess.run(
        [sys.executable, "-m", module, "--help"],
        stdout=output,
        stderr=subprocess.PIPE,
        timeout=BOUND,
        check=False,
    )


@pytest.mark.parametrize("module", ["master_node", "slave_node"])
def test_a_reader_that_has_left_changes_nothing(module: str) -> None:
    """A reader that leaves, as ``| head``, causes neither a message nor another exit code."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed:
        done = help_into(closed, module)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
@pytest.mark.parametrize("module", ["master_node", "slave_node"])
def test_an_output_that_cannot_be_written(module: str) -> None:
    """Exit code 7 and one line."""
    with Path("/dev/full").open("wb") as full:
        done = help_into(full, module)
    assert done.returncode == 7
    assert b"cannot write to the standard output: No space left" in done.stderr
    assert len(done.stderr.splitlines()) == 1
