"""Values as people write them: the same number means the same in every place where one is given."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable
from math import inf, isfinite, isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from master_node import Result, System, load_system, simulate
from master_node.cli.app import app
from master_node.study.case import apply_case
from master_node.study.configuration import load_study
from master_node.study.plan import make_plan
from master_node.system.files import open_system
from protocol.errors import ConfigurationError
from protocol.host.toml_text import assigned_values
from protocol.values import BoundsError, checked_value, parsed, value_of
from protocol.variables import Variable, VariableType
from slave_node.serving.given_parameters import check_parameters
from tests.support.ssp_documents import binding, bindings, component, described, real, ssd, system

ITEMS = {"reverse": -1, "neutral": 0, "forward": 1, "fast": 5}
MODE = Variable("mode", type=VariableType.ENUMERATION, items=ITEMS)

types = st.sampled_from([kind for kind in VariableType if kind is not VariableType.CLOCK])
numbers = st.one_of(
    st.integers(-(2**70), 2**70),
    st.integers(-9, 9),
    st.floats(),
    st.integers(-(2**40), 2**40).map(float),
)


# ---- One variable -------------------------------------------------------------------------------


def attempted(variable: Variable, given: object) -> tuple[Any, str]:
    """The value, or None and what is said against it."""
    try:
        return value_of(variable, given), ""
    except ValueError as error:
        return None, str(error)


@given(types, st.one_of(numbers, st.booleans()))
def test_a_number_is_taken_without_a_loss_or_not_at_all(kind: VariableType, number: Any) -> None:
    """Law: what a variable gets equals what was given, and has the type of the variable."""
    variable = Variable("v", type=kind)
    value, told = attempted(variable, number)
    if value is None:
        assert told.startswith(f"is of type {kind}")
        return
    assert value == number or (isnan(number) and isnan(float(value)))
    if kind.is_real:
        assert type(value) is float
    elif kind is VariableType.BOOLEAN:
        assert type(value) is bool
    else:
        assert type(value) is int
        assert kind.integer_range is not None
        assert kind.integer_range[0] <= value <= kind.integer_range[1]
    assert value_of(variable, value) == value or isnan(float(value))


@given(types, numbers)
def test_a_number_in_a_text_is_the_number(kind: VariableType, number: float) -> None:
    """Law: a CSV file or an SSV file says the same as a system file; spaces do not count."""
    if kind in (VariableType.STRING, VariableType.BINARY):
        return
    variable = Variable("v", type=kind)
    try:
        expected = value_of(variable, number)
    except ValueError:
        with pytest.raises(ValueError, match=re.escape(f"is of type {kind}")):
            parsed(variable, f"{number!r}")
        return
    found = parsed(variable, f" {number!r}\n")
    assert type(found) is type(expected)
    assert found == expected or (isnan(float(found)) and isnan(float(expected)))


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (4.0, VariableType.INTEGER),
        (255.0, VariableType.UINT8),
        (float(2**53), VariableType.INT64),
        (4, VariableType.REAL),
        (1, VariableType.BOOLEAN),
        (0.0, VariableType.BOOLEAN),
        (np.float64(4.0), VariableType.INT8),
        (np.int16(4), VariableType.REAL),
        (np.True_, VariableType.BOOLEAN),
        (1.0, VariableType.ENUMERATION),
    ],
)
def test_numbers_that_are_the_same(number: Any, kind: VariableType) -> None:
    """An integer as a float, a float as an integer, a truth value as 0 or 1, NumPy's numbers."""
    assert value_of(Variable("v", type=kind), number) == number


@pytest.mark.parametrize(
    ("kind", "given", "text"),
    [
        (VariableType.INTEGER, 4.5, "is of type Integer, -2147483648 to 2147483647; it cannot be"),
        (VariableType.INTEGER, 2**31, "it cannot be 2147483648"),
        (VariableType.INTEGER, True, "it cannot be True"),
        (VariableType.INTEGER, nan, "it cannot be nan"),
        (VariableType.INT64, inf, "it cannot be inf"),
        (VariableType.BOOLEAN, 2, "it cannot be 2"),
        (VariableType.BOOLEAN, "true", "it cannot be 'true'"),
        (VariableType.REAL, "1.0", "it cannot be '1.0'"),
        (VariableType.REAL, 2**53 + 1, "it cannot be 9007199254740993"),
        (VariableType.FLOAT32, 1e39, "it cannot be 1e[+]39"),
        (VariableType.STRING, 1, "it cannot be 1"),
        (VariableType.BINARY, "0g", "it cannot be '0g'"),
    ],
)
def test_what_would_be_rounded_or_guessed_is_refused(
    kind: VariableType, given: object, text: str
) -> None:
    """With the type, its range, and the value."""
    with pytest.raises(ValueError, match=text):
        value_of(Variable("v", type=kind), given)


def test_an_item_is_given_by_its_name_or_its_number() -> None:
    """Others are told with the items that there are, and the nearest name."""
    assert [value_of(MODE, name) for name in ITEMS] == [-1, 0, 1, 5]
    assert [parsed(MODE, text) for text in ("fast", "5", " 5.0 ")] == [5, 5, 5]
    items = r"Enumeration with the items reverse \(-1\), neutral \(0\), forward \(1\), fast \(5\)"
    with pytest.raises(ValueError, match=f"{items}; it cannot be 'fats'; did you mean 'fast'"):
        value_of(MODE, "fats")
    with pytest.raises(BoundsError, match=f"{items}; 2 is none of them"):
        checked_value(MODE, 2)
    assert checked_value(MODE, 2, ignores_bounds=True) == 2


@pytest.mark.parametrize("assignment", ["n", "=4", " = 4", "n=[4]", "n={a = 1}"])
def test_an_assignment_at_the_prompt_has_a_name_and_one_value(assignment: str) -> None:
    """A list and a table are no value of one variable."""
    with pytest.raises(ConfigurationError, match=re.escape(f"--parameter {assignment}: ")):
        assigned_values("--parameter", ["k=1", assignment])
    texts = ["a=4", "b = 4.0", "c=true", "d=first gear", 'e="4"', "f=a=b"]
    expected = {"a": 4, "b": 4.0, "c": True, "d": "first gear", "e": "4", "f": "a=b"}
    assert assigned_values("--parameter", texts) == expected


def test_an_item_named_like_a_number_is_that_item_where_names_are_given() -> None:
    """A text in a system file is a name; a number is a number."""
    odd = Variable("v", type=VariableType.ENUMERATION, items={"2": 7, "7": 2})
    assert value_of(odd, "2") == 7
    assert value_of(odd, 2) == 2


@given(numbers.filter(isfinite), numbers.filter(isfinite), numbers)
def test_a_value_beyond_its_bounds_is_refused_but_where_they_are_ignored(
    low: float, high: float, number: float
) -> None:
    """Law: both bounds belong to the range, and NaN is in none."""
    variable = Variable("v", type=VariableType.REAL, minimum=low, maximum=high)
    try:
        plain = value_of(variable, number)
    except ValueError:
        return
    if low <= plain <= high:  # type: ignore[operator]
        assert checked_value(variable, number) == plain
    else:
        with pytest.raises(BoundsError, match=r"must be at (least|most) .* \((min|max)\)"):
            checked_value(variable, number)
    ignored = checked_value(variable, number, ignores_bounds=True)
    assert ignored == plain or isnan(number)


# ---- Every place --------------------------------------------------------------------------------

SIMULATION: dict[str, Any] = {"stop_time": 0.1, "initial_step_size": 0.05, "estimator": "none"}

RECORDED: dict[str, Any] = {"locals": ["drive.mode", "drive.n", "drive.gain", "drive.total"]}

HERE: dict[str, Any] = {"in_process": True}


def system_file(folder: Path, fmus: Path, **drive: Any) -> Path:
    """A drive alone, its gear and its number set."""
    path = folder / "drive.toml"
    inputs = drive.pop("inputs", {})
    text = {
        "simulation": SIMULATION,
        "slaves": {"drive": {"model": str(fmus / "drive2.fmu"), **drive}},
        "inputs": {"drive.u": 1.0, **inputs},
        "results": RECORDED,
    }
    path.write_text(tomli_w.dumps(text), encoding="utf-8")
    return path


def in_the_file(folder: Path, fmus: Path, name: str, text: str) -> Result:
    """In ``parameters`` of a system file."""
    value = text if name == "mode" and not text[-1].isdigit() else json.loads(text)
    file = system_file(folder, fmus, parameters={name: value})
    return simulate(load_system(file), **HERE)


def at_the_prompt(folder: Path, fmus: Path, name: str, text: str) -> Result:
    """With ``--parameter``."""
    file, output = system_file(folder, fmus), folder / "out"
    words = ["run", str(file), "--in-process", "--no-plot", "--output", str(output)]
    done = CliRunner().invoke(app, [*words, "--parameter", f"drive.{name}={text}"])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return Result.load(output)


def in_a_package(folder: Path, fmus: Path, name: str, text: str) -> Result:
    """In a parameter set, which says a type: an item's name stands in an Enumeration."""
    kind = "Real" if "." in text else "Integer" if text.isdigit() else "Enumeration"
    values = real("u", 1) + f'<ssv:Parameter name="{name}"><ssv:{kind} value="{text}"/>'
    parameters = bindings(binding(values + "</ssv:Parameter>"))
    with zipfile.ZipFile(folder / "drive.ssp", "w") as archive:
        description = ssd(system(component("drive", "", parameters)), after="")
        archive.writestr("SystemStructure.ssd", description)
        archive.write(fmus / "drive2.fmu", "resources/drive.fmu")
    with open_system(folder / "drive.ssp") as read:
        return simulate(read.with_simulation(**SIMULATION).with_results(**RECORDED), **HERE)


def in_a_table(folder: Path, fmus: Path, name: str, text: str) -> Result:
    """In a CSV file, for a tunable parameter."""
    (folder / "t.csv").write_text(f"t,v\n0,{text}\n", encoding="utf-8")
    table = {"table": "t.csv", "interpolation": "hold", "extrapolate": "hold"}
    file = system_file(folder, fmus, inputs={f"drive.{name}": table})
    return simulate(load_system(file), **HERE)


def in_a_study(folder: Path, fmus: Path, name: str, text: str) -> Result:
    """In a list of a study."""
    value = text if text[-1].isdigit() else json.dumps(text)
    return studied(folder, fmus, f'[parameters]\n"drive.{name}" = [{value}]\n')


def in_cases(folder: Path, fmus: Path, name: str, text: str) -> Result:
    """In a CSV file of a study."""
    (folder / "cases.csv").write_text(f"drive.{name}\n{text}\n", encoding="utf-8")
    return studied(folder, fmus, '[cases]\nfile = "cases.csv"\n')


def studied(folder: Path, fmus: Path, text: str) -> Result:
    """The only run of a study."""
    file, study = system_file(folder, fmus), folder / "study.toml"
    study.write_text(f'system = "drive.toml"\n{text}', encoding="utf-8")
    (run,) = make_plan(load_study(study)).runs
    return simulate(apply_case(load_system(file), run.case), **HERE)


EVERYWHERE = [in_the_file, at_the_prompt, in_a_package, in_a_table, in_a_study, in_cases]


@pytest.mark.parametrize("place", EVERYWHERE)
@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("n", "4", 4),
        ("n", "4.0", 4),
        ("gain", "2", 2.0),
        ("gain", "2.0", 2.0),
        ("mode", "fast", 5),
        ("mode", "5", 5),
    ],
)
def test_it_means_the_same_wherever_it_stands(  # noqa: PLR0917  fixtures and parameters
    tmp_path: Path,
    capability_dir: Path,
    place: Callable[[Path, Path, str, str], Result],
    name: str,
    text: str,
    value: float,
) -> None:
    """In a file, at the prompt, in a package, a table and a study: the FMU has the value."""
    if place is in_a_table and name == "n":
        with pytest.raises(ConfigurationError, match=r"drive\.n is a fixed parameter"):
            place(tmp_path, capability_dir, name, text)
        return
    result = place(tmp_path, capability_dir, name, text)
    assert set(result[f"drive.{name}"].tolist()) == {value}
    n, gain = result["drive.n"][0], result["drive.gain"][0]
    assert set(result["drive.total"].tolist()) == {n * gain}


@pytest.mark.parametrize("place", EVERYWHERE)
@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("gain", "10.5", r"must be at most 10\.0 \(max\); it cannot be 10\.5"),
        ("mode", "3", r"fast \(5\); 3 is none of them"),
        ("mode", "fats", r"'fats'.*; did you mean 'fast'"),
    ],
)
def test_what_the_model_excludes_is_refused_wherever_it_stands(  # noqa: PLR0917  the same
    tmp_path: Path,
    capability_dir: Path,
    place: Callable[[Path, Path, str, str], Result],
    name: str,
    text: str,
    told: str,
) -> None:
    """Before the start: with the bound, or the items."""
    with pytest.raises(ConfigurationError, match=told):
        place(tmp_path, capability_dir, name, text)


def test_bounds_are_ignored_where_the_user_says_so(tmp_path: Path, capability_dir: Path) -> None:
    """One key, for parameters, constants and tables of that slave; types are kept."""
    (tmp_path / "t.csv").write_text("t,v\n0,50\n", encoding="utf-8")
    table = {"table": "t.csv", "interpolation": "hold", "extrapolate": "hold"}
    given = {"parameters": {"n": 9, "mode": 3}, "inputs": {"drive.gain": table}}
    refused = load_system(system_file(tmp_path, capability_dir, **given))
    with pytest.raises(ConfigurationError, match=r"ignore_bounds = true"):
        simulate(refused, in_process=True)
    system = load_system(system_file(tmp_path, capability_dir, ignore_bounds=True, **given))
    result = simulate(system, in_process=True)
    assert [result[f"drive.{name}"][-1] for name in ("n", "mode", "gain")] == [9, 3, 50.0]
    assert result["drive.y"][-1] == pytest.approx(50.0 * 3 * 0.1)


def test_a_function_beyond_the_bounds_ends_the_run(tmp_path: Path, capability_dir: Path) -> None:
    """With the time; the values before are there."""
    (tmp_path / "f.py").write_text("def f(t):\n    return 9.0 if t < 0.04 else 11.0\n", "utf-8")
    function = {"drive.gain": {"function": "f.py:f"}}
    system = load_system(system_file(tmp_path, capability_dir, inputs=function))
    with pytest.raises(Exception, match=r"t=0\.05 s: drive\.gain must be at most 10\.0"):
        simulate(system, in_process=True)


def test_parameters_of_a_served_slave_are_checked_before_it_is_on_the_bus(
    capability_dir: Path,
) -> None:
    """They are checked as those of a system file; it may be told to ignore bounds."""
    description = described(capability_dir / "drive2.fmu")
    check_parameters(description, {"n": 4.0, "mode": "fast"})
    with pytest.raises(ConfigurationError, match=r"'n' must be at most 8 \(max\).*ignore-bounds"):
        check_parameters(description, {"n": 9})
    check_parameters(description, {"n": 9}, ignores_bounds=True)
    with pytest.raises(ConfigurationError, match=r"it cannot be 4\.5"):
        check_parameters(description, {"n": 4.5}, ignores_bounds=True)


def test_python_models_take_the_same_numbers(tmp_path: Path) -> None:
    """An Integer as 4.0, a truth value as 1."""
    (tmp_path / "counter.py").write_text(
        "from protocol.variables import Variable, VariableType\n"
        "from slave_node.model import Model, real\n"
        "class Counter(Model):\n"
        "    parameters = (\n"
        "        Variable('n', type=VariableType.INTEGER, start=1),\n"
        "        Variable('on', type=VariableType.BOOLEAN, start=False),\n"
        "    )\n"
        "    states = outputs = (real('x', start=0.0),)\n"
        "    def derivatives(self, t, x, u):\n"
        "        return [self.n if self.on else 0.0]\n",
        encoding="utf-8",
    )
    parameters = {"n": 4.0, "on": 1}
    system = System(
        simulation={"stop_time": 0.5},
        slaves={"c": {"model": "counter.py:Counter", "parameters": parameters}},
        base=tmp_path,
    )
    assert simulate(system, in_process=True)["c.x"][-1] == pytest.approx(2.0)
