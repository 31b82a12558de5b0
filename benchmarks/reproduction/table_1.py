"""Table 1 of the paper: its figures, and the same twelve runs by real slave processes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from benchmarks.quarter_car import EXAMPLE
from benchmarks.reproduction.exact_quarter_car import FloatArray, outputs
from master_node import Result, load_system, simulate


class PaperRow(NamedTuple):
    """One row of Table 1 as printed.

    Attributes:
        method: which of `METHODS`.
        order: k.
        error: mean global error.
        time: computing time [s].
        steps: accepted communication steps.
        rejections: rejected double steps.
    """

    method: str
    order: int
    error: float
    time: float
    steps: int
    rejections: int


METHODS: Mapping[str, Mapping[str, Any]] = {
    "H = 1 ms, slaves 1e-6": {"estimator": "none", "slave_tolerance": 1e-6},
    "H = 1 ms, slaves 1e-8": {"estimator": "none", "slave_tolerance": 1e-8},
    "EST_Rich": {"estimator": "rich", "slave_tolerance": 1e-6},
    "EST_mod": {"estimator": "mod", "slave_tolerance": 1e-6},
}
"""The four parts of Table 1 with their settings; macTOL = 1e-4 and H_0 = 1 ms are the file's."""

LOOSE, TIGHT, RICH, MOD = METHODS

PAPER = (
    PaperRow(LOOSE, 0, 8.922e-4, 33.335, 4000, 0),
    PaperRow(LOOSE, 1, 4.094e-4, 29.295, 4000, 0),
    PaperRow(LOOSE, 2, 4.138e-4, 31.022, 4000, 0),
    PaperRow(TIGHT, 0, 5.301e-4, 51.280, 4000, 0),
    PaperRow(TIGHT, 1, 6.049e-5, 43.364, 4000, 0),
    PaperRow(TIGHT, 2, 1.967e-5, 43.073, 4000, 0),
    PaperRow(RICH, 0, 1.050e-3, 28.361, 1610, 18),
    PaperRow(RICH, 1, 3.197e-4, 10.379, 402, 20),
    PaperRow(RICH, 2, 3.180e-4, 7.050, 210, 20),
    PaperRow(MOD, 0, 1.061e-3, 19.712, 1612, 19),
    PaperRow(MOD, 1, 3.317e-4, 7.057, 413, 16),
    PaperRow(MOD, 2, 2.735e-4, 4.835, 218, 17),
)

FMUS, PYTHON = "displacement.toml", "displacement_python.toml"
"""Displacement-displacement coupling by both kinds of slaves."""


@dataclass(frozen=True, eq=False)
class Measured:
    """A run with what Table 1 tells of it."""

    result: Result

    @property
    def steps(self) -> int:
        """Accepted communication steps."""
        return int(self.result.summary["communication_steps"])

    @property
    def rejections(self) -> int:
        """Rejected double steps."""
        return int(self.result.summary["rejected_double_steps"])

    @property
    def do_steps(self) -> int:
        """Number of do_steps of each slave."""
        return max(map(int, self.result.summary["do_steps"].values()))

    @property
    def time(self) -> float:
        """Wall time of the steps, without starting the processes [s]."""
        return float(self.result.summary["wall_time"])

    @property
    def errors(self) -> FloatArray:
        """Euclidean norm of the outputs' errors at each communication point, shape (n,)."""
        exact = outputs(self.result.names, self.result.time)
        return np.asarray(np.linalg.norm(self.result.outputs - exact, axis=1))

    @property
    def error(self) -> float:
        """Mean of `errors`."""
        return float(self.errors.mean())


def measure(file: str, *, in_process: bool = False, **simulation: Any) -> Measured:
    """Run a system file of the quarter car by the paper's method.

    Args:
        file: its name.
        in_process: no slave processes, for runs of which no time is told.
        **simulation: settings beside the paper's.
    """
    system = load_system(EXAMPLE / file).with_simulation(preset="paper", **simulation)
    return Measured(simulate(system.with_bus(pin=True), in_process=in_process))


def measure_row(row: PaperRow, file: str, *, in_process: bool = False, **more: Any) -> Measured:
    """The run of one row of Table 1, with ``more`` settings."""
    settings = {**METHODS[row.method], **more}
    return measure(file, in_process=in_process, order=row.order, **settings)


CORNERS = tuple(
    {"alpha": alpha, "theta_min": theta_min, "theta_max": theta_max}
    for alpha in (0.8, 0.9)
    for theta_min in (0.2, 0.5)
    for theta_max in (1.5, 5.0)
)
"""The ends of the ranges that the paper gives for its step size control."""


class Spread(NamedTuple):
    """Smallest and largest number over `CORNERS`."""

    steps: tuple[int, int]
    rejections: tuple[int, int]


def spread(row: PaperRow) -> Spread:
    """Effect of alpha, theta_min and theta_max on a row."""
    runs = [measure_row(row, FMUS, in_process=True, **corner) for corner in CORNERS]
    steps = [run.steps for run in runs]
    rejections = [run.rejections for run in runs]
    return Spread((min(steps), max(steps)), (min(rejections), max(rejections)))


def controlled() -> Iterator[PaperRow]:
    """The rows with step size control."""
    return (row for row in PAPER if row.method in (RICH, MOD))
