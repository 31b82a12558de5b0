"""An attempted double step over Zenoh against an empty fan-out to two processes."""

import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

from benchmarks.interleaved import Interleaved
from benchmarks.quarter_car import ESTIMATOR_NAMES, system
from master_node.coupling.coupled_system import resolve
from master_node.hosts.opening import slaves_on_bus
from master_node.running.co_simulation import CoSimulation
from master_node.slaves.group import SlaveGroup
from protocol.bus.endpoints import Endpoints, free_endpoint
from protocol.bus.zenoh import ZenohBus


def run() -> list[tuple[str, str, str, str]]:
    """Rows: configuration, median attempt, median empty fan-out, ratio."""
    endpoint = free_endpoint()
    bus = ZenohBus(Endpoints(listen=(endpoint,)))
    alive = threading.Semaphore(0)
    bus.watch("echo/*/alive", lambda _, up: alive.release() if up else None)
    echoes = [
        subprocess.Popen([sys.executable, "-m", "benchmarks.echo", endpoint, f"echo/{i}"])
        for i in range(2)
    ]
    try:
        for _ in echoes:
            alive.acquire(timeout=30.0)
        callers = [bus.caller(f"echo/{i}", 5.0) for i in range(2)]

        def fan_out() -> None:
            for pending in [caller.send(b"") for caller in callers]:
                pending.result()

        configurations = [("mod", 1), ("rich", 1), ("mod", 3), ("rich", 3)]
        return [
            _measure(fan_out, estimator, order, pin=pin)
            for pin in (False, True)
            for estimator, order in configurations
        ]
    finally:
        for echo in echoes:
            echo.terminate()
            echo.wait(5.0)
        bus.close()


def _measure(
    fan_out: Callable[[], None], estimator: str, order: int, *, pin: bool
) -> tuple[str, str, str, str]:
    car = system(estimator=estimator, order=order, stop_time=30.0).with_bus(pin=pin)
    timing = Interleaved(fan_out)
    with (
        tempfile.TemporaryDirectory() as logs,
        slaves_on_bus(car, Path(logs)) as slaves,
    ):
        coupled = resolve(car, slaves.descriptions)
        statistics = CoSimulation(SlaveGroup(slaves.links), coupled, car, timing).run()
    attempts = statistics.communication_steps // 2 + statistics.rejected_double_steps
    requests = {s.requests / attempts for s in statistics.slaves.values()}
    attempt, empty = timing.medians()
    return (
        f"{ESTIMATOR_NAMES[estimator]}, k = {order}{', --pin' if pin else ''}"
        f" ({'/'.join(f'{r:g}' for r in requests)} requests a slave)",
        f"{attempt:.0f} us",
        f"{empty:.0f} us",
        f"{attempt / empty:.2f}",
    )
