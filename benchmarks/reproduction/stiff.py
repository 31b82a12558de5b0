"""Writes ``stiff.md``: stiff coupled systems, and the stability of the iterated step."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks import stiff
from benchmarks.reproduction.beyond_text import commands, paragraphs, table
from master_node.numerics.collocation import MIDDLE, NEAREST

FILE = "stiff.md"
TOLERANCES = (1e-3,)
MOST = {"auto": 1500, "implicit": 1500, "explicit": 300}
"""Double steps after which a run is broken off."""

_DISTANCES = (None, NEAREST, 0.7, 1.0, 2.0, 4.0)
_SIZES = 10.0 ** np.linspace(-3.0, 6.0, 91)


def write(directory: Path) -> None:
    """Make all runs; write ``stiff.md`` into ``directory``."""
    directory.mkdir(parents=True, exist_ok=True)
    text = paragraphs(_introduction(), _systems(), _stability())
    (directory / FILE).write_text(text + "\n", encoding="utf-8")


def _introduction() -> str:
    return paragraphs(
        "# Stiff coupling",
        "Extrapolated inputs make a stiff exchange unstable, or blind the estimate. Iterated "
        "double steps are neither. This page is written by",
        commands("make fmus", "python -m benchmarks.reproduction stiff"),
        "and `python -m benchmarks stiff --tolerances 1e-5 1e-7` prints the table of systems "
        "at other tolerances.",
    )


def _systems() -> str:
    with ProcessPoolExecutor() as pool:
        rows = [row for rows in pool.map(_rows, stiff.SYSTEMS) for row in rows]
    return paragraphs(
        "## Systems",
        "The slaves are Python models ([stiff_models.py](../../benchmarks/stiff_models.py), "
        "[stiff_systems.py](../../benchmarks/stiff_systems.py)), the reference is Radau's method "
        "on all states at once. *do_steps* are those of the busiest slave, everything counted; "
        "*iterated* are accepted iterated double steps. The *error* is the largest one of any "
        "output at any communication point, in units of the tolerance times that output's own "
        f"range. Explicit runs are broken off after {MOST['explicit']} double steps, others after "
        f"{MOST['auto']}.",
        "An error above a hundred without a warning is a fault that is still there: in *contact* "
        "the ball meets the plate within a step, the force is over before the step ends, and no "
        "communication point sees it, so the ball does not feel the impact. A smaller "
        "`largest_step_size` does.",
        table(stiff.COLUMNS, rows),
    )


def _rows(name: str) -> list[tuple[str, ...]]:
    """All runs of one system."""
    return [
        row
        for tolerance in TOLERANCES
        for coupling, most in MOST.items()
        for row in stiff.run((tolerance,), (name,), most, (coupling,))
    ]


def _stability() -> str:
    angles = [np.exp(1j * np.radians(angle)) for angle in (100, 120, 150, 180)]
    left = [size * turn for size in _SIZES for turn in angles]
    axis = [1j * size for size in _SIZES]
    rows = []
    for distance in _DISTANCES:
        name = "degree 2" if distance is None else f"degree 3, earlier point at {distance:g} h"
        cells = [name]
        for is_flow in (False, True):
            cells += [
                f"{max(growth(z, distance, is_flow=is_flow) for z in left):.4f}",
                f"{max(growth(z, distance, is_flow=is_flow) for z in axis):.4f}",
                f"{growth(-1e9, distance, is_flow=is_flow):.4f}",
            ]
        rows.append(cells)
    return paragraphs(
        "## Stability of the iterated step",
        f"Growth of y' = z y over one iterated double step of size h with its middle at "
        f"{MIDDLE:g} h, in two limits: a *follower* has settled on its inputs, a *flow cut* "
        "integrates the flow that it is told. The first column is the largest one over |z| h from "
        "1e-3 to 1e6 and angles of 100 to 180 degrees, the second over the imaginary axis, the "
        "third far to the left. Degree 2 is A-stable. Degree 3 is A(80 degrees)-stable; an "
        "undamped oscillation grows a little where the earlier point is near, as it is while h "
        "grows.",
        table(
            (
                "polynomial",
                "follower, left",
                "axis",
                "far left",
                "flow cut, left",
                "axis",
                "far left",
            ),
            rows,
        ),
    )


def growth(z: complex, distance: float | None, *, is_flow: bool) -> float:
    """Factor of y' = z y over h = 1, or spectral radius of both points for degree 3.

    Args:
        z: the rate times h.
        distance: of the earlier point from T, in units of h; None: degree 2.
        is_flow: whether the inputs are flows z y; else the slaves follow y.
    """
    points = [0.0, MIDDLE, 1.0] + ([] if distance is None else [-distance])
    n = np.arange(len(points))
    met = np.vander(points, len(points), increasing=True).astype(complex)
    factor = z if is_flow else 1.0
    answers = []
    for now, before in ((1.0, 0.0), (0.0, 1.0)):
        rows, right = [met[0]], [now * factor]
        if distance is not None:
            rows.append(met[3])
            right.append(before * factor)
        for node in (MIDDLE, 1.0):
            if is_flow:
                rows.append(node**n - z * node ** (n + 1) / (n + 1))
                right.append(z * now)
            else:
                rows.append(n * node ** np.maximum(n - 1, 0) - z * node**n)
                right.append(0.0)
        found = np.linalg.solve(np.array(rows), np.array(right))
        answers.append(now + (found / (n + 1)).sum() if is_flow else found.sum())
    if distance is None:
        return float(abs(answers[0]))
    return float(np.abs(np.linalg.eigvals(np.array([answers, [1.0, 0.0]]))).max())
