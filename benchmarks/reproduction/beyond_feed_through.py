"""Feed-through: outputs evaluated again at communication points, or not."""

from __future__ import annotations

from collections.abc import Iterator
from math import log2

import numpy as np

from benchmarks.reproduction.beyond_text import (
    block,
    both,
    commands,
    paragraphs,
    power,
    short,
    table,
)
from benchmarks.reproduction.local_errors import ExactStarts
from benchmarks.reproduction.measured_runs import FORCE, Run, load, run_variant, varied
from master_node import System
from master_node.hosts.opening import slaves_in_process
from master_node.numerics.extrapolation import InputPolynomial

FOLLOWS = {"wheel": {"outputs_follow_inputs": True}}
STATES = ("chassis.x", "chassis.v")
"""Outputs without feed-through; wheel.F is the one with it."""

STEP_SIZES = (2e-3, 1e-3, 5e-4, 2.5e-4)
STARTS = tuple((0.1 + 0.0125 * np.arange(9)).tolist())
"""Where the double steps begin [s], within one swing of the wheel; their errors are averaged."""


def section() -> str:
    """Order of the local error, and work and errors of whole runs."""
    return paragraphs(
        "## 7. Feed-through",
        "`displacement_force.toml`: the wheel sends the force F, which contains its inputs. At the "
        "end of a step F is made with extrapolated inputs. With `evaluate_outputs` the wheel is "
        "given the chassis' outputs, which are known by then, and asked for F again.",
        "Error of wheel.F after one double step of fixed H [N], from the exact motion with an "
        f"exact history, mean over {len(STARTS)} beginnings. The order is what the last halving of "
        "H shows: k + 1 without, k + 2 with evaluation.",
        table(
            ("k", "evaluated", *(f"H = {1e3 * h:g} ms" for h in STEP_SIZES), "order"),
            _local_rows(),
        ),
        "So P of the step size control is k + 2 instead of k + 1. Whole runs; each cell is without "
        "/ with evaluation:",
        table(
            (
                "tolerance",
                "order",
                "steps",
                "rejections",
                "do_steps",
                "round trips",
                "mean error of x, v",
                "mean error of F [N]",
            ),
            [
                _whole_row(tolerance, order)
                for tolerance in (1e-3, 1e-5)
                for order in (1, 2, "auto")
            ],
        ),
        "At 1e-5 the error grows with evaluation, and stays in proportion to the tolerance: with "
        "P = k + 1 the steps are shorter than the tolerance asks for.",
        "What a system file needs for it; the command runs the example without.",
        block(
            "toml",
            "[simulation]",
            "evaluate_outputs = true",
            "",
            "[slaves.wheel]",
            'model = "wheel_force.fmu"',
            "outputs_follow_inputs = true",
        ),
        commands(
            "master-node run examples/quarter_car/displacement_force.toml --in-process "
            "--output results",
        ),
        "**When to use it.** Where computing is expensive and a round trip is cheap: it saves "
        "do_steps, most of all with a low order, and takes six round trips for a double step "
        "instead of two, one for each of its do_steps and one for each evaluation. It needs "
        "slaves whose outputs follow their inputs without a step. FMI 2.0 does not "
        "promise that, so an FMU has to be declared; Python models always do.",
    )


def _system(**simulation: object) -> System:
    return varied(load(FORCE), FOLLOWS).with_simulation(**simulation)


# --- one double step ----------------------------------------------------------------------------


class EvaluatedStarts(ExactStarts):
    """Run with outputs evaluated again at the communication points."""

    def _started_at(self, time: float, polynomial: InputPolynomial, estimator: str) -> System:
        system = super()._started_at(time, polynomial, estimator)
        return varied(system, FOLLOWS).with_simulation(evaluate_outputs=True)


def _local_rows() -> Iterator[tuple[str, ...]]:
    system = load(FORCE)
    with slaves_in_process(system) as slaves:
        starts = ExactStarts(system, slaves)
        for order in range(4):
            yield _local_row(order, "no", starts)
    with slaves_in_process(system) as slaves:
        evaluated = EvaluatedStarts(system, slaves)
        for order in range(4):
            yield _local_row(order, "yes", evaluated)


def _local_row(order: int, evaluated: str, starts: ExactStarts) -> tuple[str, ...]:
    force = starts.names.index("wheel.F")
    polynomial = InputPolynomial(order)
    errors = [
        float(
            np.mean([abs(starts.local_error(t, h, polynomial, "mod").true[force]) for t in STARTS])
        )
        for h in STEP_SIZES
    ]
    return (
        str(order),
        evaluated,
        *map(short, errors),
        f"{log2(errors[-2] / errors[-1]):.2f}",
    )


# --- whole runs ---------------------------------------------------------------------------------


def _whole_row(tolerance: float, order: int | str) -> tuple[str, ...]:
    runs = [
        run_variant(
            FORCE,
            _system(
                order=order,
                evaluate_outputs=evaluate,
                relative_tolerance=tolerance,
                absolute_tolerance=tolerance,
            ),
        )
        for evaluate in (False, True)
    ]
    return (
        power(tolerance),
        str(order),
        *both(
            [one.steps for one in runs],
            [one.rejections for one in runs],
            [one.do_steps for one in runs],
            [one.round_trips for one in runs],
            [short(_mean(one, STATES)) for one in runs],
            [short(_mean(one, ("wheel.F",))) for one in runs],
        ),
    )


def _mean(one: Run, names: tuple[str, ...]) -> float:
    """Mean over the points of the norm of the errors of some outputs."""
    columns = [one.result.names.index(name) for name in names]
    return float(np.linalg.norm(one.deviations[:, columns], axis=1).mean())
