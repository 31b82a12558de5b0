"""Cost of saving states by forking: a whole double step, and a single save and restore."""

import tempfile
from collections import defaultdict
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np
import psutil

from benchmarks.interleaved import Interleaved
from benchmarks.quarter_car import ESTIMATOR_NAMES, EXAMPLE, system
from master_node.coupling.coupled_system import resolve
from master_node.hosts.opening import slaves_in_process, slaves_on_bus
from master_node.preparing.configuring import configure
from master_node.running.co_simulation import CoSimulation
from master_node.slaves.group import SlaveGroup
from protocol.calls import Configure, Initialize
from slave_node.loading import load_slave

BLOCKS = 3
CYCLES = 300
H = 1e-3


def run() -> list[tuple[str, str, str, str]]:
    """Rows: what, by forking, natively, ratio."""
    rows = [
        _double_steps(estimator, in_process=in_process)
        for in_process in (False, True)
        for estimator in ("mod", "rich")
    ]
    for model in ("wheel.fmu", "quarter_car.py:Wheel"):
        rows += _single_calls(model)
    return rows


def _double_steps(estimator: str, *, in_process: bool) -> tuple[str, str, str, str]:
    """Short runs of both kinds in turn."""
    attempts: dict[str, list[float]] = {"fork": [], "native": []}
    for _ in range(BLOCKS):
        for kind, medians in attempts.items():
            medians.append(_attempt(kind, estimator, in_process=in_process))
    fork, native = (median(medians) for medians in attempts.values())
    where = "in process" if in_process else "over Zenoh"
    return (
        f"attempted double step {where}, {ESTIMATOR_NAMES[estimator]}, k = 1",
        f"{fork:.0f} us",
        f"{native:.0f} us",
        f"{fork / native:.2f}",
    )


def _attempt(kind: str, estimator: str, *, in_process: bool) -> float:
    """Median attempt [us]."""
    car = system(estimator=estimator, stop_time=2.0, largest_step_size=2e-3)
    car = car.with_slaves(state=kind)
    timing = Interleaved(lambda: None, warm_up=50)
    with (
        tempfile.TemporaryDirectory() as logs,
        slaves_in_process(car) if in_process else slaves_on_bus(car, Path(logs)) as slaves,
    ):
        coupled = resolve(car, configure(slaves.links, car, slaves.descriptions))
        CoSimulation(SlaveGroup(slaves.links), coupled, car, timing).run()
    return timing.medians()[0]


def _single_calls(model: str) -> list[tuple[str, str, str, str]]:
    times: dict[str, dict[str, float]] = {}
    size = 0.0
    for kind in ("native", "fork"):
        with tempfile.TemporaryDirectory() as scratch:
            slave = load_slave(
                model, EXAMPLE, "wheel", Path(scratch), configuration=Configure(state_kind=kind)
            )
            try:
                slave.initialize(
                    Initialize(
                        start_time=0.0,
                        stop_time=None,
                        relative_tolerance=1e-6,
                        start_values={},
                        inputs=("x_c", "v_c"),
                        outputs=("x", "v"),
                    )
                )
                slave.exit_initialization_mode()
                times[kind] = _medians(slave)
                if kind == "fork":
                    size = max(map(_resident, psutil.Process().children(recursive=True)))
            finally:
                slave.close()
    return [
        (
            f"{what}, {model}, a process of {size:.0f} MiB",
            f"{fork:.0f} us",
            f"{times['native'][what]:.0f} us",
            "",
        )
        for what, fork in times["fork"].items()
    ]


def _resident(process: psutil.Process) -> float:
    """Memory of a process [MiB]; 0 if it has just ended."""
    try:
        return float(process.memory_info().rss) / 2**20
    except psutil.NoSuchProcess:
        return 0.0


def _medians(slave) -> dict[str, float]:
    """Median time of each call [us]; a step belongs to what came before it.

    Copies of processes are not waited for when they are asked for. What they cost shows in the
    steps, and in the whole cycle, which leaves no pause for them as a master does.
    """
    times: dict[str, list[float]] = defaultdict(list)
    inputs = np.array([[0.1, 0.0]])
    time = 0.0

    def timed(what: str, call, *arguments):
        begin = perf_counter()
        result = call(*arguments)
        times[what].append((perf_counter() - begin) * 1e6)
        return result

    def step(what: str, start: float) -> None:
        slave.set_inputs(inputs)
        timed(what, slave.do_step, start, H, True)
        slave.get_outputs(0)

    for _ in range(CYCLES):
        begin = perf_counter()
        state = timed("save", slave.get_state)
        step("first step after a save", time)
        step("another step", time + H)
        timed("restore and keep", slave.set_state, state)
        step("first step after restore and keep", time)
        timed("restore and free", slave.set_state_and_free, state)
        step("first step after restore and free", time)
        times["one save, two restores, four steps"].append((perf_counter() - begin) * 1e6)
        time += H
    return {what: median(values) for what, values in times.items()}
