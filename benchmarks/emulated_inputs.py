"""Emulated input derivatives against native ones on the quarter car: steps, errors, time.

The FMUs without input derivatives have the same equations and the same solver. Neither gives
derivatives of its outputs here, so that the only difference is how inputs are followed.
"""

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.quarter_car import ESTIMATOR_NAMES, EXAMPLE
from examples.capabilities.build import FMUS
from examples.fmu_framework.build_fmus import build
from examples.quarter_car.quarter_car import exact_solution
from master_node import System, load_system, simulate

CASES = [
    ("mod", 1, 1e-4),
    ("mod", 1, 1e-6),
    ("rich", 1, 1e-4),
    ("rich", 1, 1e-6),
    ("mod", 2, 1e-4),
    ("mod", 3, 1e-4),
    ("mod", 3, 1e-6),
]
STATES = ("chassis.x", "chassis.v", "wheel.x", "wheel.v")
NAMES = ("chassis", "wheel")


class _Run(NamedTuple):
    steps: int
    error: float
    time: float
    """Time of the slaves for one do_step [s]."""


def _measured(system: System) -> _Run:
    result = simulate(system, in_process=True)
    states = np.stack([result[name] for name in STATES], axis=1)
    errors = np.linalg.norm(states - exact_solution(result.time), axis=1)
    summary = result.summary
    time = sum(summary["compute_time"].values()) / sum(summary["do_steps"].values())
    return _Run(summary["communication_steps"], float(errors.mean()), time)


def run() -> list[tuple[str, ...]]:
    """Rows: configuration, steps, mean errors and slaves' time, each native / emulated / held."""
    wanted = [f"{name}_no_derivatives" for name in NAMES]
    rows = []
    with tempfile.TemporaryDirectory() as directory:
        build([fmu for fmu in FMUS if fmu.name in wanted], Path(directory))
        for estimator, order, tolerance in CASES:
            native = load_system(EXAMPLE / "displacement.toml").with_simulation(
                estimator=estimator,
                order=order,
                derivative_points=0,
                relative_tolerance=tolerance,
                absolute_tolerance=tolerance,
            )
            emulated = held = native
            for name in NAMES:
                model = str(Path(directory) / f"{name}_no_derivatives.fmu")
                emulated = emulated.with_slave(name, model=model)
                held = held.with_slave(name, model=model, input_substeps=1)
            runs = [_measured(system) for system in (native, emulated, held)]
            rows.append(
                (
                    f"{ESTIMATOR_NAMES[estimator]}, k = {order}, RTOL {tolerance:g}",
                    " / ".join(str(run.steps) for run in runs),
                    " / ".join(f"{run.error:.2e}" for run in runs),
                    " / ".join(f"{1e6 * run.time:.0f} us" for run in runs),
                )
            )
    return rows
