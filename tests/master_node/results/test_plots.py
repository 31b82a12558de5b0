"""Plots: a picture of the promised size, whatever is in the result."""

from __future__ import annotations

import math
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from master_node.results import STEPS_DTYPE, Result
from master_node.results.plots import (
    DOTS_PER_INCH,
    PANEL_HEIGHT,
    WIDTH,
    decimated,
)
from protocol.errors import ResultsError


def make_result(
    names: tuple[str, ...] = ("wheel.x", "chassis.x", "chassis.v"),
    units: tuple[str, ...] = ("m", "m", "m/s"),
    n: int = 50,
    norm: float = 0.5,
) -> Result:
    """A result with n points and n attempts, every tenth of them rejected."""
    time = np.linspace(0.0, 4.0, n)
    outputs = np.stack([np.sin((i + 1) * time) for i in range(len(names))], 1)
    steps = np.empty(n, STEPS_DTYPE)
    steps["time"] = time
    steps["step_size"] = 4.0 / n
    steps["order"] = 2
    steps["error_norm"] = norm
    steps["accepted"] = np.arange(n) % 10 > 0
    steps["limiting_variable"] = "wheel.x"
    if not math.isnan(norm):
        steps["error_norm"][::10] = 3.0
        steps["error_norm"][::20] = math.inf
    known = dict(zip(names, units, strict=True))
    return Result(names, known, time, outputs, steps, {"outcome": "completed"})


def labels(figure: Figure) -> list[str]:
    """Labels of the panels, from top to bottom."""
    return [axes.get_ylabel() for axes in figure.axes]


def legend(figure: Figure, panel: int) -> list[str]:
    """The legend of one panel."""
    found = figure.axes[panel].get_legend()
    assert found is not None
    return [text.get_text() for text in found.get_texts()]


def test_the_picture_has_its_size(tmp_path: Path) -> None:
    """A PNG: as wide as promised, a panel's height for each panel and room for the title."""
    path = tmp_path / "results.png"
    figure = make_result().plot(path)
    content = path.read_bytes()
    assert content.startswith(b"\x89PNG\r\n\x1a\n")
    width, height = struct.unpack(">II", content[16:24])
    assert width == round(WIDTH * DOTS_PER_INCH)
    assert len(figure.axes) == 4
    assert 0 <= height / DOTS_PER_INCH - 4 * PANEL_HEIGHT < 1.0
    assert len(content) > 20_000


def test_outputs_share_a_panel_by_unit(tmp_path: Path) -> None:
    """Metres with metres, then H and ERR; rejections and infinite norms are in the legend."""
    figure = make_result().plot()
    assert labels(figure) == ["[m]", "[m/s]", "H [s]", "ERR"]
    assert legend(figure, 0) == ["wheel.x", "chassis.x"]
    assert legend(figure, 2) == ["accepted", "rejected"]
    assert legend(figure, 3) == ["ERR = 1", "accepted", "rejected", "not finite"]
    assert [axes.get_yscale() for axes in figure.axes] == ["linear", "linear", "log", "log"]
    assert figure.axes[-1].get_xlabel() == "time [s]"


def test_without_units_each_slave_has_a_panel() -> None:
    """Nothing is known about the values but who gave them."""
    figure = make_result(units=("", "", "")).plot()
    assert labels(figure) == ["wheel", "chassis", "H [s]", "ERR"]


def test_rejections_are_marked_where_they_were() -> None:
    """The marks are at (T_n, H) and (T_n, ERR) of the rejected attempts, and at no others."""
    result = make_result()
    figure = result.plot()
    rejected = result.steps[~result.steps["accepted"]]
    marks = figure.axes[2].get_lines()[1]
    assert np.array_equal(marks.get_xdata(), rejected["time"])
    assert np.array_equal(marks.get_ydata(), rejected["step_size"])
    finite = rejected[np.isfinite(rejected["error_norm"])]
    assert np.array_equal(figure.axes[3].get_lines()[2].get_xdata(), finite["time"])


def test_chosen_variables_only() -> None:
    """``variables`` chooses; a name that is not there is an error, not an empty panel."""
    result = make_result()
    assert labels(result.plot(variables=["chassis.v"])) == ["[m/s]", "H [s]", "ERR"]
    with pytest.raises(KeyError, match=r"chassis\.q.*did you mean"):
        result.plot(variables=["chassis.q"])


def test_discrete_variables_are_drawn_as_steps() -> None:
    """Numbers and booleans keep their value up to the next point; texts are left out or refused."""
    bare = make_result()
    n = len(bare.time)
    result = replace(
        bare,
        units={**bare.units, "box.gear": "", "box.on": "", "box.label": ""},
        discrete={
            "box.gear": np.arange(n),
            "box.on": np.arange(n) % 2 == 0,
            "box.label": np.array(["a"] * n, object),
        },
    )
    figure = result.plot()
    assert labels(figure) == ["[m]", "[m/s]", "box", "H [s]", "ERR"]
    assert legend(figure, 2) == ["box.gear", "box.on"]
    gear, on = figure.axes[2].get_lines()
    assert gear.get_drawstyle() == on.get_drawstyle() == "steps-post"
    assert np.array_equal(gear.get_ydata(), np.arange(n))
    assert figure.axes[0].get_lines()[0].get_drawstyle() == "default"
    with pytest.raises(KeyError, match=r"box\.label holds no numbers"):
        result.plot(variables=["box.label"])


def test_an_enumeration_has_a_panel_with_the_names_of_its_items() -> None:
    """Numbers of other variables do not share it."""
    bare = make_result()
    n = len(bare.time)
    result = replace(
        bare,
        units={**bare.units, "box.gear": "", "box.count": ""},
        discrete={"box.gear": np.arange(n) % 2, "box.count": np.arange(n)},
        enumerations={"box.gear": {"neutral": 0, "first": 1}},
    )
    figure = result.plot(variables=["box.gear", "box.count"])
    assert [legend(figure, panel) for panel in (0, 1)] == [["box.gear"], ["box.count"]]
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["neutral", "first"]


def test_many_variables_are_cut_and_it_is_said() -> None:
    """A picture has an end; what is missing in it is in its title, and can be asked for."""
    names = tuple(f"plant.x[{i}]" for i in range(200))
    result = make_result(names, ("",) * 200)
    figure = result.plot()
    assert len(figure.axes) == 10
    assert "first 80 of 200 variables" in figure.get_suptitle()
    assert len(result.plot(variables=names[:100]).axes) == 12


def test_no_estimator_no_panel() -> None:
    """Without error norms the panel is left out, without steps both are."""
    result = make_result(norm=math.nan)
    assert labels(result.plot()) == ["[m]", "[m/s]", "H [s]"]
    bare = Result(result.names, result.units, result.time, result.outputs, result.steps[:0], {})
    assert labels(bare.plot()) == ["[m]", "[m/s]"]


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_short_results_draw(tmp_path: Path, rows: int) -> None:
    """A run that failed in its first step has a picture too."""
    result = make_result()
    short = Result(
        result.names,
        result.units,
        result.time[:rows],
        result.outputs[:rows],
        result.steps[:rows],
        {},
    )
    short.plot(tmp_path / "short.png")
    assert (tmp_path / "short.png").stat().st_size > 1000


@pytest.mark.parametrize("value", [math.inf, math.nan, sys.float_info.max, 5e-324, 0.0])
def test_any_value_draws(tmp_path: Path, value: float) -> None:
    """A run that diverged is the one whose picture is wanted most: no warning, no error."""
    result = make_result()
    result.outputs[10:, 0] = value
    result.outputs[20:, 0] = -value
    result.plot(tmp_path / "any.png")
    assert (tmp_path / "any.png").stat().st_size > 1000


def test_any_name_draws(tmp_path: Path) -> None:
    """Dollar signs are no formula, underscores hide nothing, long names leave room."""
    names = ("a.$x$", "_b._y", "c." + "n" * 300)
    figure = make_result(names, ("$", "_", "u" * 300)).plot(tmp_path / "names.png")
    assert legend(figure, 0) == [r"a.\$x\$"]
    assert legend(figure, 1) == ["_b._y"]
    assert len(legend(figure, 2)[0]) <= 41


def test_large_results_are_decimated_without_losing_peaks() -> None:
    """Some thousand of a million rows are drawn, the one with the peak among them."""
    n = 1_000_000
    time = np.linspace(0.0, 1.0, n) ** 3  # most points where time is small
    values = np.sin(20.0 * time)
    values[123_456] = 50.0
    values[765_432] = -50.0
    kept = decimated(time, values, columns=1000)
    assert len(kept) <= 4000
    assert {0, 123_456, 765_432, n - 1} <= set(kept.tolist())
    assert np.all(np.diff(kept) > 0)
    assert np.max(np.diff(time[kept])) < 2.1e-3, "sparse parts keep their points"


def test_small_results_are_drawn_whole() -> None:
    """Nothing is left out where every point can be seen."""
    time = np.linspace(0.0, 1.0, 400)
    assert np.array_equal(decimated(time, time, columns=100), np.arange(400))


def test_unwritable_plot_is_a_results_error(tmp_path: Path) -> None:
    """The path that cannot be written and the format that does not exist are named."""
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "results.png", tmp_path / "results.nope"):
        with pytest.raises(ResultsError, match=f"cannot write {path}: "):
            make_result().plot(path)


def test_plotting_leaves_no_global_state(tmp_path: Path) -> None:
    """Without a window, pyplot keeps no figure: plotting in a loop does not eat memory."""
    from matplotlib import pyplot  # noqa: PLC0415  # only this test looks at it

    before = pyplot.get_fignums()
    make_result().plot(tmp_path / "results.png")
    assert pyplot.get_fignums() == before


def test_a_window_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """``show`` hands the same figure to pyplot."""
    from matplotlib import pyplot  # noqa: PLC0415

    pyplot.switch_backend("agg")
    shown: list[list[int]] = []
    monkeypatch.setattr(pyplot, "show", lambda: shown.append(pyplot.get_fignums()))
    figure = make_result().plot(show=True)
    assert shown == [[figure.number]]
    pyplot.close("all")
