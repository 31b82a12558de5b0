"""Check of systems: what it says is what a run finds, and it takes no step and leaves nothing."""

from __future__ import annotations

import json
import logging
import os
import re
import stat
from math import cos, isnan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_node import Result, System, SystemReport, check_system, load_system, simulate
from master_node.checking.graph import dot, mermaid, write_graph
from master_node.checking.report import LoopReport, When
from master_node.checking.state_costs import state_remedy
from master_node.checking.tables import report_tables
from master_node.checking.warnings import gathered_warnings
from protocol.errors import ConfigurationError, SlaveLostError
from tests.conftest import EXAMPLES
from tests.faults.test_processes import MainCommand, Start, command, start, system_file
from tests.support.places import SUPPORT

__all__ = ["command", "start"]

pytestmark = pytest.mark.usefixtures("no_process_left")

GAINS = SUPPORT / "gain_models.py"


@pytest.fixture
def capabilities(capability_dir: Path, tmp_path: Path) -> Path:
    """The folder of the examples for single capabilities, as it is once its FMUs are built."""
    folder = tmp_path / "capabilities"
    folder.mkdir()
    for file in (*capability_dir.glob("*.fmu"), *(EXAMPLES / "capabilities").glob("*.toml")):
        (folder / file.name).symlink_to(file)
    return folder


def gains(*factors: float, **more: Any) -> System:
    """A ring of slaves with these factors."""
    names = [f"g{i}" for i in range(len(factors))]
    ring = zip(names, (*names[1:], names[0]), strict=True)
    return System(
        simulation={"stop_time": 1.0, "estimator": "none"},
        slaves={
            name: {"model": f"{GAINS}:Gain", "parameters": {"k": factor}}
            for name, factor in zip(names, factors, strict=True)
        },
        connections=[{"from": f"{a}.y", "to": f"{b}.u", **more} for a, b in ring],
    )


# ---- The report ---------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["launched", "in process"])
def test_the_quarter_car(place: str, fmu_dir: Path, tmp_path: Path) -> None:
    """Real FMUs, in processes of their own or here: slaves, connections, units, bounds."""
    models = {name: fmu_dir / f"{name}.fmu" for name in ("chassis", "wheel")}
    system = load_system(system_file(tmp_path, **models))
    report = check_system(system, in_process=place == "in process")
    assert [slave.name for slave in report.slaves] == ["chassis", "wheel"]
    for slave in report.slaves:
        assert slave.kind == "FMI 2.0 co-simulation"
        assert (slave.place, slave.host) == (place, os.uname().nodename)
        assert (slave.state_kind, slave.state_verdict) == ("native", "exact")
        assert slave.state_costs is not None
        assert 0.0 < slave.state_costs.get < 1.0
        assert 0.0 < slave.state_costs.set < 1.0
        assert (slave.inputs, slave.outputs, slave.input_order) == (2, 2, 3)
    assert [(c.source, c.target, c.source_unit) for c in report.connections] == [
        ("chassis.x", "wheel.x_c", "m"),
        ("chassis.v", "wheel.v_c", "m/s"),
        ("wheel.x", "chassis.x_w", "m"),
        ("wheel.v", "chassis.v_w", "m/s"),
    ]
    assert (report.unconnected, report.unused, report.loops, report.warnings) == ((), (), (), ())
    bounds = {bound.what: bound.value for bound in report.bounds}
    assert bounds["smallest H"] == system.simulation.smallest
    assert bounds["largest H"] == system.simulation.largest
    assert sorted(path.name for path in tmp_path.iterdir()) == ["car.toml"]


def test_no_step_is_taken(tmp_path: Path) -> None:
    """A model that sleeps in its first step passes the check at once."""
    models = SUPPORT / "quarter_car_models.py"
    file = system_file(
        tmp_path,
        f"{models}:Sleeper",
        chassis_parameters={"sleeps_at": 1e-12, "nap": 20.0, "bed": str(tmp_path / "asleep")},
    )
    check_system(load_system(file), in_process=True)
    assert not (tmp_path / "asleep").exists()


def test_saved_states_of_all_kinds_and_their_warnings(
    capabilities: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Law: the warnings are those of a run before its first step, and none is logged.

    Kinds are those that the run takes after its trial steps.
    """
    system = load_system(capabilities / "saved_states.toml")
    caplog.set_level(logging.WARNING)
    report = check_system(system, in_process=True)
    assert not [r for r in caplog.records if r.name == "master_node"]
    result = simulate(system, in_process=True)
    kinds = {slave.name: slave.state_kind for slave in report.slaves}
    assert kinds == result.summary["state_kind"] == {n: n for n in ("native", "fork", "replay")}
    told = [r.getMessage() for r in caplog.records if r.name == "master_node"]
    assert list(dict.fromkeys(told)) == list(report.warnings)
    costs = {slave.name: slave.state_costs for slave in report.slaves}
    assert all(c is not None and not c.refusal and c.set > 0.0 for c in costs.values())


def test_a_state_that_cannot_be_saved_costs_nothing(capability_dir: Path, tmp_path: Path) -> None:
    """It is none, with its reason; what bounds H then are the defects of inputs."""
    file = system_file(tmp_path, wheel=capability_dir / "wheel_no_state.fmu")
    report = check_system(load_system(file).with_slave("wheel", state="none"), in_process=True)
    wheel = report.slaves[1]
    assert (wheel.state_kind, wheel.state_costs) == ("none", None)
    assert wheel.state_reason
    assert any(b.what == "defects" and "wheel" in b.why for b in report.bounds)


def test_units_casts_and_mappings(capabilities: Path) -> None:
    """Factors and offsets between units; types on both sides; what is held in each step."""
    report = check_system(load_system(capabilities / "units.toml"), in_process=True)
    ways = [(c.source_unit, c.target_unit, c.factor, c.offset) for c in report.connections]
    assert ways[0] == ("m", "mm", 1000.0, 0.0)
    assert ways[2][:3] == ("K", "degC", 1.0)
    assert ways[2][3] == pytest.approx(-273.15)
    text = (EXAMPLES / "discrete" / "discrete.toml").read_text(encoding="utf-8")
    file = capabilities / "discrete.toml"
    file.write_text(text.replace("../capabilities/", ""), encoding="utf-8")
    report = check_system(load_system(file), in_process=True)
    first = report.connections[0]
    assert (first.cast, first.is_continuous, first.is_mapped) == ("Boolean to Real", False, False)
    values = {one.name: one.value for one in report.unconnected}
    assert values["clock.string_in"] == ""
    assert values["device.real_discrete_in"] == 0.0
    assert "device.toggle_out" in report.unused
    assert "clock.toggle_out" not in report.unused
    assert any(b.what == "events" and "clock.toggle_out" in b.why for b in report.bounds)


def test_inputs_from_outside_and_from_parameters(oscillator_dir: Path, tmp_path: Path) -> None:
    """Each input that no output feeds, with its value and who gives it."""
    system = System(
        simulation={"stop_time": 1.0, "events": [0.5]},
        slaves={
            "mass": {
                "model": str(oscillator_dir / "mass.fmu"),
                "parameters": {"v_left": 2.5},
            }
        },
        inputs={
            "mass.x_left": (np.array([0.0, 0.5, 1.0]), np.array([0.0, 1.0, 0.0])),
            "mass.x_right": 0.25,
        },
    )
    report = check_system(system, in_process=True)
    told = {one.name: (one.value, one.given_by, one.description) for one in report.unconnected}
    assert told == {
        "mass.x_left": (None, "[inputs]", "a table"),
        "mass.v_left": (2.5, "parameters", ""),
        "mass.x_right": (0.25, "[inputs]", ""),
        "mass.v_right": (0.0, "the model", ""),
    }
    assert any(b.what == "ends at" and "events at t = 0.5 s" in b.why for b in report.bounds)


def test_rules_of_slaves_bound_h(tmp_path: Path) -> None:
    """Slaves that give the smallest and the largest H, and a grid, are named."""
    system = (
        load_system(system_file(tmp_path))
        .with_slave("chassis", largest_step_size=0.05)
        .with_slave("wheel", step_multiple=1e-3)
    )
    bounds = {b.what: b for b in check_system(system, in_process=True).bounds}
    assert bounds["largest H"].value == 0.05
    assert "chassis" in bounds["largest H"].why
    assert bounds["multiples of"].value == 1e-3
    assert "wheel" in bounds["multiples of"].why
    fixed = check_system(
        system.with_simulation(estimator="none", initial_step_size=0.002), in_process=True
    )
    assert fixed.bounds[0].what == "fixed H"
    assert fixed.bounds[0].value == 0.002


# ---- Loops --------------------------------------------------------------------------------------


@pytest.mark.parametrize("factors", [(0.5,), (0.5, -0.8), (0.9, 0.9, 0.5), (0.25, -0.125, 2.0)])
def test_the_gain_of_a_ring_is_the_product_of_its_factors(factors: tuple[float, ...]) -> None:
    """Law, for rings of one to three slaves, a slave that feeds itself among them."""
    (loop,) = check_system(gains(*factors), in_process=True).loops
    assert len(loop.outputs) == len(factors)
    assert (loop.is_single, loop.unknown) == (True, "")
    assert loop.gain == pytest.approx(np.prod(factors), rel=1e-9)
    assert loop.when is When.ALWAYS


def test_factors_of_connections_count() -> None:
    """The gain is that of what travels around: factors of connections are in it."""
    (loop,) = check_system(gains(0.5, 0.5, factor=-1.5, offset=2.0), in_process=True).loops
    assert loop.gain == pytest.approx(0.25 * 2.25, rel=1e-9)


def test_several_ways_around_have_the_spectral_radius() -> None:
    """Two outputs that depend on each other and on themselves."""
    system = System(
        simulation={"stop_time": 1.0, "estimator": "none"},
        slaves={"mixer": {"model": f"{GAINS}:Mixer"}},
        connections=[
            {"from": "mixer.y_1", "to": "mixer.u_1"},
            {"from": "mixer.y_2", "to": "mixer.u_2"},
        ],
    )
    (loop,) = check_system(system, in_process=True).loops
    assert not loop.is_single
    radius = np.abs(np.linalg.eigvals(np.array([[0.25, 0.5], [0.125, 0.0]]))).max()
    assert loop.gain == pytest.approx(radius, rel=1e-9)


def test_a_loop_of_fmus(capabilities: Path) -> None:
    """Real FMUs in processes of their own, one of them not linear: the derivatives at T_0."""
    system = load_system(capabilities / "algebraic_loop.toml")
    (loop,) = check_system(system).loops
    start = simulate(system, in_process=True)
    u = float(start["first.y"][0])
    assert loop.gain == pytest.approx(0.5 * (-0.8 + 0.5 * cos(u)), rel=1e-6)
    assert set(loop.inputs) == {"first.u", "second.u"}


def test_a_chain_is_no_loop_and_an_unknown_gain_is_said(tmp_path: Path) -> None:
    """Feed-through that leads nowhere back is none; a slave that refuses to be asked is named."""
    chain = gains(0.5, 0.5)
    open_chain = System(
        simulation={"stop_time": 1.0, "estimator": "none"},
        slaves=dict(chain.slaves),
        connections=chain.connections[:1],
    )
    assert check_system(open_chain, in_process=True).loops == ()
    text = GAINS.read_text(encoding="utf-8")
    text = text.replace(
        "return [self.k * float(u[0]) + self.c]",
        "return [self.k * float(u[0]) + self.c if round(float(u[0]), 9) == 2.0 else float('nan')]",
    )
    model = tmp_path / "fussy.py"
    model.write_text(text, encoding="utf-8")
    fussy = System(
        simulation={"stop_time": 1.0, "estimator": "none"},
        slaves={"g": {"model": f"{model}:Gain", "parameters": {"u": 2.0}}},
        connections=[{"from": "g.y", "to": "g.u"}],
    )
    (loop,) = check_system(fussy, in_process=True).loops
    assert isnan(loop.gain)
    assert "not finite" in loop.unknown
    bounds = check_system(fussy, in_process=True).as_plain_data()["loops"]
    assert bounds[0]["gain"] is None


# ---- The command --------------------------------------------------------------------------------


def test_json_is_the_report(tmp_path: Path, command: MainCommand) -> None:
    """Exit code 0, and data that a program can read: no NaN, all slaves."""
    code, text = command("check", system_file(tmp_path), "--in-process", "--json")
    assert code == 0
    told = json.loads(text, parse_constant=pytest.fail)
    again = check_system(load_system(tmp_path / "car.toml"), in_process=True).as_plain_data()
    for data in (told, again):
        for slave in data["slaves"]:
            del slave["state_costs"]
    assert told == again


@pytest.mark.parametrize("width", [80, 500])
def test_tables_show_all(
    width: int, tmp_path: Path, command: MainCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names are whole, whatever the width; 80 columns are never left."""
    file = system_file(tmp_path)
    monkeypatch.setenv("COLUMNS", str(width))
    code, text = command("check", file, "--in-process")
    assert code == 0
    assert all(len(line) <= width for line in text.splitlines())
    for name in ("chassis.x [m]", "wheel.v_c [m/s]", "smallest H", "largest H"):
        assert name in text


@pytest.mark.parametrize(
    ("mistake", "expected", "words"),
    [
        ("connection", 2, "has no variable 'nothing'"),
        ("model", 2, "cannot be read|is missing|no such file|not found"),
        ("slave", 3, "wheel"),
        ("stop time", 2, "stop_time"),
    ],
)
def test_the_exit_code_is_that_of_the_error(  # noqa: PLR0917  fixtures
    mistake: str, expected: int, words: str, tmp_path: Path, command: MainCommand, endpoint: str
) -> None:
    """For scripts: what would end a run ends the check with the same code and sentence."""
    options: list[object] = ["--in-process"]
    if mistake == "connection":
        file = system_file(tmp_path, connections=[("chassis.nothing", "wheel.x_c")])
    elif mistake == "model":
        file = system_file(tmp_path, chassis="nowhere.fmu")
    elif mistake == "slave":
        file = system_file(tmp_path, wheel=None)
        options = ["--listen", endpoint, "--timeout", "0.3"]
    else:
        file = system_file(tmp_path, simulation="")
    code, text = command("check", file, *options)
    assert code == expected, text
    assert re.search(words, text, re.IGNORECASE), text


def test_a_served_slave_is_free_again(start: Start, tmp_path: Path, endpoint: str) -> None:
    """It is claimed and given back: the next run finds it as if nothing had been."""
    slave = start(
        "slave_node", "serve", EXAMPLES / "quarter_car" / "quarter_car.py:Wheel", "--name",
        "wheel", "--connect", endpoint,
    )  # fmt: skip
    file = system_file(tmp_path, wheel=None, bus=f'listen = ["{endpoint}"]\n')
    report = check_system(load_system(file))
    assert [(s.name, s.place) for s in report.slaves] == [
        ("chassis", "launched"),
        ("wheel", "found"),
    ]
    served = simulate(load_system(file))
    alone = simulate(load_system(system_file(tmp_path)), in_process=True)
    assert served.outputs.tobytes() == alone.outputs.tobytes()
    assert slave.process.is_running()


def test_warnings_are_not_lost_when_the_check_fails(caplog: pytest.LogCaptureFixture) -> None:
    """Warnings before an error are logged after all; else they are in the report."""
    log = logging.getLogger("master_node")
    with gathered_warnings() as warnings:
        log.warning("seen %d times", 2)
        log.warning("seen %d times", 2)
    assert warnings == ["seen 2 times"]
    assert not caplog.records

    def fail() -> None:
        with gathered_warnings():
            log.warning("a unit is not known")
            raise ConfigurationError("no such variable")

    with pytest.raises(ConfigurationError):
        fail()
    assert [record.getMessage() for record in caplog.records] == ["a unit is not known"]
    assert log.propagate


def test_a_missing_slave_ends_the_check_as_a_run(tmp_path: Path, endpoint: str) -> None:
    """From Python it is the same error."""
    system = load_system(system_file(tmp_path, wheel=None, bus=f'listen = ["{endpoint}"]\n'))
    with pytest.raises(SlaveLostError, match="wheel"):
        check_system(system.with_bus(discovery_timeout=0.3))


# ---- The graph ----------------------------------------------------------------------------------


def report_of(system: System) -> SystemReport:
    """Its report."""
    return check_system(system, in_process=True)


def test_graphs_have_a_box_for_each_slave_and_bundles_with_counts(tmp_path: Path) -> None:
    """Two arrows of two connections each, in Mermaid and in dot."""
    report = report_of(load_system(system_file(tmp_path)))
    text = mermaid(report)
    assert text.startswith("flowchart LR\n")
    assert re.findall(r's(\d) -->\|"(.*)"\| s(\d)', text) == [("0", "2", "1"), ("1", "2", "0")]
    assert "chassis<br/>Python model" in text
    assert "linkStyle" not in text
    text = dot(report)
    assert re.findall(r's(\d) -> s(\d) \[label="(.*)"\]', text) == [
        ("0", "1", "2"),
        ("1", "0", "2"),
    ]
    assert text.count("{") == text.count("}")


def test_loops_are_marked() -> None:
    """Their arrows, and no others, have the mark and the gain."""
    ring = gains(0.5, 0.5)
    slaves = {**ring.slaves, "aside": {"model": f"{GAINS}:Gain"}}
    system = System(
        simulation={"stop_time": 1.0, "estimator": "none"},
        slaves=slaves,
        connections=[*ring.connections, {"from": "g0.y", "to": "aside.u"}],
    )
    report = report_of(system)
    text = mermaid(report)
    assert text.count("1 loop, gain 0.25") == 2
    assert "  linkStyle 0,1 stroke:" in text
    assert dot(report).count("penwidth") == 2


def test_names_of_others_are_text_in_graphs() -> None:
    """Names that models give themselves end no quotation, and are no markup."""
    report = report_of(gains(0.5))
    (slave,) = report.slaves
    evil = '"] ; click s0 "javascript:x" <b>\\'
    slave = type(slave)(**{**vars(slave), "kind": evil})
    hostile = SystemReport(**{**vars(report), "slaves": (slave,)})
    (line,) = [line for line in mermaid(hostile).splitlines() if "s0[" in line]
    assert line.count('"') == 2
    assert "<b>" not in line
    (line,) = [line for line in dot(hostile).splitlines() if line.startswith("    s0 [")]
    inner = re.sub(r"\\.", "", line)
    assert inner.count('"') == 2


def test_svg_needs_graphviz(
    tmp_path: Path, command: MainCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without it nothing is started; with it the picture is what it says; its errors are told."""
    bin_dir = tmp_path / "bin"
    bin_dir.mkdir()
    monkeypatch.setenv("PATH", str(bin_dir))
    file, picture = system_file(tmp_path), tmp_path / "graph.svg"
    code, text = command("check", file, "--in-process", "--graph", picture)
    assert code == 2
    assert "install Graphviz" in text
    program = bin_dir / "dot"
    program.write_text(
        '#!/bin/sh\n[ "$1" = -Tsvg ] || exit 3\necho "<svg>"\nexec /bin/cat\n', encoding="utf-8"
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    report = report_of(load_system(file))
    write_graph(report, picture)
    assert picture.read_text(encoding="utf-8") == f"<svg>\n{dot(report)}"
    program.write_text("#!/bin/sh\necho no layout >&2\nexit 1\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="no layout"):
        write_graph(report, picture)


def test_the_graph_is_written_by_the_command(tmp_path: Path, command: MainCommand) -> None:
    """Beside the report; a suffix that is none of ours is refused before the start."""
    file = system_file(tmp_path)
    for suffix in ("mmd", "dot"):
        path = tmp_path / f"graph.{suffix}"
        code, text = command("check", file, "--in-process", "--graph", path)
        assert code == 0
        assert f"graph in {path}" in text
        assert path.stat().st_size > 0
    code, text = command("check", file, "--in-process", "--graph", tmp_path / "graph.png")
    assert code == 2
    assert ".mmd for Mermaid" in text


# ---- Small parts --------------------------------------------------------------------------------


def test_exporters_with_a_switch_for_saved_states() -> None:
    """Their switches, by the generation tools that their FMUs name; of others none is made up."""
    assert "pythonfmu build --handle-state" in state_remedy("PythonFMU 0.7.0")
    assert "pythonfmu3 build --handle-state" in state_remedy("PythonFMU3 0.3.4")
    assert state_remedy("Some Other Tool") == ""


def test_many_rows_are_cut_and_that_is_said() -> None:
    """Tables stay readable; JSON has the rest."""
    report = report_of(gains(0.5))
    many = SystemReport(**{**vars(report), "unused": tuple(f"g.y{i}" for i in range(100))})
    tables = {str(table.title): table for table in report_tables(many)}
    assert tables["Outputs that feed nothing"].row_count == 61
    assert len(many.as_plain_data()["unused"]) == 100
    loop = LoopReport(("g.y",), ("g.u",), When.ALWAYS, float("nan"), True, "no reason")
    assert (
        SystemReport(**{**vars(report), "loops": (loop,)}).as_plain_data()["loops"][0]["gain"]
        is None
    )


def test_a_run_behind_a_check_has_the_same_bits(tmp_path: Path) -> None:
    """The check leaves no trace in this process."""
    system = load_system(system_file(tmp_path))
    before = simulate(system, output=tmp_path / "a", in_process=True)
    check_system(system, in_process=True)
    after = simulate(system, output=tmp_path / "b", in_process=True)
    assert before.outputs.tobytes() == after.outputs.tobytes()
    assert Result.load(tmp_path / "b").summary["outcome"] == "completed"
