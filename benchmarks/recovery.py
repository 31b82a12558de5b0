"""Time until a killed slave process is noticed, and until the run goes on."""

import logging
import statistics
import tempfile
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from time import perf_counter, sleep

import psutil

from benchmarks.quarter_car import system
from master_node.coupling.coupled_system import resolve
from master_node.hosts.opening import slaves_on_bus
from master_node.observing.observers import Attempt, RunEnd, RunStart
from master_node.resuming.checkpoints import Checkpoints
from master_node.running.co_simulation import CoSimulation
from master_node.slaves.group import SlaveGroup
from master_node.slaves.link import SlaveLink
from master_node.slaves.restorable import RestorableSlave

_KILLS = 20
_ATTEMPTS_BETWEEN = 150
_VICTIM = "wheel"


def run() -> list[tuple[str, str, str]]:
    """Rows: what is killed, medians until it is noticed and until the next double step is done."""
    logging.getLogger("master_node").setLevel(logging.ERROR)
    return [_measure("node", _node), _measure("worker", _worker)]


class _Killer:
    """An observer that has a process killed in mid step now and then, and takes the times."""

    def __init__(self, victim: Callable[[], psutil.Process]) -> None:
        self.noticed: list[float] = []
        self.going: list[float] = []
        self._victim = victim
        self._draw = Random(2012)
        self._attempts = 0
        self._killed: float | None = None

    def started(self, _: RunStart) -> None:
        pass

    def attempted(self, _: Attempt) -> None:
        self._attempts += 1
        if len(self.noticed) > len(self.going) and self._killed is not None:
            self.going.append(perf_counter() - self._killed)
            self._killed, self._attempts = None, 0
        if self._attempts == _ATTEMPTS_BETWEEN and len(self.noticed) < _KILLS:
            victim, wait = self._victim(), self._draw.uniform(0.0, 2e-3)
            threading.Thread(target=self._kill, args=(victim, wait)).start()

    def ended(self, _: RunEnd) -> None:
        pass

    def restart(self, restart: Callable[[str], SlaveLink], name: str) -> SlaveLink:
        """Take the time before it is started again."""
        assert self._killed is not None
        self.noticed.append(perf_counter() - self._killed)
        return restart(name)

    def _kill(self, victim: psutil.Process, wait: float) -> None:
        sleep(wait)
        self._killed = perf_counter()
        victim.kill()


def _measure(what: str, victim: Callable[[], psutil.Process]) -> tuple[str, str, str]:
    attempts = (_KILLS + 2) * (_ATTEMPTS_BETWEEN + 2)
    car = system(largest_step_size=1e-3, stop_time=2e-3 * attempts)
    killer = _Killer(victim)
    with tempfile.TemporaryDirectory() as logs, slaves_on_bus(car, Path(logs)) as slaves:
        assert slaves.restarts is not None
        restart = partial(killer.restart, slaves.restarts.restart)
        restorable = [
            RestorableSlave(name, link, slaves.descriptions[name], partial(restart, name))
            for name, link in slaves.links.items()
        ]
        coupled = resolve(car, slaves.descriptions)
        links = {slave.name: slave for slave in restorable}
        checkpoints = Checkpoints(restorable)
        CoSimulation(SlaveGroup(links), coupled, car, killer, checkpoints=checkpoints).run()
    assert len(killer.going) == _KILLS
    return (
        f"{what}, {_KILLS} times",
        f"{1e3 * statistics.median(killer.noticed):.0f} ms",
        f"{statistics.median(killer.going):.2f} s",
    )


def _node() -> psutil.Process:
    for child in psutil.Process().children():
        words = child.cmdline()
        if "slave_node" in words and _VICTIM in words:
            return child
    raise ProcessLookupError(_VICTIM)


def _worker() -> psutil.Process:
    for child in _node().children():
        words = child.cmdline()
        if any("spawn_main" in word for word in words) and not any(
            "resource_tracker" in word for word in words
        ):
            return child
    raise ProcessLookupError(_VICTIM)
