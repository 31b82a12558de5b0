"""Stiff coupled systems: explicit, iterated and chosen double steps, with errors and costs.

python -m benchmarks stiff [--tolerances 1e-3 1e-5] [--systems NAME ...] [--most N]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.stiff_systems import SYSTEMS, reference
from master_node import Result, simulate
from master_node.observing.observers import Attempt, RunEnd, RunStart
from protocol.errors import DoublestepError

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
COUPLINGS = ("auto", "explicit", "implicit")
MOST = 3000
"""Double steps after which a run is broken off."""

COLUMNS = (
    "system",
    "tolerance",
    "coupling",
    "outcome",
    "do_steps",
    "iterated",
    "error / tolerance",
    "warnings",
)


class TooManyAttemptsError(Exception):
    """A run that takes too long."""


class AttemptLimit:
    """An observer that breaks a run off.

    Args:
        most: attempts.
    """

    def __init__(self, most: int) -> None:
        self._left = most
        self._end = 0.0
        self.do_steps = 0
        self.time = 0.0

    def started(self, start: RunStart) -> None:
        """Keep where the counters are."""
        self._slaves = start.statistics

    def attempted(self, attempt: Attempt) -> None:
        """Count it."""
        self._left -= 1
        if attempt.accepted:
            self.time = attempt.time + 2.0 * attempt.step_size
        if self._left < 0:
            self.do_steps = max(slave.do_steps for slave in self._slaves.values())
            raise TooManyAttemptsError

    def ended(self, _: RunEnd) -> None:
        """Nothing to close."""


@dataclass(frozen=True)
class Measured:
    """A run of one of the systems.

    Attributes:
        outcome: in words.
        do_steps: of the busiest slave; with ``more``, those by which the run was broken off.
        more: whether it was.
        iterated: accepted double steps that were iterated.
        error: largest deviation of any output at any communication point, in units of the
            tolerance times the output's own range; NaN where the run did not get to its end.
        warnings: how many.
    """

    outcome: str
    do_steps: int
    more: bool
    iterated: int
    error: float
    warnings: int

    @property
    def cells(self) -> tuple[str, ...]:
        """For a table."""
        if self.more:
            return (self.outcome, f"more than {self.do_steps}", "", "", "")
        if np.isnan(self.error):
            return (self.outcome, "", "", "", "")
        numbers = (str(self.do_steps), str(self.iterated), f"{self.error:.2g}", str(self.warnings))
        return (self.outcome, *numbers)


def measure(name: str, tolerance: float, most: int = MOST, **simulation: Any) -> Measured:
    """Run one of the systems in process.

    Args:
        name: of the system.
        tolerance: RTOL and ATOL.
        most: double steps after which it is broken off.
        **simulation: settings.
    """
    limit = AttemptLimit(most)
    system = SYSTEMS[name].system(tolerance, **simulation)
    try:
        result = simulate(system, in_process=True, observers=[limit])
    except TooManyAttemptsError:
        return Measured(f"at t = {limit.time:.3g} s", limit.do_steps, True, 0, float("nan"), 0)
    except DoublestepError as error:
        return Measured(f"failed: {type(error).__name__}", 0, False, 0, float("nan"), 0)
    summary = result.summary
    return Measured(
        summary["outcome"],
        max(summary["do_steps"].values()),
        False,
        summary["iterated_double_steps"],
        largest_error(name, result) / tolerance,
        len(summary["warnings"]),
    )


def largest_error(name: str, result: Result) -> float:
    """Largest deviation of a run of ``name``, in units of each output's own range."""
    exact = reference(name)
    found = np.array([result[output] for output in exact.whole.names]).T
    return float((np.abs(found - exact.at(result.time)) / exact.span).max())


def run(
    tolerances: Sequence[float] = TOLERANCES,
    systems: Sequence[str] = tuple(SYSTEMS),
    most: int = MOST,
    couplings: Sequence[str] = COUPLINGS,
) -> Iterator[tuple[str, ...]]:
    """One row for each run."""
    for name in systems:
        for tolerance in tolerances:
            for coupling in couplings:
                measured = measure(name, tolerance, most, coupling=coupling)
                yield (name, f"{tolerance:g}", coupling, *measured.cells)


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks stiff", description=__doc__)
    parser.add_argument("--tolerances", nargs="+", type=float, default=TOLERANCES)
    parser.add_argument("--systems", nargs="+", default=tuple(SYSTEMS), metavar="NAME")
    parser.add_argument("--couplings", nargs="+", default=COUPLINGS, choices=COUPLINGS)
    parser.add_argument("--most", type=int, default=MOST, help="double steps of a run")
    chosen = parser.parse_args(arguments)
    print(f"| {' | '.join(COLUMNS)} |")
    print("|" + "---|" * len(COLUMNS))
    for row in run(chosen.tolerances, chosen.systems, chosen.most, chosen.couplings):
        print(f"| {' | '.join(row)} |", flush=True)
