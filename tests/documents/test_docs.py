"""Documents are true: commands, keys, tables, examples, places in the code, links."""

from __future__ import annotations

import ast
import importlib
import os
import re
import runpy
import shlex
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from fractions import Fraction
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel
from scipy.linalg import expm
from typer.main import get_command
from typer.testing import CliRunner

import master_node.cli.app
import protocol.wire
import slave_node.cli.app
from master_node import simulate
from master_node.numerics.error_estimators import EST_MOD, EST_RICH
from master_node.numerics.reductions import REDUCTIONS
from master_node.observing.metrics import RunMetrics
from master_node.results.formats import FORMATS
from master_node.slaves import remote as remote_slave
from master_node.study.configuration import (
    Cases,
    Resources,
    RunSettings,
    Sample,
    Study,
    load_study,
)
from master_node.study.configuration import ResultSettings as StudyResults
from master_node.study.plan import Plan
from master_node.study.table import StudyTable
from master_node.system.simulation import SimulationSettings
from master_node.system.system import System, load_system
from master_node.system.tables import (
    Action,
    BusSettings,
    Connection,
    InputSettings,
    OutputTolerance,
    ResultsSettings,
    SlaveSettings,
)
from protocol import errors
from protocol.calls import CALLS
from protocol.description import Capabilities, SlaveDescription
from protocol.life_cycle import LIFE_CYCLE, LifeCycleState
from protocol.signals import MAX_ORDER
from protocol.text import limits as text_limits
from protocol.variables import Variable
from protocol.wire import packing, programs, records
from slave_node.execution.snapshots import LIMIT
from slave_node.serving.metrics import CountingWorker
from tests.support.light_slaves import LightWorker
from tests.support.places import ROOT
from tests.support.waiting import BOUND, wait_until

DOCUMENTS = sorted(
    path
    for path in ROOT.rglob("*.md")
    if not any(part.startswith(".") for part in path.relative_to(ROOT).parts)
)
APPS = {"master-node": master_node.cli.app.app, "slave-node": slave_node.cli.app.app}


def read(name: str) -> str:
    """A file of the project."""
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    """The code blocks of a language, each with its last line end."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [block for name, block in found if name == language]


def section(text: str, heading: str) -> str:
    """Text under a heading, up to the next one."""
    _, found, rest = text.partition(f"\n{heading}\n")
    assert found, f"no heading {heading!r}"
    return re.split(r"^#+ ", rest, maxsplit=1, flags=re.MULTILINE)[0]


def tables(text: str) -> list[list[list[str]]]:
    """The Markdown tables: cells of all rows, the head first, the rule left out."""
    found = re.findall(r"(?:^\|.*\|\n)+", text + "\n", re.MULTILINE)
    return [
        [
            [cell.strip() for cell in line.strip("|").split("|")]
            for i, line in enumerate(table.splitlines())
            if i != 1
        ]
        for table in found
    ]


def command_lines() -> Iterator[tuple[str, list[str]]]:
    """The commands in all shell blocks: document and words."""
    for path in DOCUMENTS:
        for block in blocks(path.read_text(encoding="utf-8"), "sh"):
            for line in block.splitlines():
                for command in line.split("&&"):
                    words = shlex.split(command, comments=True)
                    if words:
                        yield path.relative_to(ROOT).as_posix(), words


COMMAND_LINES = list(command_lines())


# --- commands -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("document", "words"), COMMAND_LINES, ids=[f"{d}: {' '.join(w)}" for d, w in COMMAND_LINES]
)
def test_a_command_line_in_a_document_can_be_given(document: str, words: list[str]) -> None:
    """Its options, values, files and targets exist."""
    program, *arguments = words
    if program in APPS:
        name, *rest = arguments
        text = help_of(program, name)
        for option in (word for word in rest if word.startswith("--")):
            assert re.search(rf"{option}(?![\w-])", text), f"{program} {name} has no {option}"
        command = get_command(APPS[program]).commands[name]
        command.make_context(name, list(rest))
        files = [word for word in rest if word.startswith("examples/") and word.endswith(".toml")]
    elif program == "make":
        assert [t for t in arguments if not re.search(rf"^{t}:", read("Makefile"), re.M)] == []
        files = []
    elif program.endswith("python"):
        files = check_python(arguments)
    else:
        assert words in (
            ["pip", "install", "."],
            ["pip", "install", "pythonfmu", "pythonfmu3"],
            ["cd", "examples/quarter_car"],
        )
        files = []
    for file in files:
        assert (ROOT / file).is_file(), f"{document} names {file}"


@pytest.mark.parametrize(
    ("target", "has_tools"), [("demo", False), ("test", True), ("check", True)]
)
def test_the_demo_installs_no_development_tools(target: str, has_tools: bool) -> None:
    """In a fresh clone: who only tries the program installs what the program needs."""
    words = ["make", "--dry-run", "--no-print-directory", target, "VENV=no_such_folder"]
    recipe = subprocess.check_output(words, cwd=ROOT, text=True, timeout=BOUND)
    assert "pip install" in recipe
    assert (".[dev]" in recipe) == has_tools


def check_python(arguments: list[str]) -> list[str]:
    """Check a call of Python; gives the files that it names."""
    match arguments:
        case ["-m", "benchmarks", name, *_]:
            folder = ROOT / "benchmarks"
            assert (folder / f"{name}.py").is_file() or (folder / name / "__init__.py").is_file()
            return []
        case ["-m", "benchmarks.reproduction", *parts]:
            assert set(parts) <= {"paper", "beyond", "stiff"}
            return []
        case ["-m", "pytest", *words]:
            return [word for word in words if word.startswith("tests/")]
        case ["ten_lines.py"]:
            return ["examples/quarter_car/ten_lines.py"]
        case [file, *_]:
            return [file]
    raise AssertionError(arguments)


def help_of(program: str, command: str) -> str:
    """Help text of a command."""
    result = CliRunner().invoke(APPS[program], [command, "--help"], env={"COLUMNS": "200"})
    assert result.exit_code == 0
    return result.output


@pytest.mark.parametrize("program", APPS)
def test_the_table_of_commands_names_every_command(program: str) -> None:
    """The table of commands has them all."""
    for name in get_command(APPS[program]).commands:
        assert f"`{program} {name} " in read("docs/commands.md")


def test_the_table_names_every_option_of_a_run_and_no_other() -> None:
    """The table of options and ``--help`` agree."""
    text = section(read("docs/commands.md"), "## Options of `master-node run`")
    known = set(re.findall(r"--[a-z-]+", help_of("master-node", "run"))) - {"--help"}
    rows = [row[0] for row in tables(text)[0][1:]]
    assert set(re.findall(r"--[a-z-]+", " ".join(rows))) == known


def test_the_help_names_every_result_format() -> None:
    """In the help of ``--output-format``, which is written before the formats are imported."""
    told = help_of("master-node", "run").partition("--output-format")[2].partition("--")[0]
    assert set(re.findall(r"\w+", told)) >= set(FORMATS)


@pytest.mark.parametrize(
    ("command", "document", "heading"),
    [
        ("serve", "docs/deployment.md", "## Options of `slave-node serve`"),
        ("agent", "docs/agents.md", "## The command"),
    ],
)
def test_a_table_has_every_option_of_its_command_and_no_other(
    command: str, document: str, heading: str
) -> None:
    """The table of options and ``--help`` agree."""
    (table,) = tables(section(read(document), heading))
    known = set(re.findall(r"--[a-z-]+", help_of("slave-node", command))) - {"--help"}
    assert set(re.findall(r"--[a-z-]+", " ".join(row[0] for row in table[1:]))) == known


@pytest.mark.parametrize("program", APPS)
def test_every_option_of_every_command_is_told_somewhere(program: str) -> None:
    """In a document that names the command."""
    texts = [path.read_text(encoding="utf-8") for path in DOCUMENTS]
    for name in get_command(APPS[program]).commands:
        told = " ".join(text for text in texts if f"{program} {name}" in text)
        for option in re.findall(r"--[a-z-]+", help_of(program, name)):
            if option != "--help":
                assert re.search(rf"{option}(?![\w-])", told), f"{program} {name} {option}"


def test_the_documents_give_every_exit_code_a_meaning() -> None:
    """The table of exit codes and the error tree agree."""
    (table,) = tables(section(read("docs/commands.md"), "## Exit codes"))
    codes = {cls.exit_code for cls in error_classes()} | {0}
    assert {int(row[0]) for row in table[1:]} == codes


def error_classes() -> list[type[errors.DoublestepError]]:
    """The whole error tree."""
    return [
        cls
        for cls in vars(errors).values()
        if isinstance(cls, type) and issubclass(cls, errors.DoublestepError)
    ]


def test_the_documents_name_every_dependency_and_no_other() -> None:
    """The table of dependencies and pyproject.toml agree."""
    declared = tomllib.loads(read("pyproject.toml"))["project"]["dependencies"]
    names = {re.split(r"[<>=~! ]", dependency)[0] for dependency in declared}
    (table,) = tables(section(read("CONTRIBUTING.md"), "## Dependencies"))
    assert {row[0] for row in table[1:]} == names


# --- examples -----------------------------------------------------------------------------------


def test_the_ten_lines_run_as_they_stand(fmu_dir: Path, tmp_path: Path) -> None:
    """In a folder with the FMUs and nothing else, over Zenoh, with warnings as errors."""
    script = read("examples/quarter_car/ten_lines.py")
    assert len(script.splitlines()) <= 10
    assert script in blocks(read("README.md"), "python")
    for name in ("chassis.fmu", "wheel.fmu"):
        (tmp_path / name).write_bytes((fmu_dir / name).read_bytes())
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    numbers = [float(x) for x in re.findall(r"[\d.]+(?:e[+-]\d+)?", done.stdout)]
    assert numbers[0] == 0.0
    assert numbers[-1] == pytest.approx(0.1, abs=2e-3), "the wheel comes to rest on the road"
    assert (tmp_path / "quarter_car.png").read_bytes().startswith(b"\x89PNG")


def test_the_complete_system_file_is_the_example(tmp_path: Path) -> None:
    """It holds the same tables, and it is valid."""
    (text,) = blocks(section(read("docs/system-file.md"), "## A complete example"), "toml")
    example = tomllib.loads(read("examples/quarter_car/displacement.toml"))
    assert tomllib.loads(text) == example
    (tmp_path / "system.toml").write_text(text, encoding="utf-8")
    load_system(tmp_path / "system.toml")


def test_the_examples_in_the_document_of_system_files_are_valid() -> None:
    """Tolerances of one output, and inputs, can be written as shown."""
    text, actions, inputs, _ = blocks(read("docs/system-file.md"), "toml")
    assert [a.at for a in System(slaves={"any": {}}, **tomllib.loads(actions)).actions] == [
        1.0,
        2.0,
        3.0,
    ]
    driven = System(slaves={"wheel": {}}, **tomllib.loads(inputs)).inputs
    assert driven["wheel.z"] == InputSettings(table="road.csv", column="z")
    table = tomllib.loads(text)["slaves"]["wheel"]
    settings = System(slaves={"wheel": {"model": "wheel.fmu", **table}}).slaves["wheel"]
    assert settings.tolerances["v"] == OutputTolerance(absolute=1e-3, relative=1e-3)


@pytest.mark.parametrize("path", DOCUMENTS, ids=[str(p.relative_to(ROOT)) for p in DOCUMENTS])
def test_tables_of_system_files_in_documents_are_valid(path: Path) -> None:
    """Every block of TOML is a system file, a part of one, or a study."""
    for text in blocks(path.read_text(encoding="utf-8"), "toml"):
        given = tomllib.loads(text)
        if "system" in given:
            Study(**given)
        else:
            System(**{"slaves": {"any": {}}, **given})


@pytest.mark.parametrize("path", DOCUMENTS, ids=[str(p.relative_to(ROOT)) for p in DOCUMENTS])
def test_what_documents_import_is_there(path: Path) -> None:
    """Every block of Python can be read, and our names in it exist."""
    for text in blocks(path.read_text(encoding="utf-8"), "python"):
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.module in OUR_MODULES:
                module = importlib.import_module(node.module)
                assert [a.name for a in node.names if not hasattr(module, a.name)] == []


OUR_MODULES = ("master_node", "slave_node.model")


@pytest.mark.slow
def test_a_slave_is_driven_by_hand_as_the_protocol_says(
    fmu_dir: Path, endpoint: str, tmp_path: Path, no_process_left: None
) -> None:
    """The script in the document is the example, and it steps a slave in a process of its own.

    Twice, because it may be tried twice; against the exact motion of a wheel under a chassis at
    rest.
    """
    script = ROOT / "examples" / "drive_by_hand.py"
    assert script.read_text(encoding="utf-8") in blocks(read("docs/protocol.md"), "python")
    log = tmp_path / "wheel.log"
    serve = [sys.executable, "-m", "slave_node", "serve", str(fmu_dir / "wheel.fmu")]
    with log.open("wb") as file:
        slave = subprocess.Popen([*serve, "--listen", endpoint], stderr=file)
    try:
        wait_for("ready", log, slave)
        for _ in range(2):
            done = subprocess.run(
                [sys.executable, "-W", "error", str(script), endpoint],
                capture_output=True,
                text=True,
                timeout=BOUND,
                check=False,
            )
            assert done.returncode == 0, done.stderr
            check_motion(done.stdout)
        slave.send_signal(signal.SIGTERM)
        assert slave.wait(BOUND) == 0, log.read_text()
    finally:
        slave.kill()
        slave.wait(BOUND)


def wait_for(word: str, log: Path, process: subprocess.Popen[bytes]) -> None:
    """Wait until a process has said a word."""
    wait_until(lambda: word in log.read_text() or process.poll() is not None, log.read_text)
    assert process.poll() is None, log.read_text()


def check_motion(output: str) -> None:
    """The lines printed are the wheel's exact motion."""
    m, k_w, k_c, d_c, z = 40.0, 150000.0, 15000.0, 1000.0, 0.1
    matrix = [[0.0, 1.0, 0.0], [-(k_w + k_c) / m, -d_c / m, k_w * z / m], [0.0, 0.0, 0.0]]
    lines = [line.split() for line in output.splitlines()]
    assert [line[1] for line in lines] == ["ok"] * 3
    for line, t in zip(lines, (0.01, 0.02, 0.03), strict=True):
        assert float(line[0]) == pytest.approx(t, rel=1e-15)
        x, v, _ = expm(np.array(matrix) * t) @ [0.0, 0.0, 1.0]
        assert [float(line[2]), float(line[3])] == pytest.approx([x, v], rel=1e-4)


# --- system files -------------------------------------------------------------------------------

TABLES: dict[str, type[BaseModel]] = {
    "## `[simulation]`": SimulationSettings,
    "## `[slaves.NAME]`": SlaveSettings,
    "## `[slaves.NAME.tolerances.OUTPUT]`": OutputTolerance,
    "## `[[connections]]`": Connection,
    "## `[[actions]]`": Action,
    "## `[inputs]`": InputSettings,
    "## `[results]`": ResultsSettings,
    "## `[bus]`": BusSettings,
}


@pytest.mark.parametrize("heading", TABLES)
def test_the_keys_of_a_table_are_those_in_the_document(heading: str) -> None:
    """Every key, no other, in the same order, with the same default where it is a value."""
    (table,) = tables(section(read("docs/system-file.md"), heading))
    known = {field.alias or name: field for name, field in TABLES[heading].model_fields.items()}
    assert [row[0] for row in table[1:]] == [f"`{name}`" for name in known]
    for key, _, default, _ in table[1:]:
        value = known[key.strip("`")].get_default(call_default_factory=True)
        if default.startswith("`") and default.endswith("`"):
            assert tomllib.loads(f"x = {default.strip('`')}")["x"] == json_of(value), key
        else:
            assert not value or known[key.strip("`")].is_required(), key


def json_of(value: object) -> object:
    """A default as TOML has it."""
    return list(value) if isinstance(value, tuple) else value


def test_every_table_of_a_system_file_is_in_the_document() -> None:
    """There is a heading for each, and one for the example."""
    headings = re.findall(r"^## .*$", read("docs/system-file.md"), re.MULTILINE)
    assert headings == [*TABLES, "## A complete example"]
    tables_of_files = {name for name, field in System.model_fields.items() if not field.exclude}
    assert tables_of_files == {re.findall(r"\w+", heading)[0] for heading in TABLES}


# --- studies ------------------------------------------------------------------------------------

STUDY_TABLES: dict[str, type[BaseModel]] = {
    "## Keys of a study": Study,
    "### `[sample]`": Sample,
    "### `[cases]`": Cases,
    "### `[run]`": RunSettings,
    "### `[resources]`": Resources,
    "### `[results]`": StudyResults,
}


@pytest.mark.parametrize("heading", STUDY_TABLES)
def test_the_keys_of_a_study_are_those_in_the_document(heading: str) -> None:
    """Every key, no other, in the same order, with the same default where it is a value."""
    table, *_ = tables(section(read("docs/sweep.md"), heading))
    fields = STUDY_TABLES[heading].model_fields
    known = {name: field for name, field in fields.items() if name not in ("base", "source")}
    assert [row[0] for row in table[1:]] == [f"`{name}`" for name in known]
    for key, _, default, _ in table[1:]:
        value = known[key.strip("`")].get_default(call_default_factory=True)
        if default.startswith("`"):
            assert tomllib.loads(f"x = {default.strip('`')}")["x"] == json_of(value), key


def test_the_document_of_studies_has_every_option_reduction_and_column() -> None:
    """And the study that it shows is the example."""
    text = read("docs/sweep.md")
    options = set(re.findall(r"--[a-z-]+", help_of("master-node", "sweep"))) - {"--help"}
    table, *_ = [t for t in tables(text) if t[0][0] == "option"]
    assert set(re.findall(r"--[a-z-]+", " ".join(row[0] for row in table[1:]))) == options
    (reductions,) = [t for t in tables(text) if t[0][0] == "`reduce`"]
    names = [name for row in reductions[1:] for name in re.findall(r"\w+", row[0])]
    assert names == list(REDUCTIONS)
    (example,) = blocks(text, "toml")
    assert tomllib.loads(example) == tomllib.loads(read("examples/sweep/spring.toml"))
    study = load_study(ROOT / "examples" / "sweep" / "spring.toml")
    (directory,) = [t for t in tables(text) if t[0][0] == "file" and t[1][0] == "`study.csv`"]
    told = re.findall(r"`(\w+)`", directory[1][1])
    columns = [c for c in StudyTable(Plan(study, (), ())).columns if c not in study.results.outputs]
    assert told == columns


# --- the protocol -------------------------------------------------------------------------------


def test_the_messages_are_those_of_the_codec() -> None:
    """The grammar in the document is the one in the codec, line by line."""
    (grammar,) = [b for b in blocks(read("docs/protocol.md"), "") if b.startswith("request")]
    told = [line.strip() for line in (protocol.wire.__doc__ or "").splitlines()]
    assert [
        line for line in grammar.splitlines() if line.strip() and line.strip() not in told
    ] == []


def test_the_verbs_and_their_fields_are_those_of_the_calls() -> None:
    """Every verb and field is there, no other, in the order of the wire."""
    (table,) = tables(section(read("docs/protocol.md"), "## Verbs"))
    assert [row[0] for row in table[1:]] == [f"`{call.verb}`" for call in CALLS]
    for row, call in zip(table[1:], CALLS, strict=True):
        assert re.findall(r"`(\w+)`", row[1]) == [field.name for field in fields(call)], row[0]


def test_the_description_of_a_slave_is_that_of_the_program() -> None:
    """Its fields, those of a variable, and the capabilities: every one, no other."""
    described, capabilities = tables(
        section(read("docs/protocol.md"), "### The description of a slave")
    )
    for table, cls in ((described, SlaveDescription), (capabilities, Capabilities)):
        told = re.findall(r"`(\w+)`", " ".join(row[0] for row in table[1:]))
        assert sorted(told) == sorted(field.name for field in fields(cls))
    (variables,) = (row[2] for row in described if row[0] == "`variables`")
    assert re.findall(r"`(\w+)`", variables) == [field.name for field in fields(Variable)]


def test_the_life_cycle_is_the_table_of_the_program() -> None:
    """Every pair of state and verb."""
    (table,) = tables(section(read("docs/protocol.md"), "## Life cycle"))
    assert table[0] == ["verb", *LifeCycleState]
    for row, call in zip(table[1:], CALLS, strict=True):
        assert row[0] == f"`{call.verb}`"
        assert row[1:] == [LIFE_CYCLE[state].get(call, "") for state in LifeCycleState], row[0]


def test_the_limits_are_those_of_the_program() -> None:
    """Version and limits."""
    text = section(read("docs/protocol.md"), "## Versions and limits")
    assert f"an integer, now {packing.PROTOCOL_VERSION}." in text
    limits = {row[0]: int(row[1].split()[0]) for row in tables(text)[0][1:]}
    assert limits == {
        "length of a message": packing.MAX_MESSAGE_BYTES,
        "calls in a program": programs.MAX_CALLS,
        "columns of an array": packing.MAX_COLUMNS,
        "rows of an array": MAX_ORDER + 1,
        "containers (maps and lists) in a message": packing.MAX_CONTAINERS,
        "fields of an administrative message": records.MAX_FIELDS,
        "text: the host of a participant": text_limits.MAX_HOST,
        "text: a name of a variable, unit, model, file": text_limits.MAX_NAME,
        "text: a description, cause, remedy, remark": text_limits.MAX_SENTENCE,
        "saved states of a slave": LIMIT,
    }


def test_the_errors_and_their_exit_codes_are_those_of_the_program() -> None:
    """Every class is there, no other, with its exit code."""
    table = tables(section(read("docs/protocol.md"), "## Errors"))[1]
    told = {name: int(row[2]) for row in table[1:] for name in re.findall(r"`(\w+)`", row[0])}
    assert told == {
        cls.__name__: cls.exit_code for cls in error_classes() if cls is not errors.DoublestepError
    }


# --- numerics -----------------------------------------------------------------------------------


def test_the_constants_are_those_of_the_program() -> None:
    """The ratio p for both estimators and every k, as fractions."""
    text = read("docs/numerics.md")
    (table,) = [t for t in tables(text) if t[0] == ["k", "p_k of EST_mod", "p of EST_Rich"]]
    mod, rich = ([float(Fraction(row[i])) for row in table[1:]] for i in (1, 2))
    assert (tuple(mod), tuple(rich)) == (EST_MOD.paper_ratios, EST_RICH.paper_ratios)


def test_what_a_changed_step_size_does_to_the_estimates() -> None:
    """The table of section 9, from the integrals over the polynomials' nodes."""
    text = read("docs/numerics.md")
    (table,) = [t for t in tables(text) if t[0][:2] == ["k", "r"]]
    for row in table[1:]:
        k, r = int(row[0]), float(Fraction(row[1].split()[0]))
        past = [-r * i for i in range(2 * k + 1)]
        first, second = past[: k + 1], [1.0, *past][: k + 1]
        small_steps = node_integral(first, 0, 1) + node_integral(second, 1, 2)
        for cell, estimator, nodes in (
            (row[2], EST_MOD, first),
            (row[3], EST_RICH, past[::2]),
        ):
            ratio = node_integral(nodes, 0, 2) / small_steps
            told = (ratio - 1) / (estimator.paper_ratios[k] - 1)
            assert float(cell) == pytest.approx(told, abs=6e-4)


def node_integral(nodes: list[float], begin: float, end: float) -> float:
    """The integral of prod(s - s_i)."""
    integral = np.polynomial.Polynomial.fromroots(nodes).integ()
    return float(integral(end) - integral(begin))


def test_our_rows_of_table_1_are_what_this_version_gives(fmu_dir: Path) -> None:
    """Steps, rejections and mean error, up to what another compiler's last bits can change."""
    (table,) = tables(section(read("docs/numerics.md"), "## 17. Table 1 of the paper"))
    path = ROOT / "examples" / "quarter_car"
    exact = runpy.run_path(str(path / "quarter_car.py"))["exact_solution"]
    car = System(**tomllib.loads((path / "displacement.toml").read_text()), base=fmu_dir)
    for row in table[1:]:
        options = {"preset": "paper", "estimator": row[0], "order": int(row[1])}
        result = simulate(car, in_process=True, **options)
        error = np.linalg.norm(result.outputs - exact(result.time), axis=1).mean()
        assert result.summary["communication_steps"] == pytest.approx(int(row[3]), rel=0.03), row
        assert result.summary["rejected_double_steps"] == pytest.approx(int(row[5]), abs=3), row
        assert error == pytest.approx(float(row[7]), rel=0.1), row


def test_the_places_in_the_code_exist() -> None:
    """Each file has each name that the document looks for in it."""
    text = read("docs/numerics.md")
    (table,) = tables(section(text, "## 18. Places in the code"))
    for _, file, names in table[1:]:
        module = importlib.import_module(file.strip("`").removesuffix(".py").replace("/", "."))
        for name in re.findall(r"`([\w.]+)`", names):
            place: object = module
            for part in name.split("."):
                place = getattr(place, part)
    named = {name for row in table[1:] for name in re.findall(r"`([\w.]+)`", row[2])}
    for line in re.findall(r"^Code: (.*)$", text, re.MULTILINE):
        assert set(re.findall(r"`([\w.]+)`", line)) <= named, line


def test_the_files_named_as_code_in_documents_exist() -> None:
    """In every document."""
    for path in DOCUMENTS:
        text = path.read_text(encoding="utf-8")
        for file in re.findall(r"`((?:protocol|slave_node|master_node|tests)/[\w/]+\.py)`", text):
            assert (ROOT / file).is_file(), f"{path.name} names {file}"


# --- troubleshooting ----------------------------------------------------------------------------


def told_texts() -> list[str]:
    """All texts in the program; values that are put into them as an ellipsis."""
    texts = []
    for package in ("protocol", "slave_node", "master_node"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.JoinedStr):
                    texts.append(
                        "".join(
                            str(part.value) if isinstance(part, ast.Constant) else "…"
                            for part in node.values
                        )
                    )
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    texts.append(node.value)
    return texts


def test_the_messages_to_look_up_are_those_of_the_program() -> None:
    """Every part of a message in the document is in one text of the program, in this order."""
    texts = told_texts()
    document = read("docs/troubleshooting.md")
    messages = [
        row[0].strip("`")
        for table in tables(document)
        if table[0][0] == "message"
        for row in table[1:]
    ]
    assert len(messages) > 40
    unknown = []
    for message in messages:
        words = [part.strip(" '") for part in message.split("…")]
        pattern = re.compile(".*".join(map(re.escape, filter(None, words))), re.DOTALL)
        if not any(map(pattern.search, texts)) and not any(map(pattern.search, joined(texts))):
            unknown.append(message)
    assert unknown == []


def joined(texts: list[str]) -> list[str]:
    """Cause and remedy as they are shown: one after the other."""
    return [f"{a}; {b}" for a, b in pairwise(texts)]


# --- reliability --------------------------------------------------------------------------------


def test_every_row_of_the_fault_matrix_names_tests_that_exist() -> None:
    """No fault without a proof, and no proof that is not there."""
    (table,) = tables(section(read("docs/reliability.md"), "## The fault matrix"))
    assert len(table) > 25
    for fault, _, proofs in table[1:]:
        check_tests(fault, proofs)


def check_tests(what: str, proofs: str) -> None:
    """Check of a cell: it names tests, all of which exist."""
    named = re.findall(r"`(tests/[\w/]+/test_\w+\.py)::(\w+)`", proofs)
    assert named, f"no test for: {what}"
    assert proofs.count("`") == 2 * len(named), f"not a test: {proofs}"
    for file, test in named:
        assert test in functions_of(file), f"{file} has no {test}"


@cache
def functions_of(file: str) -> frozenset[str]:
    """The names of a file's functions."""
    tree = ast.parse(read(file))
    return frozenset(node.name for node in tree.body if isinstance(node, ast.FunctionDef))


# --- examples -----------------------------------------------------------------------------------


def test_every_part_of_what_fmus_can_do_has_a_command_and_a_test() -> None:
    """The twelve rows of the table of examples: systems that are there, tests that exist."""
    part_table, _ = tables(read("examples/README.md"))
    assert len(part_table) == 1 + 12
    for part, _, command, proofs in part_table[1:]:
        program, name, file = command.strip("`").split()
        assert name in get_command(APPS[program]).commands
        if file.endswith(".toml"):  # FMUs and packages are built
            assert (ROOT / file).is_file(), f"{part}: {file}"
        check_tests(part, proofs)


def test_the_bounds_of_waits_are_those_of_the_program() -> None:
    """The table of waits, as far as they are no keys of the system file."""
    rows = dict(tables(section(read("docs/reliability.md"), WAITS))[0][1:])
    assert f"{remote_slave._CLAIM_MARGIN:g} s more" in rows["for a claim"]
    assert f"{remote_slave._GOODBYE_TIME:g} s" in rows["for a slave to be given back at the end"]
    margin = rows["a slave for its master that vanished"]
    assert f"{remote_slave._ORPHAN_MARGIN:g} s more" in margin
    for row, key in (
        ("for slaves that others started, and agents, to appear", "discovery_timeout"),
        ("for a model to be loaded, loaded anew or reset", "load_timeout"),
        ("for a request from `initialize` to the end of initialization mode", INITIALIZATION),
        ("for any other request", "step_timeout"),
    ):
        assert f"`{key}`" in rows[row]
        assert f"{getattr(BusSettings(), key):g} s" in rows[row]


WAITS = "## What is waited for, and how long"
INITIALIZATION = "initialization_timeout"


def test_the_metrics_are_those_of_the_program() -> None:
    """Every metric of a run and of a slave is in the document, no other."""
    of_run, of_slave = tables(section(read("docs/observability.md"), "## Metrics"))
    for table, metrics in (
        (of_run, RunMetrics().read()),
        (of_slave, CountingWorker(LightWorker("left"), "left").read()),
    ):
        names = {f"doublestep_{m.name}{'_total' * (m.kind == 'counter')}" for m in metrics}
        assert set(re.findall(r"`(\w+)`", " ".join(row[0] for row in table[1:]))) == names


# --- links --------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", DOCUMENTS, ids=[str(p.relative_to(ROOT)) for p in DOCUMENTS])
def test_links_lead_somewhere(path: Path) -> None:
    """Files exist, and so do the headings that a link jumps to."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(encoding="utf-8"), flags=re.M | re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        assert target.exists(), f"{path.name}: {link}"
        assert target.is_relative_to(ROOT), f"{path.name}: {link}"
        if anchor:
            assert anchor in anchors(target.read_text(encoding="utf-8")), f"{path.name}: {link}"


def anchors(text: str) -> set[str]:
    """Anchors that a Markdown renderer makes of the headings."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def test_the_placeholders_for_measured_tables_name_benchmarks() -> None:
    """Each can be filled by the benchmark of its name."""
    names = re.findall(r"<!-- table: (\w+) -->", read("docs/benchmarks.md"))
    for name in names:
        assert (ROOT / "benchmarks" / f"{name}.py").is_file()
