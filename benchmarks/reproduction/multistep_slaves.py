"""The quarter car's Python slaves with a multistep integrator, which starts anew in every step.

At its tolerance of 1e-6 it leaves errors as large as those in the paper's Table 1.
"""

from __future__ import annotations

from typing import NamedTuple

from benchmarks.quarter_car import EXAMPLE
from benchmarks.reproduction.table_1 import METHODS, PAPER, PYTHON, TIGHT, Measured, PaperRow
from examples.quarter_car import quarter_car
from master_node import System, load_system, simulate


class Chassis(quarter_car.Chassis):
    """The chassis."""

    solver = "BDF"


class Wheel(quarter_car.Wheel):
    """The wheel."""

    solver = "BDF"


class Summary(NamedTuple):
    """Figures of a run in Table 1, but for the time."""

    error: float
    steps: int
    rejections: int


ROWS = tuple(row for row in PAPER if row.method != TIGHT)
"""The rows that are run: the smaller tolerance takes too long with this integrator."""


def summary(row: PaperRow) -> Summary:
    """The run of one of `ROWS` with these slaves, in process."""
    python = load_system(EXAMPLE / PYTHON)
    classes = {"chassis": Chassis, "wheel": Wheel}
    system = System(
        simulation=python.simulation.model_dump(exclude_unset=True),
        slaves={
            name: {
                "model": f"{__name__}:{classes[name].__name__}",
                "parameters": slave.parameters,
            }
            for name, slave in python.slaves.items()
        },
        connections=python.connections,
    ).with_simulation(preset="paper", order=row.order, **METHODS[row.method])
    run = Measured(simulate(system, in_process=True))
    return Summary(run.error, run.steps, run.rejections)
