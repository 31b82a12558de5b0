"""The pictures of Part 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.quarter_car import ESTIMATOR_NAMES
from benchmarks.reproduction.exact_quarter_car import FloatArray
from benchmarks.reproduction.local_error_study import (
    FACTORS,
    LADDER,
    STEP_SIZE,
    STEP_SIZES,
    TIME,
    TIMES,
    VALUES_ONLY,
    Curve,
    LocalErrorFigure,
    Study,
)
from benchmarks.reproduction.table_1 import Measured

DOTS_PER_INCH = 100
_GREY, _BLUE, _RED = "#3b4a5a", "#0969da", "#d1242f"
_COLOURS = ("#3b4a5a", "#0969da", "#d1242f", "#1a7f37")
_PALE = "#9ec5fe"


def local_errors(path: Path, curves: LocalErrorFigure, what: str) -> None:
    """Figures 2 and 3: true errors and both estimates, k = 0 above, k = 1 below.

    Args:
        path: file to write.
        curves: of one coupling.
        what: whose error, with its unit.
    """
    figure, axes = _new(9.0, 6.2, 2, 2, sharex="col")
    for row, order in zip(axes, (0, 1), strict=True):
        _draw_curve(row[0], TIMES, curves.over_time[order])
        _draw_curve(row[1], STEP_SIZES, curves.over_step_size[order])
        row[1].set_xscale("log")
        row[0].set_ylabel(f"k = {order}: {what}")
    axes[0][0].set_title(f"along the motion, H = {STEP_SIZE * 1e3:g} ms", fontsize=10)
    axes[0][1].set_title(f"at t = {TIME:g} s, over H", fontsize=10)
    axes[1][0].set_xlabel("t [s]")
    axes[1][1].set_xlabel("H [s]")
    axes[0][1].legend(frameon=False, fontsize=9)
    _save(figure, path)


def _draw_curve(axes: Axes, x: FloatArray, curve: Curve) -> None:
    plain: dict[str, Any] = {"linestyle": "", "fillstyle": "none"}
    axes.plot(x, curve.true, marker="v", markersize=6, color=_GREY, label="local error", **plain)
    axes.plot(x, curve.rich, marker="o", markersize=4, color=_BLUE, label="EST_Rich", **plain)
    axes.plot(x, curve.mod, marker="x", markersize=4, color=_RED, label="EST_mod", **plain)
    axes.set_yscale("log")


def steps(path: Path, runs: Sequence[Mapping[str, Measured]], titles: Sequence[str]) -> None:
    """Figures 4 to 6: rejections so far, ERR and H over time.

    Args:
        path: file to write.
        runs: for each column the runs by the estimators' names.
        titles: of the columns.
    """
    columns = len(runs)
    figure, axes = _new(5.0 * columns, 6.2, 3, columns, sharex=True, sharey="row")
    for column, (named, title) in enumerate(zip(runs, titles, strict=True)):
        for estimator, run in named.items():
            _draw_steps([row[column] for row in axes], estimator, run)
        axes[0][column].set_title(title, fontsize=10)
        axes[1][column].axhline(1.0, color=_RED, linewidth=0.8, linestyle=(0, (5, 3)))
        axes[2][column].set_xlabel("t [s]")
    axes[0][0].set_ylabel("rejections so far")
    axes[1][0].set_ylabel("ERR")
    axes[2][0].set_ylabel("H [s]")
    axes[1][0].set_yscale("log")
    axes[1][0].set_ylim(2e-2, 2e1)
    axes[2][0].set_yscale("log")
    axes[0][-1].legend(frameon=False, fontsize=9, loc="lower right")
    _save(figure, path)


def _draw_steps(panels: Sequence[Axes], estimator: str, run: Measured) -> None:
    attempts, end = run.result.steps, run.result.time[-1]
    accepted, rejected = attempts[attempts["accepted"]], attempts[~attempts["accepted"]]
    is_under = estimator == "rich"  # EST_mod is drawn over it
    style: dict[str, Any] = {
        "color": _PALE if is_under else _GREY,
        "linewidth": 2.6 if is_under else 0.9,
        "label": ESTIMATOR_NAMES[estimator],
    }
    panels[0].plot(
        [0.0, *rejected["time"], end],
        [*range(len(rejected) + 1), len(rejected)],
        drawstyle="steps-post",
        **style,
    )
    panels[1].plot(accepted["time"], accepted["error_norm"], **style)
    panels[2].plot(
        [*accepted["time"], end],
        [*accepted["step_size"], accepted["step_size"][-1]],
        drawstyle="steps-post",
        **style,
    )
    marks: dict[str, Any] = {
        "linestyle": "",
        "marker": "o" if is_under else "x",
        "fillstyle": "none",
        "markersize": 6 if is_under else 4,
        "color": _BLUE if is_under else _RED,
    }
    panels[1].plot(rejected["time"], rejected["error_norm"], **marks)
    panels[2].plot(rejected["time"], rejected["step_size"], **marks)


def global_errors(path: Path, runs: Mapping[int, Mapping[str, Measured]]) -> None:
    """Figure 7: the error of the states over time, constant H against both estimates.

    Args:
        path: file to write.
        runs: by k, and by what to call them.
    """
    figure, axes = _new(9.0, 6.8, len(runs), 1, sharex=True, sharey=True)
    for (panel,), (order, named) in zip(axes, runs.items(), strict=True):
        for (name, run), colour in zip(named.items(), _COLOURS, strict=False):
            time, errors = run.result.time[1:], run.errors[1:]  # the first error is 0
            panel.plot(time, errors, color=colour, linewidth=0.9, label=name)
        panel.set_yscale("log")
        panel.set_ylabel(f"k = {order}: error")
    axes[0][0].set_ylim(1e-7, 2e-2)
    axes[-1][0].set_xlabel("t [s]")
    axes[-1][0].legend(frameon=False, fontsize=9, ncol=3)
    _save(figure, path)


def quotients(path: Path, results: Study) -> None:
    """Estimate over true local error, over H, for H that stays and that has changed."""
    figure, axes = _new(10.0, 6.2, 2, len(FACTORS), sharex=True, sharey=True)
    for row, estimator in zip(axes, ("rich", "mod"), strict=True):
        for panel, factor in zip(row, FACTORS, strict=True):
            for polynomial, colour in zip(VALUES_ONLY, _COLOURS, strict=True):
                paper, exact = results[polynomial, estimator, factor]
                panel.plot(LADDER, exact, marker=".", color=colour, label=f"k = {polynomial.order}")
                panel.plot(LADDER, paper, color=colour, linestyle=(0, (4, 2)), linewidth=1.0)
            panel.set_xscale("log")
            panel.set_xticks(LADDER, [f"{step_size * 1e3:g}" for step_size in LADDER])
            panel.minorticks_off()
            panel.set_ylim(0.0, 2.0)
        row[0].set_ylabel(f"{ESTIMATOR_NAMES[estimator]} / true error")
    for panel, factor in zip(axes[0], FACTORS, strict=True):
        title = "H as before" if factor == 1.0 else f"H {factor:g} times the one before"
        panel.set_title(title, fontsize=10)
    for panel in axes[1]:
        panel.set_xlabel("H [ms]")
    axes[0][-1].plot([], [], color="black", label="exact constants", marker=".")
    axes[0][-1].plot([], [], color="black", linestyle=(0, (4, 2)), label="the paper's")
    axes[0][-1].legend(frameon=False, fontsize=8, ncol=2)
    _save(figure, path)


def _new(
    width: float, height: float, rows: int, columns: int, **shared: Any
) -> tuple[Figure, list[list[Axes]]]:
    figure = Figure(figsize=(width, height), dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, **shared)
    for panel in axes.flat:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(visible=True, color="#d8dee4", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.tick_params(which="both", labelsize=8.5, color="#8c959f")
    return figure, [list(row) for row in axes]


def _save(figure: Figure, path: Path) -> None:
    """Without the version of the library, so that equal pictures are equal files."""
    figure.savefig(path, dpi=DOTS_PER_INCH, metadata={"Software": None})
