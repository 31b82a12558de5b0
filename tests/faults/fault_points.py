"""Real processes that are killed, stopped or cut off at drawn points, and the law for all of them.

The quarter car runs with two launched FMUs through a router. A number says what happens, to whom,
after how many attempts and how long after the last of them: in mid request, most of the time.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import product
from pathlib import Path
from random import Random
from typing import NamedTuple

import psutil

from master_node import Result, System, load_system, resume, simulate
from protocol.bus.endpoints import free_endpoint
from tests.faults.test_processes import system_file, worker_of
from tests.support.waiting import BOUND

NUMBER = 50
"""Number of points."""

_EARLIEST, _LATEST = 60, 190  # after the first checkpoint, and of 200 attempts at least
_SIMULATION = "stop_time = 0.4\nlargest_step_size = 1e-3\ncheckpoint_interval = 0.01\n"
_SLAVES = ("chassis", "wheel")
_PARTS = ("node", "worker")


class Fault(NamedTuple):
    """Fault of one process or link.

    Attributes:
        kind: ``kill``, ``stop`` or ``cut``.
        slave: its name; "" for the master or the router.
        part: ``node``, ``worker``, ``master`` or ``router``.
    """

    kind: str
    slave: str
    part: str

    def __str__(self) -> str:
        return f"{self.kind} {f'{self.part} of {self.slave}' if self.slave else self.part}"


FAULTS = (
    *(Fault(kind, *whom) for kind in ("kill", "stop") for whom in product(_SLAVES, _PARTS)),
    Fault("kill", "", "master"),
    Fault("cut", "", "router"),
)


@dataclass(frozen=True)
class Point:
    """Where a fault happens.

    Attributes:
        fault: which.
        attempt: after so many attempts.
        delay: and so long after the last of them [s].
        duration: of a stop or a cut [s].
        settings: of the run.
    """

    fault: Fault
    attempt: int
    delay: float
    duration: float
    settings: str

    @staticmethod
    def of(number: int) -> Point:
        """Point ``number``: the same for ever."""
        draw = Random(number)
        return Point(
            FAULTS[number % len(FAULTS)],
            draw.randint(_EARLIEST, _LATEST),
            draw.uniform(0.0, 4e-3),
            draw.uniform(0.05, 1.5),
            f'estimator = "{draw.choice(("mod", "rich", "none"))}"\n'
            f'sequence = "{draw.choice(("jacobi", "gauss-seidel"))}"\n'
            f"order = {draw.randint(0, 2)}\n",
        )


class Router:
    """A router in a process of its own, that can be taken away and brought back."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self._process = self._started()

    def _started(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "slave_node", "router", "--listen", self.endpoint]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def cut(self, duration: float) -> None:
        """Kill it, and start another one after ``duration`` seconds."""
        self.close()
        time.sleep(duration)
        self._process = self._started()

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait(BOUND)


@contextmanager
def router() -> Iterator[Router]:
    """One for several points."""
    made = Router()
    try:
        yield made
    finally:
        made.close()


@dataclass
class _Trigger:
    """An observer that lets something happen once, in a thread of its own."""

    point: Point
    act: Callable[[], None]
    attempts: int = 0
    thread: threading.Thread | None = None
    errors: list[BaseException] = field(default_factory=list)

    def started(self, _: object) -> None:
        """See `Observer`."""

    def attempted(self, _: object) -> None:
        """See `Observer`."""
        self.attempts += 1
        if self.attempts == self.point.attempt:
            self.thread = threading.Thread(target=self._happen)
            self.thread.start()

    def _happen(self) -> None:
        time.sleep(self.point.delay)
        try:
            self.act()
        except BaseException as error:  # for who waits for it
            self.errors.append(error)

    def ended(self, _: object) -> None:
        """See `Observer`."""

    def check(self) -> None:
        """Note that the fault has happened."""
        assert self.thread is not None, f"the run has only {self.attempts} attempts"
        self.thread.join(BOUND)
        if self.errors:
            raise self.errors[0]


def run_point(number: int, models: Path, folder: Path, router: Router) -> Point:
    """Run the system once, disturbed.

    Args:
        number: of the point.
        models: folder with the FMUs.
        folder: empty, for what is written.
        router: through which all goes.

    Raises:
        AssertionError: results or steps are not those of an undisturbed run, byte for byte, or a
            process is left; names the point.
        DoublestepError: the run failed, though each of these faults can be mended.
    """
    point = Point.of(number)
    through = _system(models, point.settings, folder).with_bus(
        mode="client", connect=(router.endpoint,), discovery_timeout=BOUND
    )
    try:
        if point.fault.part == "master":
            _killed_and_resumed(point, through, folder / "out")
        else:
            trigger = _Trigger(point, lambda: _disturb(point, router))
            simulate(through, output=folder / "out", observers=(trigger,))
            trigger.check()
        assert _files(folder / "out") == _undisturbed(models, point.settings), "other bits"
        is_killed = {n: int(point.fault[:2] == ("kill", n)) for n in _SLAVES}
        assert Result.load(folder / "out").summary["restarts"] == is_killed
        assert not _nodes(), "a slave is left"
    except BaseException as error:
        error.add_note(f"point {number}: {point}")
        raise
    return point


def _system(models: Path, settings: str, folder: Path) -> System:
    folder.mkdir(exist_ok=True)
    simulation = _SIMULATION + settings
    fmus = [models / f"{name}.fmu" for name in _SLAVES]
    return load_system(system_file(folder, *fmus, simulation=simulation))


@cache
def _undisturbed(models: Path, settings: str) -> tuple[bytes, bytes]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate(_system(models, settings, folder), output=folder / "out", in_process=True)
        return _files(folder / "out")


def _files(folder: Path) -> tuple[bytes, bytes]:
    return (folder / "results.csv").read_bytes(), (folder / "steps.csv").read_bytes()


def _disturb(point: Point, router: Router) -> None:
    kind, slave, part = point.fault
    if kind == "cut":
        router.cut(point.duration)
        return
    process = _nodes()[slave]
    if part == "worker":
        process = worker_of(process)
    if kind == "kill":
        process.kill()
        return
    process.suspend()
    time.sleep(point.duration)
    process.resume()


def _killed_and_resumed(point: Point, system: System, out: Path) -> None:
    """In a process of its own, whose end ends its slaves, too."""
    context = multiprocessing.get_context("spawn")
    master = context.Process(target=_die, args=(point, system, out))
    master.start()
    nodes: dict[int, psutil.Process] = {}
    while master.is_alive():
        nodes |= {node.pid: node for node in _nodes(psutil.Process(master.pid)).values()}
        master.join(0.01)
    assert master.exitcode == -signal.SIGKILL
    _, alive = psutil.wait_procs(nodes.values(), timeout=BOUND)
    assert not alive, "a slave outlives its master"
    resume(out)


def _die(point: Point, system: System, out: Path) -> None:
    kill = partial(os.kill, os.getpid(), signal.SIGKILL)
    simulate(system, output=out, observers=(_Trigger(point, kill),))


def _nodes(master: psutil.Process | None = None) -> dict[str, psutil.Process]:
    """The nodes that a process launched, by the names of their slaves."""
    nodes = {}
    for child in (master or psutil.Process()).children():
        try:
            words = child.cmdline()
        except psutil.NoSuchProcess:
            continue
        if "serve" in words and "--name" in words:
            nodes[words[words.index("--name") + 1]] = child
    return nodes
