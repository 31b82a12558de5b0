"""Cost of 5 000 connected variables: a double step of two slaves, against one with ten."""

import importlib.util
import sys
import tempfile
from pathlib import Path
from types import ModuleType

from benchmarks.interleaved import Interleaved
from master_node import System
from master_node.coupling.coupled_system import resolve
from master_node.hosts.opening import slaves_in_process, slaves_on_bus
from master_node.running.co_simulation import CoSimulation
from master_node.slaves.group import SlaveGroup

CAPABILITIES = Path(__file__).parents[1] / "examples" / "capabilities"


def run() -> list[tuple[str, str, str, str]]:
    """Rows: configuration, 5 000 variables, 10 variables, ratio."""
    with tempfile.TemporaryDirectory() as directory:
        _build_script().build(Path(directory))
        rows = []
        for in_process in (False, True):
            many, few = (
                _attempt(Path(directory) / f"{fmu}.fmu", in_process=in_process)
                for fmu in ("many_variables", "few_variables")
            )
            where = "in process" if in_process else "over Zenoh"
            rows.append(
                (f"EST_mod, k = 1, {where}", f"{many:.0f} us", f"{few:.0f} us", f"{many / few:.2f}")
            )
        return rows


def _build_script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("build_fmus", CAPABILITIES / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["build_fmus"] = module
    spec.loader.exec_module(module)
    return module


def _attempt(fmu: Path, *, in_process: bool) -> float:
    """Median attempted double step [us]."""
    system = System(
        simulation={
            "stop_time": 1.0,
            "order": 1,
            "estimator": "mod",
            "initial_step_size": 1e-3,
            "largest_step_size": 1e-3,
        },
        slaves={"a": {"model": str(fmu)}, "b": {"model": str(fmu)}},
        connections=[("a.y", "b.u"), ("b.y", "a.u")],
    )
    timing = Interleaved(lambda: None, warm_up=50)
    with (
        tempfile.TemporaryDirectory() as logs,
        slaves_in_process(system) if in_process else slaves_on_bus(system, Path(logs)) as slaves,
    ):
        coupled = resolve(system, slaves.descriptions)
        CoSimulation(SlaveGroup(slaves.links), coupled, system, timing).run()
    return timing.medians()[0]
