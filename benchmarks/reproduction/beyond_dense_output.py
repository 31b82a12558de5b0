"""Dense output: the error on a grid of its own beside that at the communication points."""

from __future__ import annotations

from itertools import pairwise
from math import log2
from typing import Any

from benchmarks.reproduction.beyond_text import commands, paragraphs, power, short, table
from benchmarks.reproduction.measured_runs import QUARTER_CAR, SMOOTH, load, run

POINTS = 997
"""Intervals of the grid: a prime, so that no communication point is one of its points."""

STEP_SIZES = (4e-3, 2e-3, 1e-3, 5e-4)
POLYNOMIALS: dict[str, dict[str, Any]] = {
    "1": {"order": 1},
    "2'": {"order": 2, "derivative_points": 1, "initial_history": "none"},
}
"""With these a fixed step has order k + 1 from its first step."""


def section() -> str:
    """Convergence with fixed steps, and errors with controlled ones."""
    return paragraphs(
        "## 9. Dense output",
        "With `output_interval` results are written on a grid that has nothing to do with the "
        "communication points. Outputs that come with derivatives are read from the Hermite "
        "polynomial through the three points of the double step, others from the polynomial "
        "through k + 2 points or more. The grid here has 997 intervals, so that its points lie "
        "anywhere between the communication points.",
        "The quarter car with fixed steps; mean errors, and the order that halving H shows:",
        table(
            ("k", "H [s]", "error at the points", "order", "error on the grid", "order"),
            [row for k in POLYNOMIALS for row in _convergence(k)],
        ),
        "With controlled steps, default settings; the last column is the largest error on the grid "
        "over the largest one at the points:",
        table(
            (
                "system",
                "tolerance",
                "mean error at the points",
                "on the grid",
                "largest error at the points",
                "on the grid",
                "ratio",
            ),
            [_controlled(name, tolerance) for name in SMOOTH for tolerance in (1e-3, 1e-5, 1e-7)],
        ),
        "The order is that of the solution, and with derivatives the error between the points is "
        "hardly larger than at them.",
        commands(
            "master-node run examples/quarter_car/displacement.toml --in-process "
            "--output-interval 0.01 --output results",
        ),
        "**When to use it.** For a table with equal distances, for comparing runs whose "
        "communication points differ, or for fewer rows than there are steps. It does not change "
        "the steps.",
    )


def _errors(name: str, tolerance: float | None = None, **settings: Any) -> tuple[float, ...]:
    """Mean and largest error at the points, then on the grid."""
    at_points = run(name, tolerance, **settings)
    interval = load(name).simulation.end / POINTS
    on_grid = run(name, tolerance, output_interval=interval, **settings)
    return (
        at_points.mean_error,
        at_points.largest_error,
        on_grid.mean_error,
        on_grid.largest_error,
    )


def _convergence(k: str) -> list[tuple[str, ...]]:
    errors = [
        _errors(
            QUARTER_CAR,
            estimator="none",
            initial_step_size=step_size,
            slave_tolerance=1e-11,
            **POLYNOMIALS[k],
        )
        for step_size in STEP_SIZES
    ]
    orders = [("", "")] + [
        (f"{log2(coarse[0] / fine[0]):.2f}", f"{log2(coarse[2] / fine[2]):.2f}")
        for coarse, fine in pairwise(errors)
    ]
    return [
        (k, short(step_size, 1), short(error[0]), order[0], short(error[2]), order[1])
        for step_size, error, order in zip(STEP_SIZES, errors, orders, strict=True)
    ]


def _controlled(name: str, tolerance: float) -> tuple[str, ...]:
    mean, largest, mean_on_grid, largest_on_grid = _errors(name, tolerance)
    return (
        name,
        power(tolerance),
        short(mean),
        short(mean_on_grid),
        short(largest),
        short(largest_on_grid),
        f"{largest_on_grid / largest:.1f}",
    )
