"""Runs of the example systems in process, each with its error against the exact solution.

A run that was made once is kept: several tables look at the same one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.reproduction import exact_quarter_car
from examples.oscillators.oscillators import reference_solution
from master_node import Result, System, load_system, simulate

FloatArray = NDArray[np.float64]
Reference = Callable[[Sequence[str], FloatArray], FloatArray]
"""From names and times [s], shape (n,), to the exact outputs, shape (n, n_names)."""

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
"""RTOL and ATOL of the tables that go over five decades."""

EXAMPLES = Path(__file__).parents[2] / "examples"


QUARTER_CAR, FORCE, KICK = "quarter car", "quarter car, force", "kick"

SYSTEMS: dict[str, tuple[str, Reference]] = {
    QUARTER_CAR: ("quarter_car/displacement.toml", exact_quarter_car.outputs),
    FORCE: ("quarter_car/displacement_force.toml", exact_quarter_car.outputs),
    **{
        name: (f"oscillators/{name}.toml", partial(reference_solution, name))
        for name in ("two_mass", "van_der_pol", "chain", KICK)
    },
}
"""System file, relative to ``examples/``, and exact solution, by a name."""

SMOOTH = (QUARTER_CAR, "two_mass", "van_der_pol", "chain")
"""The systems without feed-through and without jumps."""


@dataclass(frozen=True, eq=False)
class Run:
    """Result of a run, and its error.

    Attributes:
        result: of the run.
        deviations: result minus exact solution, shape (n, m), as ``result.outputs``.
    """

    result: Result
    deviations: FloatArray

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
        """Number of do_steps of each slave; of the busiest where they differ."""
        return int(max(self.result.summary["do_steps"].values()))

    @property
    def round_trips(self) -> int:
        """Requests one after the other, those to several slaves at the same time as one."""
        return int(self.result.summary["round_trips"])

    @cached_property
    def errors(self) -> FloatArray:
        """Euclidean norm over all outputs but those of sources at each point, shape (n,)."""
        moving = [not name.startswith("source.") for name in self.result.names]
        errors: FloatArray = np.linalg.norm(self.deviations[:, moving], axis=1)
        return errors

    @property
    def mean_error(self) -> float:
        """Mean of the errors over all points."""
        return float(self.errors.mean())

    @property
    def largest_error(self) -> float:
        """The largest error of all points."""
        return float(self.errors.max())


def run(name: str, tolerance: float | None = None, **simulation: Any) -> Run:
    """Run a system in process, or give the run that was made already.

    Args:
        name: one of `SYSTEMS`.
        tolerance: RTOL and ATOL of all outputs; None: those of the file.
        **simulation: settings that override the file's.
    """
    if tolerance is not None:
        simulation |= {"relative_tolerance": tolerance, "absolute_tolerance": tolerance}
    return _run(name, tuple(sorted(simulation.items())))


@cache
def _run(name: str, settings: tuple[tuple[str, Any], ...]) -> Run:
    return run_variant(name, load(name), **dict(settings))


def run_variant(name: str, system: System, **simulation: Any) -> Run:
    """Run a variant of one of `SYSTEMS` that has its exact solution; not kept."""
    result = simulate(system, in_process=True, **simulation)
    return Run(result, result.outputs - SYSTEMS[name][1](result.names, result.time))


@cache
def load(name: str) -> System:
    """The system as its file says."""
    return load_system(EXAMPLES / SYSTEMS[name][0])


def varied(
    system: System, slaves: Mapping[str, Mapping[str, Any]], without: Sequence[str] = ()
) -> System:
    """A system with other settings of single slaves.

    Args:
        system: to vary.
        slaves: settings by the slaves' names.
        without: keys of the ``[simulation]`` table to leave to their defaults.
    """
    simulation = system.simulation.model_dump(exclude_unset=True, exclude=set(without))
    tables = {
        name: slave.model_dump(exclude_unset=True) | dict(slaves.get(name, {}))
        for name, slave in system.slaves.items()
    }
    return System(
        simulation=simulation,
        slaves=tables,
        connections=system.connections,
        bus=system.bus,
        base=system.base,
        source=system.source,
    )
