"""One coupled system, measured: ``python -m benchmarks.coupled.measurement NAME FILE SLAVE=FMU``.

Writes one JSON object: how the run with the defaults ended, its warnings, its error against a
reference, and what the cheapest run with fixed steps of no larger error takes.
"""

from __future__ import annotations

import json
import logging
import os
from argparse import ArgumentParser
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count
from math import isfinite
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from benchmarks.coupled.systems import SYSTEMS, CoupledFmus
from master_node import Result, System, simulate
from protocol.errors import DoublestepError
from protocol.signals import FloatArray
from slave_node.fmu.description import describe_fmu

_CONVERGED = 2.0
"""The reference is one where halving the steps changes nothing by more than this [tolerances]."""

_ENOUGH = 0.1
"""Steps are not halved any more once that changes nothing by more than this [tolerances]."""

_DOUBLINGS = 14
_COLUMNS = 3
"""So many terms of the error are extrapolated away."""

_FEWEST_STEPS = 8
_MOST_OF_DEFAULT = 4.0
"""Fixed runs with more do_steps than this multiple of those of the defaults are not tried."""


@dataclass(frozen=True, slots=True)
class Reference:
    """A converged run with fixed steps.

    Attributes:
        values: of the outputs at the times of comparison, shape (points + 1, m).
        change: by the last halving, in tolerances, where the steps are half as long.
        steps: it has.
    """

    values: FloatArray
    change: float
    steps: int


@dataclass(frozen=True, slots=True)
class Measured:
    """Findings about one system.

    Attributes:
        outcome: of the run with the defaults; "refused" where it raised.
        message: the sentence of the error, or the remark of the summary.
        warnings: of this run.
        do_steps: of all slaves.
        error: the largest one, in tolerances; None: there is nothing to compare.
        where: the output with the largest error.
        reference_change, reference_steps: see `Reference`; None: none was found.
        fixed_do_steps, fixed_order, fixed_steps: of the cheapest run with fixed steps that is no
            less accurate; None: none of those that were tried is.
        problem: why there is no reference.
    """

    outcome: str
    message: str = ""
    warnings: tuple[str, ...] = ()
    do_steps: int = 0
    error: float | None = None
    where: str = ""
    reference_change: float | None = None
    reference_steps: int | None = None
    fixed_do_steps: int | None = None
    fixed_order: int | None = None
    fixed_steps: int | None = None
    problem: str = ""


def main() -> None:
    """Measure one system."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=SYSTEMS)
    parser.add_argument("file", type=Path)
    parser.add_argument("fmus", nargs="+")
    parser.add_argument("--seconds", type=float, required=True)
    options = parser.parse_args()
    fmus = dict(word.split("=", 1) for word in options.fmus)
    found = measure(SYSTEMS[options.name], fmus, options.seconds)
    options.file.write_text(json.dumps(asdict(found)), encoding="utf-8")
    os._exit(0)  # what an FMU left running is no part of the result


def measure(coupled: CoupledFmus, fmus: Mapping[str, str], seconds: float) -> Measured:
    """Run a system with the defaults and with fixed steps.

    Args:
        coupled: the system.
        fmus: paths by slave.
        seconds: no run with fixed steps is begun later than that [s].
    """
    deadline = monotonic() + seconds
    system = system_of(coupled, fmus)
    found, result = run_with_defaults(system)
    try:
        scale = Scale(coupled, system)
        reference = find_reference(system, scale, deadline)
    except DoublestepError as error:
        return replace(found, problem=str(error))
    found = replace(found, reference_change=reference.change, reference_steps=reference.steps)
    if result is None or reference.change > _CONVERGED:
        return found
    error, where = scale.error(result, reference.values)
    found = replace(found, error=error, where=where)
    cheapest = find_cheapest(
        system,
        scale,
        reference,
        error=max(error, 2.0 * reference.change),
        do_steps=found.do_steps,
        deadline=deadline,
    )
    return replace(found, **cheapest)


def system_of(coupled: CoupledFmus, fmus: Mapping[str, str]) -> System:
    """Everything but what the system needs is as it is by default; results at equal distances."""
    return System(
        simulation={
            "stop_time": coupled.stop_time,
            "output_interval": coupled.stop_time / coupled.points,
        },
        slaves={
            name: {"model": fmus[name], "parameters": dict(slave.parameters)}
            for name, slave in coupled.slaves.items()
        },
        connections=[{"from": source, "to": target} for source, target in coupled.connections],
        inputs=dict(coupled.inputs),
    )


def run_with_defaults(system: System) -> tuple[Measured, Result | None]:
    """Over the bus, as ``master-node run`` does it."""
    words = _Words()
    logging.getLogger("master_node").addHandler(words)
    try:
        result = simulate(system)
    except DoublestepError as error:
        return Measured("refused", str(error), words.warnings()), None
    finally:
        logging.getLogger("master_node").removeHandler(words)
    summary = result.summary
    found = Measured(summary["outcome"], summary["message"], words.warnings(), _do_steps(result))
    return found, result


class _Words(logging.Handler):
    """Keeps the warnings."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._said: dict[str, None] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler`."""
        self._said[record.getMessage()] = None

    def warnings(self) -> tuple[str, ...]:
        """Each once."""
        return tuple(self._said)


class Scale:
    """The tolerances of a system's outputs: ATOL times the nominal value, and RTOL.

    Args:
        coupled: the system.
        system: the same with the paths of its FMUs.
    """

    def __init__(self, coupled: CoupledFmus, system: System) -> None:
        self.points = coupled.points
        self._rtol = float(system.simulation.relative_tolerance)
        self._atol = float(system.simulation.absolute_tolerance)
        self._nominal = {
            f"{name}.{variable.name}": variable.nominal
            for name, slave in system.slaves.items()
            for variable in describe_fmu(Path(str(slave.model))).variables
        }
        times = np.arange(coupled.points + 1) * (coupled.stop_time / coupled.points)
        self._rows = np.array([not any(np.isclose(t, coupled.jumps)) for t in times])

    def error(self, result: Result, reference: FloatArray) -> tuple[float, str]:
        """See `distance`."""
        names, values = numbers(result)
        return self.distance(names, values, reference)

    def distance(
        self, names: Sequence[str], values: FloatArray, reference: FloatArray
    ) -> tuple[float, str]:
        """The largest one in tolerances, and the output that has it; infinite beside NaN."""
        nominal = np.array([self._nominal[name] for name in names])
        n = min(len(values), len(reference))
        values, reference = values[:n][self._rows[:n]], reference[:n][self._rows[:n]]
        with np.errstate(invalid="ignore", over="ignore"):
            errors = np.abs(values - reference)
            errors /= self._atol * nominal + self._rtol * np.abs(reference)
        worst = np.where(np.isfinite(errors), errors, np.inf).max(axis=0)
        column = int(worst.argmax())
        return float(worst[column]), names[column]


def numbers(result: Result) -> tuple[list[str], FloatArray]:
    """Names and values, shape (n, m), of all outputs that are floating-point numbers."""
    discrete = [name for name, column in result.discrete.items() if column.dtype == np.float64]
    names = [*result.names, *discrete]
    return names, np.array([result[name] for name in names], dtype=float).T


def find_reference(system: System, scale: Scale, deadline: float) -> Reference:
    """Halve the steps until that changes nothing, or the time is over [s].

    Inputs are straight lines in each step. Communication points are where values are compared, so
    nothing is interpolated. Of the runs and of their Richardson extrapolations to steps of no
    length (Hairer, Noersett, Wanner, Solving Ordinary Differential Equations I, section II.9) that
    one is taken which changed least.
    """
    row: list[FloatArray] = []
    reference = None
    for doubling in range(_DOUBLINGS):
        steps = scale.points << doubling
        begin = monotonic()
        names, values = numbers(run_fixed(system, steps, order=1))
        before, row = row, extrapolated(row, values)
        for last, new in zip(before, row, strict=False):
            change, _ = scale.distance(names, last, new)
            if reference is None or reference.steps < steps or change < reference.change:
                reference = Reference(new, change, steps)
        if reference is not None and reference.change <= _ENOUGH:
            break
        if reference is not None and monotonic() + 2.0 * (monotonic() - begin) > deadline:
            break
    assert reference is not None
    return reference


def extrapolated(before: list[FloatArray], values: FloatArray) -> list[FloatArray]:
    """The row of the Aitken-Neville tableau below ``before``, for errors c_1 H + c_2 H^2 + ..."""
    row = [values]
    with np.errstate(invalid="ignore", over="ignore"):  # coarse steps may diverge
        for j, last in enumerate(before[:_COLUMNS], 1):
            row.append(row[-1] + (row[-1] - last) / (2.0**j - 1.0))
    return row


def find_cheapest(
    system: System,
    scale: Scale,
    reference: Reference,
    *,
    error: float,
    do_steps: int,
    deadline: float,
) -> dict[str, int]:
    """The run with fixed steps, of any order, that has the fewest do_steps for that error."""
    best: dict[str, int] = {}
    most = int(_MOST_OF_DEFAULT * do_steps)
    for order in range(4):
        for steps in _step_numbers():
            if monotonic() > deadline:
                return best
            if steps > most:  # each slave takes at least one do_step in a step
                break
            try:
                result = run_fixed(system, steps, order)
            except DoublestepError:
                continue  # too coarse for a model
            taken = _do_steps(result)
            if taken > most:
                break
            found, _ = scale.error(result, reference.values)
            if isfinite(found) and found <= error:
                best = {"fixed_do_steps": taken, "fixed_order": order, "fixed_steps": steps}
                most = taken - 1
                break
    return best


def run_fixed(system: System, steps: int, order: int) -> Result:
    """So many steps of one size, in process."""
    stop_time = float(system.simulation.stop_time or 0.0)
    return simulate(
        system,
        in_process=True,
        estimator="none",
        order=order,
        initial_step_size=stop_time / steps,
    )


def _step_numbers() -> Iterator[int]:
    """8, 12, 16, 24, 32, ..."""
    for power in count():
        yield _FEWEST_STEPS << power
        yield 3 * _FEWEST_STEPS // 2 << power


def _do_steps(result: Result) -> int:
    counted: Mapping[str, Any] = result.summary["do_steps"]
    return sum(counted.values())


if __name__ == "__main__":
    main()
