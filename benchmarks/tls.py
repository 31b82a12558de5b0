"""An attempted double step over TLS against the same over TCP, attempt by attempt in turn."""

import tempfile
import threading
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.quarter_car import ESTIMATOR_NAMES, system
from master_node.coupling.coupled_system import resolve
from master_node.hosts.opening import slaves_on_bus
from master_node.observing.observers import Attempt, RunEnd, RunStart
from master_node.running.co_simulation import CoSimulation
from master_node.slaves.group import SlaveGroup
from master_node.system.system import System
from protocol.bus.credentials import Role
from slave_node.certificates import Host, make_certificates

_WARM_UP = 200
_BOUND = 60.0


class InTurn:
    """An observer that times attempts and lets another run go on after each.

    Args:
        mine: is released when it is this run's turn.
        others: is released when it is the other one's.
    """

    def __init__(self, mine: threading.Semaphore, others: threading.Semaphore) -> None:
        self._mine = mine
        self._others = others
        self._times: list[float] = []
        self._last = 0.0

    def started(self, _: RunStart) -> None:
        """Wait for the first turn."""
        self._mine.acquire(timeout=_BOUND)
        self._last = perf_counter()

    def attempted(self, _: Attempt) -> None:
        """One attempt is over."""
        self._times.append(perf_counter() - self._last)
        self._others.release()
        self._mine.acquire(timeout=_BOUND)
        self._last = perf_counter()

    def ended(self, _: RunEnd) -> None:
        """Hold up the other one no more."""
        self._others.release(10**6)

    @property
    def median(self) -> float:
        """Median time of the attempts after the warm-up [us]."""
        return float(np.median(self._times[_WARM_UP:])) * 1e6


def run() -> list[tuple[str, str, str, str]]:
    """Rows: configuration, median attempt over TLS, over TCP, ratio."""
    with tempfile.TemporaryDirectory() as folder:
        make_certificates(Path(folder), [Host.parse("here")], [Role.MASTER, Role.SLAVE], 1)
        return [_measure(f"{folder}/here", estimator) for estimator in ("mod", "rich")]


def _measure(certificates: str, estimator: str) -> tuple[str, str, str, str]:
    car = system(estimator=estimator, stop_time=30.0)
    turns = threading.Semaphore(1), threading.Semaphore(0)
    plain, secure = InTurn(*turns), InTurn(*reversed(turns))
    runs = [
        threading.Thread(target=_simulate, args=(car, plain)),
        threading.Thread(target=_simulate, args=(car.with_bus(tls=certificates), secure)),
    ]
    for thread in runs:
        thread.start()
    for thread in runs:
        thread.join()
    return (
        f"{ESTIMATOR_NAMES[estimator]}, k = 1",
        f"{secure.median:.0f} us",
        f"{plain.median:.0f} us",
        f"{secure.median / plain.median:.2f}",
    )


def _simulate(car: System, turns: InTurn) -> None:
    with (
        tempfile.TemporaryDirectory() as logs,
        slaves_on_bus(car, Path(logs)) as slaves,
    ):
        coupled = resolve(car, slaves.descriptions)
        CoSimulation(SlaveGroup(slaves.links), coupled, car, turns).run()
