"""Figure 6: displacement-force coupling, ATOL of the force to the letter and of its own size."""

from __future__ import annotations

from typing import NamedTuple

from benchmarks.quarter_car import EXAMPLE
from benchmarks.reproduction.local_error_study import ESTIMATORS
from benchmarks.reproduction.table_1 import Measured
from master_node import System, load_system, simulate

FMUS, PYTHON = "displacement_force.toml", "displacement_force_python.toml"

TO_THE_LETTER, IN_KILONEWTON = 1e-3, 1.0
"""ATOL of the force [N]: 1e-3 in SI units, and 1e-3 of a thousand newtons."""

ORDERS = (0, 1)


class Case(NamedTuple):
    """One run of the figure.

    Attributes:
        absolute: ATOL of the force [N].
        order: k.
        estimator: ``rich`` or ``mod``.
    """

    absolute: float
    order: int
    estimator: str

    @property
    def is_long(self) -> bool:
        """True if it takes so many steps that it is run in process, and by the FMUs only."""
        return self.order == 0 and self.absolute == TO_THE_LETTER


CASES = tuple(
    Case(absolute, order, estimator)
    for absolute in (TO_THE_LETTER, IN_KILONEWTON)
    for order in ORDERS
    for estimator in ESTIMATORS
)


def run(case: Case, file: str) -> Measured:
    """One case by one kind of slaves: by slave processes if they are FMUs and it is not long."""
    given = load_system(EXAMPLE / file)
    slaves = {name: slave.model_dump(exclude_unset=True) for name, slave in given.slaves.items()}
    slaves["wheel"]["tolerances"] = {"F": {"absolute": case.absolute}}
    system = System(
        simulation=given.simulation.model_dump(exclude_unset=True),
        slaves=slaves,
        connections=given.connections,
        bus={"pin": True},
        base=given.base,
    ).with_simulation(preset="paper", order=case.order, estimator=case.estimator)
    return Measured(simulate(system, in_process=case.is_long or file == PYTHON))
