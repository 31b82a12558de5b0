"""A results plot: outputs, communication step size H and error norm ERR over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from master_node.results.files import replacing
from protocol.errors import ResultsError
from protocol.signals import FloatArray
from protocol.text.plain_text import printable

if TYPE_CHECKING:
    from master_node.results import Result

WIDTH = 10.0
PANEL_HEIGHT = 2.3
DOTS_PER_INCH = 150
"""Size of the picture: ``WIDTH`` by ``PANEL_HEIGHT`` per panel and a margin for the title [in]."""

_TITLE_HEIGHT = 0.5
_COLUMNS = 1500  # pixels across the picture: more columns of points cannot be told apart
_LINES_PER_PANEL = 10  # the length of the colour cycle
_OUTPUT_PANELS = 8
_LARGEST = 1e300  # matplotlib overflows with the largest floats, where a diverging run may end
_CROWD = 300  # markers that can be told apart
_ACCEPTED = "#3b4a5a"
_REJECTED = "#d1242f"


def plot_result(
    result: Result,
    path: Path | None,
    show: bool,
    variables: Sequence[str] | None,
    *,
    is_named: bool = True,
) -> Figure:
    """Draw a result.

    Outputs share a panel by unit where units are known, else by slave. Discrete variables keep
    their value up to the next point; texts and binary values are not drawn. Large results are drawn
    by their first, last, smallest and largest value in each column of pixels.

    Args:
        result: what to draw.
        path: file to write, its suffix is the format; None writes none.
        show: open a window (this alone uses ``matplotlib.pyplot``).
        variables: names to draw; None draws all, as far as there is room for them.
        is_named: the user has named the file, be it a link or a device. Else it is the one of the
            results directory, and takes the place of what is there.

    Raises:
        KeyError: no such variable, or one that holds no numbers.
        ResultsError: the file cannot be written.
    """
    with matplotlib.rc_context():
        if _is_set_by_working_directory():
            matplotlib.rcdefaults()
        figure = _draw(result, show, variables)
        if path is not None:
            _save(figure, path, is_named=is_named)
        if show:
            _show()
        return figure


def _is_set_by_working_directory() -> bool:
    """A ``matplotlibrc`` there goes before the user's own, and can have LaTeX run its text."""
    return Path(matplotlib.matplotlib_fname()).resolve().parent == Path.cwd()


def _draw(result: Result, show: bool, variables: Sequence[str] | None) -> Figure:
    panels = _panels(result, _drawable(result) if variables is None else variables)
    shown = panels[:_OUTPUT_PANELS] if variables is None else panels
    steps = result.steps[result.steps["step_size"] > 0.0]  # without changes by users and actions
    has_norms = bool(len(steps)) and not bool(np.isnan(steps["error_norm"]).all())
    count = len(shown) + bool(len(steps)) + has_norms
    figure = _new_figure((WIDTH, max(count, 1) * PANEL_HEIGHT + _TITLE_HEIGHT), show)
    figure.suptitle(
        _title(result, sum(map(len, panels)), sum(map(len, shown))), fontsize=11, color=_ACCEPTED
    )
    axes = figure.subplots(max(count, 1), 1, sharex=True, squeeze=False)[:, 0].tolist()
    for panel, names in zip(axes, shown, strict=False):
        _draw_outputs(panel, result, names)
    if len(steps):
        end = result.time[-1] if len(result.time) else steps["time"][-1]
        _draw_step_sizes(axes[len(shown)], steps, float(end))
    if has_norms:
        _draw_error_norms(axes[len(shown) + 1], steps)
    for panel in axes:
        _dress(panel)
    axes[-1].set_xlabel("time [s]")
    if len(result.time) > 1:
        axes[-1].set_xlim(result.time[0], result.time[-1])
    figure.align_ylabels()
    return figure


def decimated(time: FloatArray, values: FloatArray, columns: int = _COLUMNS) -> NDArray[np.intp]:
    """Indices that draw the same picture: at most four points in each of ``columns``.

    Columns divide the time, not the points: steps are small where something happens.

    Args:
        time: ascending [s], shape (n,).
        values: shape (n,).
        columns: number of columns.

    Returns:
        Ascending indices into both.
    """
    n = len(time)
    if n <= 4 * columns:
        return np.arange(n)
    edges = np.linspace(time[0], time[-1], columns + 1)[:-1]
    starts = np.unique(np.searchsorted(time, edges))
    stops = np.append(starts[1:], n)
    columns_of_points = list(zip(starts.tolist(), stops.tolist(), strict=True))
    smallest = [i + int(np.argmin(values[i:j])) for i, j in columns_of_points]
    largest = [i + int(np.argmax(values[i:j])) for i, j in columns_of_points]
    return np.unique(np.concatenate([starts, stops - 1, smallest, largest]))


def _drawable(result: Result) -> list[str]:
    return [name for name in result if result[name].dtype.kind != "O"]


def _panels(result: Result, names: Sequence[str]) -> list[list[str]]:
    """Names by unit, by slave where no unit is known; as many to a panel as colours.

    An enumeration has a panel of its own, for the names of its items.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    for name in names:
        if result[name].dtype.kind == "O":  # an unknown name is an error here, too
            raise KeyError(f"{name} holds no numbers")
        unit = result.units.get(name, "")
        key = (unit, "") if unit else ("", name.split(".", 1)[0])
        key = ("", name) if name in result.enumerations else key
        groups.setdefault(key, []).append(name)
    size = _LINES_PER_PANEL
    return [group[i : i + size] for group in groups.values() for i in range(0, len(group), size)]


def _title(result: Result, variables: int, shown: int) -> str:
    rejected = int(np.count_nonzero(~result.steps["accepted"]))
    parts = [
        _shortened(str(result.summary.get("outcome", "run without an end"))),
        f"{len(result.time)} result points",
        f"{rejected} of {len(result.steps)} attempts rejected",
    ]
    if shown < variables:
        parts.append(f"first {shown} of {variables} variables")
    return "  \N{MIDDLE DOT}  ".join(parts)


def _new_figure(size: tuple[float, float], show: bool) -> Figure:
    if show:
        from matplotlib import pyplot  # noqa: PLC0415  # global state, only for a window

        return pyplot.figure(figsize=size, dpi=DOTS_PER_INCH * 2 / 3, layout="constrained")
    figure = Figure(figsize=size, dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _show() -> None:
    from matplotlib import pyplot  # noqa: PLC0415

    pyplot.show()


def _save(figure: Figure, path: Path, *, is_named: bool) -> None:
    try:
        if is_named:
            figure.savefig(path, dpi=DOTS_PER_INCH)
        else:
            with replacing(path) as file:
                figure.savefig(file, dpi=DOTS_PER_INCH, format=path.suffix[1:])
    except (OSError, ValueError) as error:  # ValueError: no such format
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise ResultsError(
            f"cannot write {path}: {reason}", remedy="choose another file for the plot"
        ) from error


def _draw_outputs(axes: Axes, result: Result, names: Sequence[str]) -> None:
    for name in names:
        values = result[name].astype(np.float64)
        values = np.where(np.isfinite(values), values, np.nan)
        values = np.clip(values, -_LARGEST, _LARGEST)
        kept = decimated(result.time, values)
        marker = "." if len(result.time) < 2 else ""
        axes.plot(
            result.time[kept],
            values[kept],
            drawstyle="steps-post" if name in result.discrete else "default",
            linewidth=1.3,
            marker=marker,
        )
    unit = result.units.get(names[0], "")
    axes.set_ylabel(f"[{_shortened(unit)}]" if unit else _shortened(names[0].split(".", 1)[0]))
    items = result.enumerations.get(names[0], {})
    if items:
        axes.set_yticks(list(items.values()), [_shortened(item) for item in items])
    _legend(axes, names)


def _draw_step_sizes(axes: Axes, steps: NDArray[np.void], end: float) -> None:
    accepted, rejected = steps[steps["accepted"]], steps[~steps["accepted"]]
    labels = []
    if len(accepted):
        kept = accepted[decimated(accepted["time"], accepted["step_size"])]
        axes.plot(
            np.append(kept["time"], end),
            np.append(kept["step_size"], kept["step_size"][-1]),
            drawstyle="steps-post",
            color=_ACCEPTED,
            linewidth=1.2,
        )
        labels.append("accepted")
    if len(rejected):
        _mark(axes, rejected["time"], rejected["step_size"])
        labels.append("rejected")
    axes.set_yscale("log")
    axes.set_ylabel("H [s]")
    _legend(axes, labels)


def _draw_error_norms(axes: Axes, steps: NDArray[np.void]) -> None:
    norm = steps["error_norm"]
    drawable = np.isfinite(norm) & (norm > 0.0)
    accepted = steps[drawable & steps["accepted"]]
    rejected = steps[drawable & ~steps["accepted"]]
    beyond = steps[np.isposinf(norm)]
    axes.axhline(1.0, color=_REJECTED, linewidth=0.9, linestyle=(0, (5, 3)))
    labels = ["ERR = 1"]
    if len(accepted):
        kept = accepted[decimated(accepted["time"], accepted["error_norm"])]
        axes.plot(
            kept["time"],
            kept["error_norm"],
            color=_ACCEPTED,
            linewidth=0.7,
            marker="." if len(kept) <= _CROWD else "",
            markersize=4,
        )
        labels.append("accepted")
    if len(rejected):
        _mark(axes, rejected["time"], rejected["error_norm"])
        labels.append("rejected")
    if len(beyond):  # no place on the axis: at the upper edge
        kept = beyond["time"][decimated(beyond["time"], beyond["step_size"])]
        _mark(axes, kept, np.full(len(kept), 0.96), marker="^", at_edge=True)
        labels.append("not finite")
    axes.set_yscale("log")
    if len(beyond):
        axes.set_ylim(top=max(axes.get_ylim()[1], 3.0))  # room above the line for the marks
    axes.set_ylabel("ERR")
    _legend(axes, labels)


def _mark(
    axes: Axes, time: FloatArray, values: FloatArray, marker: str = "x", at_edge: bool = False
) -> None:
    kept = decimated(time, values)
    crowded = len(kept) > _CROWD  # then dots, or they hide the line
    axes.plot(
        time[kept],
        values[kept],
        linestyle="",
        marker="." if crowded else marker,
        markersize=2 if crowded else 5,
        markeredgewidth=0.0 if crowded else 1.2,
        color=_REJECTED,
        zorder=3,
        transform=axes.get_xaxis_transform() if at_edge else axes.transData,
    )


def _legend(axes: Axes, labels: Sequence[str]) -> None:
    """Beside the panel, where it covers no line."""
    legend = axes.legend(
        axes.get_lines(),
        [_shortened(label) for label in labels],
        loc="upper left",
        bbox_to_anchor=(1.0, 1.02),
        frameon=False,
        fontsize=8.5,
        handlelength=1.6,
    )
    for line in legend.get_lines():
        line.set_markersize(5)


def _dress(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#8c959f")
    axes.grid(visible=True, color="#d8dee4", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", labelsize=8.5, color="#8c959f")
    axes.margins(x=0.0)


def _shortened(name: str) -> str:
    """At most 40 characters of it, as the names of large models leave no room for the lines."""
    name = printable(name)
    name = name if len(name) <= 40 else f"{name[:18]} ... {name[-17:]}"
    return name.replace("$", r"\$")  # no formula
