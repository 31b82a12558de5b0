"""Work-precision diagrams: error over do_steps and over round trips, a picture for each system."""

from __future__ import annotations

from collections.abc import Iterator
from math import exp, log
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from benchmarks.reproduction.beyond_text import paragraphs, power, short, table
from benchmarks.reproduction.measured_runs import SMOOTH, TOLERANCES, Run, load, run
from protocol.errors import DoublestepError

DOTS_PER_INCH = 120
DIVERGED = 1.0
"""Runs with a larger mean error are left out."""
FEWEST = {name: 400 if name == "two_mass" else 200 for name in SMOOTH}
"""Constant steps; fewer are unstable for two_mass."""
STEPS = {name: [first * 2**i for i in range(5)] for name, first in FEWEST.items()}
"""Number of constant steps of a run."""


class Curve(NamedTuple):
    """A way to run a system.

    Attributes:
        name: for the legend.
        settings: of the simulation.
        colour, marker, line: of the curve.
        tolerances: of its points; none: constant steps.
    """

    name: str
    settings: dict[str, Any]
    colour: str
    marker: str
    line: str
    tolerances: tuple[float, ...] = TOLERANCES


CURVES = (
    Curve("constant H, k = 1", {"estimator": "none", "order": 1}, "#8c959f", "o", ":", ()),
    Curve("constant H, k = 2", {"estimator": "none", "order": 2}, "#57606a", "s", ":", ()),
    Curve("paper, k = 1", {"preset": "paper", "order": 1}, "#e3a008", "o", "--", TOLERANCES[:-1]),
    Curve("paper, k = 2", {"preset": "paper", "order": 2}, "#bc4c00", "s", "--"),
    Curve("auto, EST_Rich", {"estimator": "rich"}, "#8250df", "^", "-"),
    Curve("auto, EST_mod (default)", {}, "#0969da", "D", "-"),
    Curve("auto, Gauss-Seidel", {"sequence": "gauss-seidel"}, "#1a7f37", "v", "-"),
)
PAPER = CURVES[3]


def section(directory: Path) -> str:
    """Draw the pictures into ``directory`` and describe them."""
    pictures = []
    for name in SMOOTH:
        file = f"beyond_{name.replace(' ', '_')}.png"
        _draw(name, directory / file)
        pictures.append(f"![Error over do_steps and over round trips: {name}]({file})")
    return paragraphs(
        "## 3. Work and precision",
        "Mean error over the do_steps of each slave, left, and over the round trips, right: the "
        "requests that are made one after the other, which is what costs time over a network. "
        "Further left and further down is better. The points of a curve are tolerances from "
        f"{power(TOLERANCES[0])} to {power(TOLERANCES[-1])} (k = 1 ends at "
        f"{power(TOLERANCES[-2])}), or constant step sizes, each half of the one before. Runs that "
        f'diverged are left out. The start of a constant-step run is `"rest"`.',
        *pictures,
        "What it takes to get an error, by interpolation between the points of the curves of the "
        "paper's k = 2 and of the default: ",
        table(
            ("system", "mean error", "do_steps, paper, k = 2", "do_steps, default", "part"),
            [_comparison(name) for name in SMOOTH],
        ),
        "**When to use which.** A constant H costs one do_step and one round trip for each step, a "
        "controlled one three and two for each pair. So it can win where all steps have to be "
        "alike, as in two_mass at large errors, where stability bounds H; but nothing tells you "
        "which H that is, nor what the error was. EST_Rich and EST_mod need much the same work; "
        "EST_mod takes no step of 2H, which not every slave can. For Gauss-Seidel see section 8.",
    )


def _points(name: str, curve: Curve) -> Iterator[Run]:
    if curve.tolerances:
        for tolerance in curve.tolerances:
            yield run(name, tolerance, **curve.settings)
        return
    duration = load(name).simulation.end
    for steps in STEPS[name]:
        try:
            one = run(name, initial_step_size=duration / steps, **curve.settings)
        except DoublestepError:  # values that are not finite
            continue
        if one.mean_error < DIVERGED:
            yield one


def _comparison(name: str) -> tuple[str, ...]:
    """At the error that the default has with the middle one of the tolerances."""
    middle = run(name, TOLERANCES[2])
    paper = sorted((log(one.mean_error), log(one.do_steps)) for one in _points(name, PAPER))
    work = exp(np.interp(log(middle.mean_error), *np.transpose(paper)))
    return (
        name,
        short(middle.mean_error),
        f"{work:.0f}",
        str(middle.do_steps),
        f"{middle.do_steps / work:.2f}",
    )


def _draw(name: str, path: Path) -> None:
    figure = Figure(figsize=(9.0, 4.2), dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2, sharey=True)
    for curve in CURVES:
        runs = list(_points(name, curve))
        errors = [one.mean_error for one in runs]
        works = ([one.do_steps for one in runs], [one.round_trips for one in runs])
        for axes, work in zip(panels, works, strict=True):
            axes.plot(
                work,
                errors,
                label=curve.name,
                color=curve.colour,
                marker=curve.marker,
                linestyle=curve.line,
                markersize=4.5,
                linewidth=1.4,
            )
    for axes, work_name in zip(panels, ("do_steps of each slave", "round trips"), strict=True):
        _dress(axes)
        axes.set_xlabel(work_name)
    panels[0].set_ylabel("mean error")
    figure.suptitle(name, fontsize=11, color="#3b4a5a")
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside right center",
        frameon=False,
        fontsize=8.5,
    )
    figure.savefig(path)


def _dress(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#8c959f")
    axes.grid(visible=True, color="#d8dee4", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", labelsize=8.5, color="#8c959f")
    axes.yaxis.set_major_locator(LogLocator(numticks=12))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
