"""Resident memory of master and slaves after 10 % and at the end of a million double steps."""

import os
import tempfile
from pathlib import Path

import psutil

from benchmarks.quarter_car import system
from master_node.coupling.coupled_system import resolve
from master_node.hosts.opening import slaves_on_bus
from master_node.observing.observers import Attempt, Observers, RunEnd, RunStart
from master_node.results import ResultsWriter
from master_node.running.co_simulation import CoSimulation
from master_node.slaves.group import SlaveGroup

ATTEMPTS = int(os.environ.get("DOUBLESTEP_MEMORY_ATTEMPTS", "1000000"))
H = 1e-3


class _Memory:
    """Reads the resident set sizes of this process and of all below it, twice."""

    def __init__(self) -> None:
        self.tables: list[dict[str, int]] = []
        self.attempts = 0

    def started(self, _: RunStart) -> None:
        """Nothing yet."""

    def attempted(self, _: Attempt) -> None:
        """Count, and read at 10 % and at the end."""
        self.attempts += 1
        if self.attempts in (ATTEMPTS // 10, ATTEMPTS - 1):
            self.tables.append(_resident())

    def ended(self, _: RunEnd) -> None:
        """Nothing to close."""


def _resident() -> dict[str, int]:
    own = psutil.Process()
    table = {"master": own.memory_info().rss}
    slaves = [p for p in own.children() if "slave_node" in " ".join(p.cmdline())]
    for number, slave in enumerate(slaves):
        table[f"slave {number}, node"] = slave.memory_info().rss
        for child in slave.children():
            if "resource_tracker" not in " ".join(child.cmdline()):
                table[f"slave {number}, worker"] = child.memory_info().rss
    return table


def run() -> list[tuple[str, str, str, str]]:
    """Rows: process, resident memory after 10 %, at the end, growth."""
    car = system(stop_time=2 * H * ATTEMPTS, initial_step_size=H, largest_step_size=H)
    memory = _Memory()
    with tempfile.TemporaryDirectory() as directory, slaves_on_bus(car, Path(directory)) as slaves:
        coupled = resolve(car, slaves.descriptions)
        writer = ResultsWriter(Path(directory) / "results", {})
        observers = Observers([memory, writer])
        CoSimulation(SlaveGroup(slaves.links), coupled, car, observers).run()
    first, last = memory.tables
    return [
        (
            name,
            f"{first[name] / 2**20:.1f} MiB",
            f"{last[name] / 2**20:.1f} MiB",
            f"{(last[name] - first[name]) / 2**20:+.1f} MiB",
        )
        for name in first
    ]
