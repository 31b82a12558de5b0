"""System files: what they mean, and that every mistake is found before anything starts."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from master_node import BusSettings, ResultsSettings, SimulationSettings, System, load_system
from master_node.hosts.opening import slaves_on_bus
from master_node.numerics.extrapolation import InputPolynomial
from master_node.system.summary import settings_of
from master_node.system.tables import OutputTolerance, SlaveSettings
from master_node.system.toml_files import MAX_BYTES
from protocol.errors import ConfigurationError
from protocol.host.toml_text import toml_value
from tests.support.quarter_car_case import EXAMPLES

SYSTEM = """
[simulation]
stop_time = 4.0

[slaves.chassis]
model = "chassis.fmu"

[slaves.wheel]
model = "wheel.fmu"

[[connections]]
from = "wheel.x"
to = "chassis.x_w"

[[connections]]
from = "chassis.x"
to = "wheel.x_c"
"""


def written(tmp_path: Path, text: str) -> Path:
    """A system file."""
    path = tmp_path / "car.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(tmp_path: Path, text: str) -> str:
    """Why the file is refused, without its own name, which must stand in front of each line."""
    path = written(tmp_path, text)
    with pytest.raises(ConfigurationError) as info:
        load_system(path)
    lines = str(info.value).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines)
    return "\n".join(line.removeprefix(f"{path}: ") for line in lines)


def simulation(line: str) -> str:
    """The system file with another line in its ``[simulation]`` table."""
    return SYSTEM.replace("stop_time = 4.0", f"stop_time = 4.0\n{line}")


def wheel(line: str) -> str:
    """Text of a system file with keys in ``[slaves.wheel]``."""
    return SYSTEM.replace('model = "wheel.fmu"', f'model = "wheel.fmu"\n{line}')


def bus(line: str) -> str:
    """Text of a system file with a ``[bus]`` table."""
    return f"{SYSTEM}\n[bus]\n{line}\n"


# ---- What a file means --------------------------------------------------------------------------


def test_a_file_is_read_as_it_is_written(tmp_path: Path) -> None:
    """All keys of all tables arrive, and numbers may be written as integers."""
    text = """
    [simulation]
    start_time = 1
    stop_time = 5
    initial_step_size = 0.25
    order = 3
    derivative_points = 2
    estimator = "rich"
    constants = "exact"
    controller = "elementary"
    sequence = "gauss-seidel"
    evaluate_outputs = true
    discontinuities = false
    events = [2, 3.5]
    relative_tolerance = 0
    absolute_tolerance = 1e-6
    slave_tolerance = 1e-8
    alpha = 0.9
    theta_min = 0.2
    theta_max = 5.0
    smallest_step_size = 1e-6
    largest_step_size = 0.5
    initial_history = "none"
    output_interval = 0.125

    [slaves.a]
    model = "a.fmu"
    step_size = 1
    step_multiple = 0.5
    smallest_step_size = 1e-3
    largest_step_size = 2
    outputs_follow_inputs = true
    parameters = { m = 40.0, n = 3, on = true, name = "text" }
    relative_tolerance = 1e-3
    absolute_tolerance = 1e-2
    tolerances = { x = { relative = 1e-5, absolute = 1e-7 } }

    [slaves."b.c"]

    [[connections]]
    from = "a.x"
    to = "b.c.y"

    [results]
    variables = ["a.*", "!a.z"]
    every = 10
    formats = ["arrow", "parquet", "mat", "csv"]

    [bus]
    listen = ["tcp/127.0.0.1:7447"]
    connect = ["tcp/127.0.0.1:7448"]
    insecure = true
    discovery_timeout = 5
    step_timeout = 0.5
    """
    path = written(tmp_path, text)
    system = load_system(path)
    assert system.simulation == SimulationSettings(
        start_time=1,
        stop_time=5,
        initial_step_size=0.25,
        order=3,
        derivative_points=2,
        estimator="rich",
        constants="exact",
        controller="elementary",
        sequence="gauss-seidel",
        evaluate_outputs=True,
        discontinuities=False,
        events=(2.0, 3.5),
        relative_tolerance=0,
        absolute_tolerance=1e-6,
        slave_tolerance=1e-8,
        alpha=0.9,
        theta_min=0.2,
        theta_max=5.0,
        smallest_step_size=1e-6,
        largest_step_size=0.5,
        initial_history="none",
        output_interval=0.125,
    )
    assert dict(system.slaves) == {
        "a": SlaveSettings(
            model="a.fmu",
            step_size=1,
            step_multiple=0.5,
            smallest_step_size=1e-3,
            largest_step_size=2,
            outputs_follow_inputs=True,
            parameters={"m": 40.0, "n": 3, "on": True, "name": "text"},
            relative_tolerance=1e-3,
            absolute_tolerance=1e-2,
            tolerances={"x": OutputTolerance(relative=1e-5, absolute=1e-7)},
        ),
        "b.c": SlaveSettings(),
    }
    parameters = system.slaves["a"].parameters
    assert [type(value) for value in parameters.values()] == [float, int, bool, str]
    assert [(c.source, c.target) for c in system.connections] == [("a.x", "b.c.y")]
    assert system.results == ResultsSettings(
        variables=("a.*", "!a.z"), every=10, formats=("arrow", "parquet", "mat", "csv")
    )
    assert system.bus == BusSettings(
        listen=("tcp/127.0.0.1:7447",),
        connect=("tcp/127.0.0.1:7448",),
        insecure=True,
        discovery_timeout=5,
        step_timeout=0.5,
    )
    assert system.base == tmp_path
    assert system.source == str(path)


def test_defaults_are_those_that_the_documentation_names(tmp_path: Path) -> None:
    """The order and the first step size are chosen by the system, with all derivatives there are.

    The controller within the paper's ranges; slaves integrate two orders below RTOL.
    """
    settings = load_system(written(tmp_path, SYSTEM)).simulation
    assert settings.start_time == 0.0
    assert settings.initial_step_size is None
    assert (settings.order, settings.estimator) == ("auto", "mod")
    assert (settings.constants, settings.controller) == ("exact", "pi")
    assert (settings.sequence, settings.evaluate_outputs) == ("jacobi", False)
    assert (settings.discontinuities, settings.events) == (True, ())
    assert (settings.preset, settings.output_grid) == (None, None)
    assert settings.polynomial == InputPolynomial(3, 2)
    assert (settings.relative_tolerance, settings.absolute_tolerance) == (1e-4, 1e-4)
    assert settings.slave_relative_tolerance == pytest.approx(1e-6)
    assert (settings.alpha, settings.theta_min, settings.theta_max) == (0.85, 0.3, 2.0)
    assert (settings.smallest, settings.largest) == pytest.approx((4e-9, 2.0))
    assert not settings.rests_before_start


def test_a_given_order_is_that_of_the_paper_unless_more_is_asked_for(tmp_path: Path) -> None:
    """Values only, from a history at rest; derivatives and another history where they are named."""
    settings = load_system(written(tmp_path, simulation("order = 2"))).simulation
    assert settings.polynomial == InputPolynomial(2, 0)
    assert settings.rests_before_start
    more = load_system(
        written(tmp_path, simulation('order = 2\nderivative_points = 1\ninitial_history = "none"'))
    ).simulation
    assert more.polynomial == InputPolynomial(2, 1)
    assert not more.rests_before_start


def test_without_an_estimator_there_is_nothing_to_choose_an_order_by(tmp_path: Path) -> None:
    """Fixed steps have order 1 and a thousandth of the time, unless told otherwise."""
    settings = load_system(written(tmp_path, simulation('estimator = "none"'))).simulation
    assert settings.polynomial == InputPolynomial(1, 0)
    assert settings.step_size == pytest.approx(4e-3)
    given = load_system(written(tmp_path, simulation('estimator = "none"\norder = 3'))).simulation
    assert given.polynomial == InputPolynomial(3, 0)


@given(
    st.floats(1e-3, 1e6),
    st.one_of(st.none(), st.floats(1e-9, 1e6)),
    st.one_of(st.none(), st.floats(1e-9, 1e6)),
)
def test_default_step_sizes_keep_each_others_bounds(
    stop: float, smallest: float | None, largest: float | None
) -> None:
    """H_0 lies between the bounds whichever of them is given, or the message names what is."""
    bounds = {"smallest_step_size": smallest, "largest_step_size": largest}
    given_bounds = {name: value for name, value in bounds.items() if value is not None}
    try:
        settings = SimulationSettings(stop_time=stop, **given_bounds)
    except ValueError as error:
        assert smallest is not None
        assert largest is not None
        assert smallest > largest
        assert "smallest_step_size" in str(error)  # noqa: PT017  most draws raise nothing
        return
    assert settings.smallest <= settings.step_size
    if largest is not None:
        assert settings.step_size <= largest


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.toml")))
def test_the_examples_are_right(name: str) -> None:
    """The files that a newcomer copies load, and their models are named relative to them."""
    system = load_system(EXAMPLES / name)
    assert system.base == EXAMPLES
    assert set(system.slaves) == {"chassis", "wheel"}


def test_settings_are_frozen(tmp_path: Path) -> None:
    """A run cannot change what it was asked for."""
    system = load_system(written(tmp_path, SYSTEM))
    with pytest.raises(ValueError, match="frozen"):
        system.simulation.order = 2
    with pytest.raises(ValueError, match="frozen"):
        system.bus = BusSettings()


def test_a_system_goes_round_trip(tmp_path: Path) -> None:
    """The settings in ``summary.json`` make the same system again."""
    text = wheel("parameters = { z = 0.2 }\ntolerances = { x = { absolute = 1e-6 } }")
    system = load_system(written(tmp_path, text))
    tables = system.model_dump(mode="json", by_alias=True)
    assert System(**tables, base=system.base, source=system.source) == system
    assert settings_of(system, {})["slaves"] == tables["slaves"]


def test_a_system_is_described_in_python_too() -> None:
    """Pairs are connections, plain dictionaries are tables."""
    system = System(
        simulation={"stop_time": 1.0},
        slaves={"a": {"model": "a.fmu"}, "b": {"model": "b.fmu"}},
        connections=[("a.y", "b.u"), {"from": "b.y", "to": "a.u"}],
    )
    assert [(c.source, c.target) for c in system.connections] == [("a.y", "b.u"), ("b.y", "a.u")]
    assert system.base == Path.cwd()
    with pytest.raises(ConfigurationError, match=r"^the system: \[simulation\] order = 9: "):
        System(simulation={"order": 9}, slaves={"a": {}})


# ---- Overrides ----------------------------------------------------------------------------------


def test_overrides_change_what_they_name_and_nothing_else(tmp_path: Path) -> None:
    """The command line wins over the file; None leaves a setting as it is."""
    system = load_system(written(tmp_path, simulation("order = 2\nalpha = 0.9")))
    changed = system.with_simulation(order=3, estimator="rich", stop_time=None, alpha=None)
    assert changed.simulation == SimulationSettings(
        stop_time=4.0, order=3, alpha=0.9, estimator="rich"
    )
    assert (changed.slaves, changed.connections) == (system.slaves, system.connections)
    assert (changed.base, changed.source) == (system.base, system.source)
    assert system.simulation.order == 2


def test_derived_defaults_follow_an_override(tmp_path: Path) -> None:
    """Defaults follow the overridden values, not those of the file."""
    system = load_system(written(tmp_path, SYSTEM))
    shorter = system.with_simulation(stop_time=0.4, relative_tolerance=1e-2).simulation
    assert shorter.step_size == pytest.approx(0.4e-3)
    assert shorter.slave_relative_tolerance == pytest.approx(1e-4)


def test_a_wrong_override_is_refused_like_a_wrong_file(tmp_path: Path) -> None:
    """Overrides meet the checks of a file, with the same words."""
    system = load_system(written(tmp_path, SYSTEM))
    with pytest.raises(ConfigurationError, match=r"car\.toml: \[simulation\] .*after start_time"):
        system.with_simulation(start_time=4.0)
    with pytest.raises(ConfigurationError, match=r"\[simulation\] estimator = 'modd': .*'mod'"):
        system.with_simulation(estimator="modd")
    with pytest.raises(ConfigurationError, match="unknown key 'ordr'; did you mean 'order'"):
        system.with_simulation(ordr=1)


def test_bus_overrides(tmp_path: Path) -> None:
    """Empty lists and switches that were not given leave the file's settings."""
    system = load_system(written(tmp_path, bus('listen = ["tcp/127.0.0.1:1"]\ninsecure = true')))
    changed = system.with_bus(connect=("tcp/a:2",), listen=(), insecure=False, step_timeout=None)
    assert changed.bus == BusSettings(
        listen=("tcp/127.0.0.1:1",), connect=("tcp/a:2",), insecure=True
    )
    assert changed.simulation == system.simulation


def test_results_overrides(tmp_path: Path) -> None:
    """Keys that were not given leave the file's settings."""
    text = f"{SYSTEM}\n[results]\nvariables = ['wheel.*']\nevery = 5\n"
    system = load_system(written(tmp_path, text))
    changed = system.with_results(variables=(), every=None, formats=("mat",))
    assert changed.results == ResultsSettings(variables=("wheel.*",), every=5, formats=("mat",))
    assert (changed.simulation, changed.bus) == (system.simulation, system.bus)


def test_a_missing_stop_time_may_come_later_but_must_come(tmp_path: Path) -> None:
    """The file may leave it to the command line; without it nothing is started."""
    system = load_system(written(tmp_path, SYSTEM.replace("stop_time = 4.0", "")))
    assert system.with_simulation(stop_time=2.0).simulation.end == 2.0
    with pytest.raises(
        ConfigurationError, match=r"car\.toml: \[simulation\] stop_time is missing; .*--stop-time"
    ):
        settings_of(system, {})


# ---- Mistakes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (simulation("oder = 1"), "[simulation] unknown key 'oder'; did you mean 'order'"),
        (simulation("tolerance = 1"), "[simulation] unknown key 'tolerance'; did you mean "),
        (
            SYSTEM.replace("[simulation]", "[simulaton]"),
            "unknown key 'simulaton'; did you mean 'simulation'",
        ),
        (f"{SYSTEM}\n[base]\n", "base: unknown table or key"),
        (f"source = 'x'\n{SYSTEM}", "source: unknown table or key"),
        (wheel("modl = 1"), "[slaves.wheel] unknown key 'modl'; did you mean 'model'?"),
        (
            wheel("tolerances = { x = { relativ = 1.0 } }"),
            "[slaves.wheel.tolerances.x] unknown key 'relativ'; did you mean 'relative'?",
        ),
        (
            f"{SYSTEM}\nfactr = 1",
            "[[connections]] number 2: unknown key 'factr'; did you mean 'factor'?",
        ),
        (bus("conect = []"), "[bus] unknown key 'conect'; did you mean 'connect' or"),
        (f"{SYSTEM}\n[results]\nvariable = []", "[results] unknown key 'variable'; did you mean"),
    ],
)
def test_unknown_keys_are_mistakes_everywhere(tmp_path: Path, text: str, words: str) -> None:
    """A misspelt key is named with its table and the nearest key that there is."""
    assert words in refusal(tmp_path, text)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("order", "4", "0, 1, 2, 3 or 'auto'"),
        ("order", "-1", "0, 1, 2, 3 or 'auto'"),
        ("order", "true", "whole number"),
        ("order", '"1"', "0, 1, 2, 3 or 'auto'"),
        ("derivative_points", "3", "0, 1 or 2"),
        ("derivative_points", "true", "whole number"),
        ("preset", '"papr"', "'paper'"),
        ("constants", '"papers"', "'exact' or 'paper'"),
        ("controller", '"p"', "'pi' or 'elementary'"),
        ("sequence", '"gauss"', "'jacobi' or 'gauss-seidel'"),
        ("evaluate_outputs", "1", ""),
        ("discontinuities", '"no"', ""),
        ("events", "1.0", "must be an array"),
        ("output_interval", "0", "greater than 0"),
        ("estimator", '"richardson"', "'rich', 'mod' or 'none'"),
        ("initial_history", '"zero"', "'rest' or 'none'"),
        ("relative_tolerance", "-1e-4", "greater than or equal to 0"),
        ("absolute_tolerance", "0", "greater than 0"),
        ("absolute_tolerance", "nan", ""),
        ("slave_tolerance", "0.0", "greater than 0"),
        ("initial_step_size", "0", "greater than 0"),
        ("initial_step_size", "-1e-3", "greater than 0"),
        ("initial_step_size", "inf", "finite"),
        ("smallest_step_size", "0.0", "greater than 0"),
        ("largest_step_size", "-1", "greater than 0"),
        ("alpha", "1.0", "less than 1"),
        ("alpha", "0", "greater than 0"),
        ("theta_min", "1.5", "less than 1"),
        ("theta_max", "1", "greater than 1"),
        ("start_time", "nan", "finite"),
        ("start_time", '"0"', "number"),
        ("start_time", "true", "number"),
        ("start_time", "[0.0]", "number"),
    ],
)
def test_wrong_values_are_named_with_what_is_allowed(
    tmp_path: Path, key: str, value: str, words: str
) -> None:
    """Table, key, the value as it was given, and what would be right."""
    text = refusal(tmp_path, simulation(f"{key} = {value}"))
    assert text.startswith(f"[simulation] {key} = ")
    assert words in text


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("start_time = 4.0", "stop_time 4 must be after start_time 4"),
        ("start_time = 5.0", "stop_time 4 must be after start_time 5"),
        (
            "initial_step_size = 1e-3\nsmallest_step_size = 1e-2",
            "initial_step_size 0.001 is below smallest_step_size 0.01",
        ),
        (
            "initial_step_size = 0.1\nlargest_step_size = 1e-2",
            "initial_step_size 0.1 is above largest_step_size 0.01",
        ),
        (
            "smallest_step_size = 0.1\nlargest_step_size = 0.01",
            "smallest_step_size 0.1 is above largest_step_size 0.01",
        ),
        ("events = [4.0]", "the event at 4 is not between start and stop time"),
        ("events = [1.0, 0.0]", "the event at 0 is not between start and stop time"),
        (
            "order = 2\nderivative_points = 2",
            "a polynomial of order 2 cannot meet derivatives at 2 points",
        ),
        (
            'constants = "paper"\nderivative_points = 1',
            'constants = "paper" hold for values only: they need derivative_points = 0',
        ),
        (
            'constants = "paper"\nsequence = "gauss-seidel"',
            'constants = "paper" hold for sequence = "jacobi" only',
        ),
        (
            "output_interval = 1e-12",
            "output_interval 1e-12 gives more than 1e+08 result points",
        ),
        (
            "start_time = -1e40",
            "1e+40 s from start_time to stop_time cannot be computed with: between 1e-30 and "
            "1e+30 s can",
        ),
        (
            "start_time = -1.7e308\nstop_time = 1.7e308",
            "inf s from start_time to stop_time cannot be computed with: between 1e-30 and "
            "1e+30 s can",
        ),
        (
            "stop_time = 1e-300",
            "1e-300 s from start_time to stop_time cannot be computed with: between 1e-30 and "
            "1e+30 s can",
        ),
    ],
)
def test_values_that_contradict_each_other(tmp_path: Path, lines: str, words: str) -> None:
    """Both keys are named with both values."""
    text = SYSTEM.replace("stop_time = 4.0\n", "") if "stop_time = " in lines else SYSTEM
    text = text.replace("[simulation]", f"[simulation]\n{lines}")
    assert refusal(tmp_path, text) == f"[simulation] {words}"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "key 'slaves' is missing"),
        ("[slaves]", "at least one [slaves.NAME] table is needed"),
        ("slaves = 3", "slaves = 3"),
        ('[slaves]\nwheel = "wheel.fmu"', "[slaves] wheel = 'wheel.fmu': must be a table"),
        ('[slaves."a/b"]', "'a/b' is not a valid slave name; use 1 to 128 characters out of"),
        ('[slaves."a*"]', "'a*' is not a valid slave name"),
        ('[slaves.""]', "'' is not a valid slave name"),
        ('[slaves.a]\nsha256 = "12"', "write 64 hexadecimal digits"),
        ('[slaves.a]\nsha256 = "' + 64 * "g" + '"', "write 64 hexadecimal digits"),
        ('simulation = "x"\n[slaves.a]', "simulation = 'x': must be a table"),
        ("[slaves.a]\nmodel = 3", "[slaves.a] model = 3: "),
        ("[slaves.a]\nparameters = nan", "[slaves.a] parameters = nan: must be a table"),
        ("[slaves.a]\nrequires = 0.0", "[slaves.a] requires = 0.0: must be a table"),
        (
            "[slaves.a]\nparameters = { m = [{}] }",
            "[slaves.a.parameters] m = [{}]: must be a number, a boolean, a string or an array",
        ),
        ("[slaves.a]\nrelative_tolerance = -1", "[slaves.a] relative_tolerance = -1: "),
        ("[slaves.a]\nabsolute_tolerance = 0", "[slaves.a] absolute_tolerance = 0: "),
        ("[slaves.a]\nstep_size = 0", "[slaves.a] step_size = 0: "),
        ("[slaves.a]\nstep_multiple = -1", "[slaves.a] step_multiple = -1: "),
        ("[slaves.a]\nlargest_step_size = 0", "[slaves.a] largest_step_size = 0: "),
        ("[slaves.a]\noutputs_follow_inputs = 1", "[slaves.a] outputs_follow_inputs = 1: "),
        ("[slaves.a]\ntolerances = { x = 1 }", "[slaves.a.tolerances] x = 1: must be a table"),
        (
            "[slaves.a]\ntolerances = { x = { absolute = 0 } }",
            "[slaves.a.tolerances.x] absolute = 0: ",
        ),
        ("[slaves.a]\n[connections]", "connections = {}: must be an array"),
        ('[slaves.a]\n[[connections]]\nto = "a.u"', "[[connections]] number 1: key 'from'"),
        ('[slaves.a]\n[[connections]]\nfrom = "a.y"', "[[connections]] number 1: key 'to'"),
        (
            '[slaves.a]\n[[connections]]\nfrom = 3\nto = "a.u"',
            "[[connections]] number 1: from = 3: ",
        ),
        (
            '[slaves.a]\n[[connections]]\nfrom = "a"\nto = "a.u"',
            "[[connections]] number 1: from = 'a': write slave.variable",
        ),
        ('[slaves.a]\n[bus]\nlisten = "x"', "[bus] listen = 'x': must be an array"),
        ("[slaves.a]\n[bus]\ninsecure = 1", "[bus] insecure = 1: "),
        ("[slaves.a]\n[bus]\nstep_timeout = 0", "[bus] step_timeout = 0: "),
        ("[slaves.a]\n[results]\nevery = 0", "[results] every = 0: "),
        ("[slaves.a]\n[results]\nevery = 1.5", "[results] every = 1.5: "),
        ("[slaves.a]\n[results]\nformats = []", "[results] formats = []: must not be empty"),
        ("[slaves.a]\n[results]\nformats = ['xls']", "'csv', 'arrow', 'parquet' or 'mat'"),
        ("[slaves.a]\n[results]\nvariables = 'a.*'", "variables = 'a.*': must be an array"),
        ("[slaves.a]\n[results]\nvariables = []", "[results] variables = []: must not be empty"),
        ("[slaves.a]\n[results]\nvariables = ['!']", "'!': write a pattern for slave.variable"),
        ("[slaves.a]\n[bus]\ndiscovery_timeout = -1", "[bus] discovery_timeout = -1: "),
        ("[slaves.a]\n[slaves.a]", "not a TOML file: "),
        ("[slaves.a", "not a TOML file: "),
    ],
)
def test_mistakes_are_named_with_their_table(tmp_path: Path, text: str, words: str) -> None:
    """Whatever is wrong, the message says in which table, at which key, and what it should be."""
    assert words in refusal(tmp_path, text)


def test_all_mistakes_are_told_at_once(tmp_path: Path) -> None:
    """A line for each, so that a file is put right in one go."""
    text = simulation("order = 7\nestimator = 1") + "\nunit = 3\n[bus]\nport = 1"
    lines = refusal(tmp_path, text).splitlines()
    assert len(lines) == 4
    for part in ("order", "estimator", "unit", "port"):
        assert sum(part in line for line in lines) == 1


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: None, "cannot be read: No such file or directory"),
        (lambda path: path.mkdir(), "cannot be read: Is a directory"),
        (lambda path: path.write_bytes(b"\xff\xfe"), "not a TOML file: "),
    ],
)
def test_a_file_that_cannot_be_read(tmp_path: Path, make: Any, words: str) -> None:
    """A sentence with the path, whatever lies there."""
    path = tmp_path / "car.toml"
    make(path)
    with pytest.raises(ConfigurationError, match=f"{re.escape(str(path))}: {words}"):
        load_system(path)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('listen = ["127.0.0.1:7447"]', "'127.0.0.1:7447' is not an endpoint; write tcp/HOST:PORT"),
        ('connect = ["tcp/127.0.0.1"]', "'tcp/127.0.0.1' is not an endpoint"),
        ('listen = ["tcp/0.0.0.0:0"]', "tcp/0.0.0.0:0 is not a loopback address"),
        ('connect = ["tcp/example.org:1"]', "tcp/example.org:1 is not a loopback address"),
    ],
)
def test_endpoints_are_checked_before_anything_starts(
    tmp_path: Path, line: str, words: str
) -> None:
    """No slave is launched and no port opened for an address that cannot be right or is unsafe."""
    system = load_system(written(tmp_path, bus(line)))
    expected = rf"car\.toml: \[bus\] {re.escape(words)}"
    with pytest.raises(ConfigurationError, match=expected), slaves_on_bus(system, tmp_path):
        pytest.fail("it started")
    assert list(tmp_path.glob("*.log")) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = " + "[" * 100_000, "not a TOML file: it is nested too deeply"),
        ("x = " + "{a=" * 100_000, "not a TOML file: it is nested too deeply"),
        ("x = " + "9" * 5000, "not a TOML file: "),
        (f"x = '{'a' * MAX_BYTES}'", f"more than {MAX_BYTES} bytes"),
    ],
    ids=["arrays", "tables", "a number", "a file"],
)
def test_what_is_beyond_all_measure_is_refused(tmp_path: Path, text: str, words: str) -> None:
    """Depth, digits and bytes have limits, and reaching one is a mistake as any other."""
    assert refusal(tmp_path, text).startswith(words)


def test_mistakes_without_number_are_counted(tmp_path: Path) -> None:
    """The first hundred are told, of the others how many there are."""
    lines = refusal(tmp_path, "\n".join(f"k{i} = 0" for i in range(1000)) + "\n" + SYSTEM)
    told = lines.splitlines()
    assert len(told) == 101
    assert told[-1] == "and 900 more mistakes"


def test_a_byte_order_mark_is_no_mistake(tmp_path: Path) -> None:
    """Some editors put one in front of the file."""
    assert load_system(written(tmp_path, "\ufeff" + SYSTEM)).simulation.stop_time == 4.0


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("1e-3", 1e-3),
        ("true", True),
        ("'1'", "1"),
        ("", ""),
        ("red", "red"),
        ("3 # 4", "3 # 4"),
        ("3\nx = 4", "3\nx = 4"),
        ("3, x = 4", "3, x = 4"),
        ("3 }", "3 }"),
        ("[" * 100_000, "[" * 100_000),
        ("9" * 5000, "9" * 5000),
    ],
)
def test_a_text_is_a_value_as_a_whole_or_itself(text: str, value: object) -> None:
    """Nothing of a text is passed over to make a number of the rest."""
    assert toml_value(text) == value
    assert type(toml_value(text)) is type(value)


@given(st.text(max_size=200))
def test_no_text_breaks_the_reader(text: str) -> None:
    """Any text is a system or a `ConfigurationError`, never another exception."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "any.toml"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        with pytest.raises(ConfigurationError):
            load_system(path)
