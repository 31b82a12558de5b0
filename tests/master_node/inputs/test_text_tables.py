"""Tables in text files as people have them: the same numbers, however they are written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from master_node import System, simulate
from master_node.inputs.text_tables import TextTable, read_text_table
from protocol.errors import ConfigurationError
from protocol.variables import Unit
from tests.support.quarter_car_case import LinearSlave, LinearSystem, run_slaves

numbers = st.one_of(st.floats(allow_nan=False, allow_infinity=False), st.integers(-99, 99))
rows_of_numbers = st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=6)


def table(folder: Path, text: str, file: str = "t.csv", encoding: str = "utf-8") -> TextTable:
    """Table that is read of a text."""
    (folder / file).write_bytes(text.encode(encoding))
    return read_text_table(folder / file)


def values(read: TextTable) -> list[tuple[float, ...]]:
    """The rows as numbers."""
    return list(zip(*(map(float, column) for column in read.columns.values()), strict=True))


@given(
    rows=rows_of_numbers,
    separator=st.sampled_from([",", ";", "\t", " ", "   ", " ; ", ", "]),
    decimal=st.sampled_from([".", ","]),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    units=st.sampled_from([None, ("s", "m", "m/s"), ("[s]", "(m)", "[-]")]),
    comments=st.lists(st.sampled_from(["# test rig; run 7, left", "% 3,4", ""]), max_size=3),
    mark=st.sampled_from(["", "\ufeff"]),
)
def test_the_way_it_is_written_does_not_matter(  # noqa: PLR0917  what is drawn
    tmp_path_factory: pytest.TempPathFactory,
    rows: list[tuple[float, ...]],
    separator: str,
    decimal: str,
    end: str,
    units: tuple[str, ...] | None,
    comments: list[str],
    mark: str,
) -> None:
    """Law: each number is read as it was written, to the last bit."""
    decimal = "." if "," in separator else decimal
    lines = [*comments, separator.join(("time", "x", "v"))]
    lines += [separator.join(units)] if units else []
    lines += [separator.join(repr(n).replace(".", decimal) for n in row) for row in rows]
    folder = tmp_path_factory.mktemp("tables", numbered=True)
    read = table(folder, mark + end.join([*lines, *comments]) + end)
    assert list(read.columns) == ["time", "x", "v"]
    assert values(read) == rows
    expected = ("s", "m", {None: "", "m/s": "m/s", "[-]": ""}[units and units[2]])
    assert tuple(read.units.values()) == (expected if units else ("", "", ""))


@pytest.mark.parametrize(
    ("text", "names", "rows"),
    [
        ("# t x\n0 1\n2 3\n", ["t", "x"], [(0, 1), (2, 3)]),
        ("# run 7 of the rig\n# t;x\n0;1,5\n", ["t", "x"], [(0, 1.5)]),
        ("t,x\n# half way\n0,1\n\n2,3\n", ["t", "x"], [(0, 1), (2, 3)]),
        ('"t","x, left"\n0,1\n', ["t", "x, left"], [(0, 1)]),
        ('"t;s";"x"\n"0,5";"1,5e-3"\n', ["t;s", "x"], [(0.5, 1.5e-3)]),
        ("t;x\n,5;-1,\n", ["t", "x"], [(0.5, -1)]),
        ("t\n0\n1\n", ["t"], [(0,), (1,)]),
        ("t   x [m]\n0    1\n", None, None),
    ],
)
def test_names_are_found(
    tmp_path: Path, text: str, names: list[str] | None, rows: list[tuple[float, ...]] | None
) -> None:
    """In the first line, in a comment above numbers alone, in quotation marks."""
    if names is None:
        with pytest.raises(ConfigurationError, match="row 1 has 2 values for 3 columns"):
            table(tmp_path, text)
        return
    read = table(tmp_path, text)
    assert list(read.columns) == names
    assert values(read) == rows


def test_texts_are_left_as_they_are(tmp_path: Path) -> None:
    """Commas in texts are no decimal commas."""
    read = table(tmp_path, "t;gear;note\n0;first;1,5 or so\n1,5;fast;2,5\n")
    assert read.columns["t"].tolist() == ["0", "1.5"]
    assert read.columns["gear"].tolist() == ["first", "fast"]
    assert read.columns["note"].tolist() == ["1,5 or so", "2,5"]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "is empty"),
        ("# t,x\n", "is empty"),
        ("0,1\n2,3\n", "the first line must name the columns"),
        ("t,x,x\n0,1,2\n", "two columns of one name in t, x, x"),
        ("t;x\n0;1\n2\n", "row 2 has 1 values for 2 columns"),
        ('t,x\n0,"1\n', "not a CSV file"),
        ("t;x\n0;1,5\n1;2.5\n", "row 2: x = '2.5': other numbers of this column have a decimal"),
    ],
)
def test_what_is_no_table_is_told(tmp_path: Path, text: str, told: str) -> None:
    """With the file and the row."""
    with pytest.raises(ConfigurationError, match=f"t.csv: {told}"):
        table(tmp_path, text)


def test_another_encoding_is_told(tmp_path: Path) -> None:
    """UTF-8 alone."""
    with pytest.raises(ConfigurationError, match=r"t\.csv: not a CSV file: .*utf-8"):
        table(tmp_path, "t;größe\n0;1\n", encoding="latin-1")


# ---- In a run -----------------------------------------------------------------------------------


def driven(folder: Path, text: str, **setting: Any) -> Any:
    """An integrator of a table: y' = u, from 0 to 2 s."""
    (folder / "u.csv").write_text(text, encoding="utf-8")
    (folder / "integrator.py").write_text(
        "from slave_node.model import Model, real\n"
        "class Integrator(Model):\n"
        "    inputs = (real('u', 'm', start=0.0),)\n"
        "    states = outputs = (real('y', start=0.0),)\n"
        "    def derivatives(self, t, x, u):\n"
        "        return [u[0]]\n",
        encoding="utf-8",
    )
    system = System(
        simulation={"stop_time": 2.0, "relative_tolerance": 1e-6, "absolute_tolerance": 1e-6},
        slaves={"i": {"model": "integrator.py:Integrator"}},
        inputs={"i.u": {"table": "u.csv", **setting}},
        base=folder,
    )
    return simulate(system, in_process=True)


@pytest.mark.parametrize(
    "text",
    [
        "t,u\n0,0\n2,3\n",
        "# rig\nt;u\n0;0\n2;3,0\n",
        "t\tu\ns\tm\n0\t0\n2\t3\n",
        "t;u\n[ms];[m]\n0;0\n2000;3\n",
        "t,u\nmin,m\n0,0\n0.1,9\n",
    ],
)
def test_a_run_has_the_input_of_its_table(tmp_path: Path, text: str) -> None:
    """The integral of a ramp, however the ramp and its units are written."""
    result = driven(tmp_path, text)
    assert result["i.y"] == pytest.approx(0.75 * result.time**2, abs=1e-5)


METRE, SECOND = Unit((0, 1, 0, 0, 0, 0, 0, 0)), Unit((0, 0, 1, 0, 0, 0, 0, 0))
UNITS = {"m": METRE, "km": replace(METRE, factor=1000.0), "mark": replace(METRE, offset=5.0)}


def metres(folder: Path, text: str) -> Any:
    """The integral over 2 s of a table into an input in m, of a model that knows more units."""
    system = LinearSystem(np.zeros((1, 1)), np.ones((1, 1)), np.zeros(1), ("u",), ("x",))
    slave = LinearSlave(system, np.zeros(1))
    u, x = slave.description.variables
    variables = (replace(u, unit="m"), x)
    slave.description = replace(
        slave.description, variables=variables, units={**UNITS, "s": SECOND}
    )
    (folder / "u.csv").write_text(text, encoding="utf-8")
    run = run_slaves(
        System(
            simulation={"stop_time": 2.0},
            slaves={"i": {}},
            inputs={"i.u": {"table": "u.csv", "interpolation": "hold", "extrapolate": "hold"}},
            base=folder,
        ),
        {"i": slave},
    )
    assert run.error is None
    return run.result["i.x"][-1]


@pytest.mark.parametrize(
    ("unit", "x"), [("m", 6.0), ("km", 6000.0), ("mark", 16.0), ("", 6.0), ("-", 6.0)]
)
def test_values_are_converted_between_units(tmp_path: Path, unit: str, x: float) -> None:
    """By the definitions of the model; a column without a unit has that of the input."""
    assert metres(tmp_path, f"t;u\ns;{unit}\n0;3\n") == pytest.approx(x, rel=1e-12)


def test_units_that_cannot_be_compared_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A warning for one that the model does not define; an error for another dimension."""
    assert metres(tmp_path, "t;u\ns;yd\n0;3\n") == pytest.approx(6.0)
    assert "the units of i.u and of its table are not compared" in caplog.text
    with pytest.raises(ConfigurationError, match=r"i\.u has another unit than the column"):
        metres(tmp_path, "t;u\ns;s\n0;3\n")
    with pytest.raises(ConfigurationError, match=r"the times 't' have the unit 'd'.*in s, ms, us"):
        metres(tmp_path, "t;u\nd;m\n0;3\n")


@pytest.mark.parametrize(
    ("text", "y"),
    [
        ("t,u\n0,7\n0,1\n2,1\n", lambda t: t),
        ("t,u\n0,1\n2,1\n2,9\n", lambda t: t),
        ("t,u\n0,9\n0,1\n1,1\n1,3\n2,3\n2,7\n", lambda t: np.where(t < 1.0, t, 3.0 * t - 2.0)),
        ("t,u\n0.5,5\n0.5,1\n1,1\n1,2\n", lambda t: 5.0 * np.minimum(t, 0.5) + later(t)),
    ],
)
def test_tables_may_jump_where_they_begin_and_end(tmp_path: Path, text: str, y: Any) -> None:
    """Behind the first jump counts its second row; what comes behind the last row is its value."""
    result = driven(tmp_path, text, extrapolate="hold")
    assert result["i.y"] == pytest.approx(y(result.time), abs=1e-5)


def later(t: np.ndarray) -> np.ndarray:
    """The integral of 1 from 0.5 to 1 s and of 2 from then on."""
    return np.clip(t - 0.5, 0.0, 0.5) + 2.0 * np.maximum(t - 1.0, 0.0)
