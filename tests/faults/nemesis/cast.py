"""The processes of a disturbed run: masters one after the other, slaves by hand, agents."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from secrets import token_hex
from typing import IO

import psutil
import tomli_w

from protocol.bus.endpoints import free_endpoint
from tests.faults.nemesis.faults import Fault
from tests.faults.nemesis.master import DESCRIPTOR
from tests.faults.nemesis.relay import Relay
from tests.faults.nemesis.systems import DrawnSystem
from tests.support.places import ROOT
from tests.support.waiting import BOUND

_MARK = "NEMESIS_MARK"
_RESTART_TIME = 0.3
"""After which a service manager starts a process again [s]."""

_PATIENCE = 2.0
"""Time for which a victim is looked for that is not there yet [s]."""

_TIME_TO_END = 60.0
"""Time that processes have to end [s]."""


class Cast:
    """Starts them, finds them, and ends them.

    Args:
        system: to be run.
        folder: of its own, for all files.
        router: endpoint of a router for all seeds.
        attempted: called for each attempted step of a master.

    Attributes:
        out: directory of the results.
    """

    def __init__(
        self, system: DrawnSystem, folder: Path, router: str, attempted: Callable[[], None]
    ) -> None:
        self.out = folder / "out"
        self._system = system
        self._folder = folder
        self._attempted = attempted
        self._mark = token_hex(8)
        self._master: subprocess.Popen[bytes] | None = None
        self._services: dict[str, subprocess.Popen[bytes]] = {}
        self._commands: dict[str, Sequence[str]] = {}
        self._ready_before: dict[str, int] = {}
        self._codes: list[tuple[str, int | None]] = []
        self._is_over = threading.Event()
        self._scratch.mkdir()
        own = free_endpoint()
        self.relay = Relay(router if system.way == "routed" else own)
        self._file = folder / "system.toml"
        endpoint = self.relay.endpoint if system.way == "routed" else own
        self._file.write_text(tomli_w.dumps(system.tables_to_run(endpoint)), encoding="utf-8")
        self._serve()
        self._manager = threading.Thread(target=self._manage, name="service manager")
        self._manager.start()

    @property
    def _scratch(self) -> Path:
        return self._folder / "tmp"

    # ---- Masters --------------------------------------------------------------------------------

    def run_master(self, *, again: bool) -> int:
        """Run the system, or ``resume`` it.

        Returns:
            The exit code.

        Raises:
            subprocess.TimeoutExpired: it does not end.
        """
        words = ["resume", str(self.out)]
        if not again:
            words = ["run", str(self._file), "--output", str(self.out)]
            words += ["--in-process"] if self._system.way == "in process" else []
        reading, writing = os.pipe()
        command = [
            sys.executable,
            "-m",
            "tests.faults.nemesis.master",
            *words,
            "--no-plot",
            "--quiet",
        ]
        with self._log("master") as log:
            self._master = subprocess.Popen(
                command,
                cwd=ROOT,
                env=self._environment() | {DESCRIPTOR: str(writing)},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                pass_fds=(writing,),
            )
        os.close(writing)
        with open(reading, "rb", buffering=0) as pipe:  # noqa: PTH123  a descriptor
            while told := pipe.read(1):
                for _ in told:
                    self._attempted()
        return self._master.wait(BOUND)

    # ---- Victims --------------------------------------------------------------------------------

    def suffer(self, fault: Fault) -> bool:
        """Let a fault happen; False where it comes too late for its victim."""
        if fault.part == "relay":
            self.relay.disturb(fault.kind, fault.duration)
            return True
        end = time.monotonic() + _PATIENCE
        while not self._is_over.is_set() and time.monotonic() < end:
            victim = self._victim(fault)
            if victim is not None:
                try:
                    _harm(victim, fault)
                except psutil.NoSuchProcess:
                    continue
                return True
            time.sleep(0.005)
        return False

    def _victim(self, fault: Fault) -> psutil.Process | None:
        try:
            return _one_of(fault, self._victims(fault))
        except psutil.NoSuchProcess:
            return None

    def _victims(self, fault: Fault) -> list[psutil.Process]:
        if fault.part == "master":
            return _running(self._master)
        if fault.part == "agent":
            return _running(self._services["agent"])
        if self._system.way == "in process":
            return [child for p in _running(self._master) for child in p.children(recursive=True)]
        nodes = self._nodes(fault.slave)
        if fault.part == "node":
            return nodes
        workers = [child for node in nodes for child in node.children() if _is_spawned(child)]
        if fault.part == "worker":
            return workers
        return [child for worker in workers for child in worker.children(recursive=True)]

    def _nodes(self, slave: str) -> list[psutil.Process]:
        if self._system.way == "served":
            return _running(self._services[slave])
        parent = self._services["agent"] if self._system.way == "agent" else self._master
        children = [child for process in _running(parent) for child in process.children()]
        return [child for child in children if _serves(child, slave)]

    # ---- Slaves by hand, and agents -------------------------------------------------------------

    def _serve(self) -> None:
        if self._system.way == "served":
            for name, slave in self._system.slaves.items():
                self._commands[name] = ("serve", slave["model"], "--name", name)
        if self._system.way == "agent":
            models = self._folder / "models"
            models.mkdir()
            for slave in self._system.slaves.values():
                shutil.copy(slave["model"].partition(".py:")[0] + _python(slave["model"]), models)
            words = ("agent", "--name", "agent", "--models", str(models), "--allow-python")
            self._commands["agent"] = words
        for name in self._commands:
            self._services[name] = self._started(name)

    def _started(self, name: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "slave_node", *self._commands[name]]
        self._ready_before[name] = self._times_ready(name)
        with self._log(name) as log:
            return subprocess.Popen(
                [*command, "--connect", self.relay.endpoint],
                cwd=ROOT,
                env=self._environment(),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def _times_ready(self, name: str) -> int:
        """Number of times that a process of this name has come up."""
        return self.told().get(name, "").count("ready: ")

    def _manage(self) -> None:
        while not self._is_over.wait(_RESTART_TIME):
            for name, service in self._services.items():
                code = service.poll()
                if code is not None:
                    self._codes.append((name, code))
                    self._services[name] = self._started(name)

    # ---- The end --------------------------------------------------------------------------------

    def dismiss(self) -> None:
        """Let no further fault happen; what was begun goes on."""
        self._is_over.set()

    def close(self) -> list[tuple[str, int | None]]:
        """End all, behind `dismiss`.

        Returns:
            Slaves by hand and agents with their exit codes; None of one that SIGTERM did not end.
        """
        self._manager.join(BOUND)
        for name, service in self._services.items():
            self._let_come_up(name)
            service.send_signal(signal.SIGTERM)
        codes = [*self._codes, *((name, _ended(s)) for name, s in self._services.items())]
        if self._master is not None and self._master.poll() is None:
            self._master.kill()
            self._master.wait(BOUND)
        self.relay.close()
        return codes

    def _let_come_up(self, name: str) -> None:
        """For a while: who is asked to end while it begins is ended by the signal itself."""
        end = time.monotonic() + _TIME_TO_END
        while self._services[name].poll() is None and time.monotonic() < end:
            if self._times_ready(name) > self._ready_before[name]:
                return
            time.sleep(0.01)

    def left(self) -> list[str]:
        """Processes that still run after a while in which they may end; these are ended."""
        marked = [p for p in psutil.process_iter() if _is_marked(p, self._mark)]
        _, alive = psutil.wait_procs(marked, timeout=_TIME_TO_END)
        told = []
        for process in alive:
            try:
                told.append(" ".join(process.cmdline()))
                process.kill()
            except psutil.NoSuchProcess:
                continue
        return told

    def told(self) -> dict[str, str]:
        """Texts of processes on their standard error, by name."""
        logs = sorted(self._folder.glob("*.log"))
        return {log.stem: log.read_text(encoding="utf-8", errors="replace") for log in logs}

    def _log(self, name: str) -> IO[bytes]:
        return (self._folder / f"{name}.log").open("ab")

    def _environment(self) -> dict[str, str]:
        return {**os.environ, _MARK: self._mark, "TMPDIR": str(self._scratch), "COLUMNS": "500"}


def _python(model: str) -> str:
    return ".py" if ".py:" in model else ""


def _harm(victim: psutil.Process, fault: Fault) -> None:
    match fault.kind:
        case "kill":
            victim.kill()
        case "interrupt":
            victim.send_signal(fault.choose((signal.SIGINT, signal.SIGTERM, signal.SIGHUP)))
        case "full disk":
            size = round(10 ** (2.0 + 4.0 * fault.which))
            victim.rlimit(resource.RLIMIT_FSIZE, (size, size))
        case "stop":
            victim.suspend()
            try:
                time.sleep(fault.duration)
            finally:
                with suppress(psutil.NoSuchProcess):  # another fault killed it meanwhile
                    victim.resume()


def _one_of(fault: Fault, processes: list[psutil.Process]) -> psutil.Process | None:
    return fault.choose(processes) if processes else None


def _running(process: subprocess.Popen[bytes] | None) -> list[psutil.Process]:
    is_running = process is not None and process.poll() is None
    return [psutil.Process(process.pid)] if is_running else []


def _serves(process: psutil.Process, slave: str) -> bool:
    words = process.cmdline()
    return "serve" in words and words[words.index("--name") + 1] == slave


def _is_spawned(process: psutil.Process) -> bool:
    words = " ".join(process.cmdline())
    return "spawn_main" in words and "resource_tracker" not in words


def _is_marked(process: psutil.Process, mark: str) -> bool:
    try:
        return process.environ().get(_MARK) == mark
    except psutil.Error:
        return False


def _ended(service: subprocess.Popen[bytes]) -> int | None:
    try:
        return service.wait(_TIME_TO_END)
    except subprocess.TimeoutExpired:
        service.kill()
        service.wait(BOUND)
        return None
