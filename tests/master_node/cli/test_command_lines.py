"""First contact of a user: versions, help, completion, one model alone, names of models."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from importlib.metadata import version
from pathlib import Path
from zipfile import ZipFile

import pytest

import master_node.cli.app
import slave_node.cli.app
from master_node import Result, System, open_system, simulate
from protocol.errors import ConfigurationError, InterruptedRunError, ModelError
from protocol.host.processes import ending_signals, interrupt_main_thread
from protocol.host.python_processes import out_of_reach, temporary_files_in
from protocol.text.references import split_reference
from slave_node.cli.serve import _default_name
from tests.faults.test_processes import MainCommand, command
from tests.support.interrupting import Interrupt
from tests.support.quarter_car_case import EXAMPLES
from tests.support.slow import quick_at

__all__ = ["command"]

APPS = {"master-node": master_node.cli.app.app, "slave-node": slave_node.cli.app.app}


def said(program: str, *words: object, **environment: str) -> str:
    """Standard output of an installed command in a process of its own, which ends with 0."""
    done = subprocess.run(
        [str(Path(sys.executable).with_name(program)), *map(str, words)],
        env={**os.environ, "COLUMNS": "80", **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("program", APPS)
def test_the_version_is_that_of_the_package(program: str) -> None:
    """One line, exit code 0."""
    assert said(program, "--version") == f"{program} of Doublestep {version('doublestep')}\n"


@pytest.mark.parametrize("program", APPS)
def test_help_names_every_command_in_a_section(program: str) -> None:
    """Law: each command has a section and a summary that is not cut off on 80 columns."""
    text = said(program, "--help")
    names = [str(c.name) for c in APPS[program].registered_commands]
    for name in names:
        assert re.search(rf"^  {name} +[A-Z].*\.$", text, re.MULTILINE), name
    assert "..." not in text.partition("COMMAND")[2].partition("\n")[2]
    assert "\nCommands:" not in text
    assert all(len(line) <= 80 for line in text.splitlines())


@pytest.mark.parametrize("words", [("run",), ("check",), ("sweep",), ("list",)])
def test_help_of_a_command_names_every_option_once(words: tuple[str, ...]) -> None:
    """Sections lose none: the hidden ones are not shown."""
    text = said("master-node", *words, "--help")
    (info,) = [c for c in APPS["master-node"].registered_commands if c.name == words[0]]
    assert info.callback is not None
    shown = re.findall(r"^  (--[a-z-]+)", text, re.MULTILINE)
    assert len(shown) == len(set(shown))
    names = {
        "--" + name.removeprefix("as_").replace("_", "-") for name in info.callback.__annotations__
    }
    hidden = {"--stay-with-parent", "--return", "--system-file", "--study-file"}
    assert names - hidden <= {*shown, "--help"}
    if words == ("run",):
        titles = re.findall(r"^(\S.*):$", text, re.MULTILINE)
        assert titles[:3] == ["Arguments", "Results", "Method"]


@pytest.mark.parametrize("program", APPS)
def test_shells_complete_commands(program: str) -> None:
    """The script of bash asks the command, which answers with what begins so."""
    variable = f"_{program.upper().replace('-', '_')}_COMPLETE"
    first = str(APPS[program].registered_commands[0].name)
    words = {"COMP_WORDS": f"{program} {first[:3]}", "COMP_CWORD": "1"}
    assert first in said(program, **words, **{variable: "complete_bash"}).split()
    assert variable in said(program, **{variable: "source_bash"})


# ---- Names of models ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reference", "expected"),
    [
        ("package.module:Class", ("package.module", "Class")),
        ("models/a.py:Class", ("models/a.py", "Class")),
        (r"C:\models\a.py:Class", (r"C:\models\a.py", "Class")),
        ("C:/models/a.py:Class", ("C:/models/a.py", "Class")),
        (r"\\server\share\a.py:Class", (r"\\server\share\a.py", "Class")),
        (r"C:\a.fmu", None),
        ("c:/a.fmu", None),
        ("C:a.fmu", None),
        ("C:", None),
        ("x:Class", ("x", "Class")),
        ("a.fmu", None),
        ("", None),
        (":Class", ("", "Class")),
        ("module:", ("module", "")),
        ("ab:", ("ab", "")),
    ],
)
def test_a_drive_is_no_python_module(reference: str, expected: tuple[str, str] | None) -> None:
    """A colon behind one letter is that of a drive, unless a name in Python follows it."""
    assert split_reference(reference) == expected


def test_names_of_slaves_of_models_with_a_drive(tmp_path: Path) -> None:
    """By default a slave is called as the class, and never as what follows a drive."""
    assert _default_name(r"C:\models\a.py:Wheel", tmp_path) == "Wheel"
    assert ":" not in _default_name("C:/models/wheel.fmu", tmp_path)


# ---- Other platforms ----------------------------------------------------------------------------


def test_processes_of_ours_are_out_of_reach_of_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    """A session of their own, and on Windows a process group, as there Ctrl-C goes to a console."""
    assert out_of_reach() == {"start_new_session": True}
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 512, raising=False)
    assert out_of_reach() == {"creationflags": 512}


def test_temporary_files_are_where_all_platforms_look(tmp_path: Path) -> None:
    """Python takes the first of these, and what an FMU asks on Windows one of the others."""
    assert temporary_files_in(tmp_path) == dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(tmp_path))


def test_ctrl_break_ends_a_command_on_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is one of the signals that ask for the end, where there is one."""
    assert signal.SIGINT in ending_signals()
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(signal, "SIGBREAK", signal.SIGUSR1, raising=False)
    assert signal.SIGUSR1 in ending_signals()


def test_the_main_thread_is_interrupted_in_mid_wait() -> None:
    """From another thread, at once: what it waits for does not have to end first."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    never = threading.Event()
    timer = threading.Timer(0.05, interrupt_main_thread)
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            never.wait(60.0)
    finally:
        timer.join()
        signal.signal(signal.SIGINT, before)


# ---- One model alone ----------------------------------------------------------------------------


def test_an_fmu_alone_runs_its_default_experiment(
    capability_dir: Path, tmp_path: Path, command: MainCommand
) -> None:
    """An FMU alone gives the bits of the system that says all of it, on its own step size."""
    fmu = capability_dir / "plain_lag.fmu"
    code, text = command("run", fmu, "--output", tmp_path / "alone", "--in-process")
    assert code == 0, text
    experiment = {"stop_time": 2.0, "initial_step_size": 0.01, "estimator": "none"}
    system = System(slaves={"plain_lag": {"model": str(fmu)}}, simulation=experiment)
    simulate(system, output=tmp_path / "system", in_process=True)
    alone, whole = Result.load(tmp_path / "alone"), Result.load(tmp_path / "system")
    assert alone.outputs.tobytes() == whole.outputs.tobytes()
    assert (len(alone.time), alone.time[-1]) == (201, 2.0)
    assert (tmp_path / "alone" / "results.png").exists()


def test_options_win_over_the_default_experiment(
    capability_dir: Path, tmp_path: Path, command: MainCommand
) -> None:
    """Times, step size, parameters by the slave's name."""
    words = ("--stop-time", "0.5", "--step-size", "0.1", "--parameter", "plain_lag.x_start=3.0")
    fmu = capability_dir / "plain_lag.fmu"
    out = tmp_path / "out"
    code, text = command("run", fmu, *words, "--in-process", "--output", out, "--no-plot")
    assert code == 0, text
    result = Result.load(out)
    assert len(result.time) == 6
    assert result.outputs[0, 0] == 3.0


def test_an_unpacked_fmu_and_a_class_alone(
    tmp_path: Path, fmu_dir: Path, command: MainCommand
) -> None:
    """A Python class suggests no stop time, which is said; with one it runs."""
    wheel = f"{EXAMPLES / 'quarter_car.py'}:Wheel"
    out = tmp_path / "out"
    code, text = command("run", wheel, "--in-process", "--output", out)
    assert code == 2
    assert "stop_time is missing" in text
    words = ("--stop-time", "0.1", "--in-process", "--output", out, "--no-plot", "--quiet")
    assert command("run", wheel, *words)[0] == 0
    assert len(Result.load(out).time) == 1001
    folder = tmp_path / "wheel"
    with ZipFile(fmu_dir / "wheel.fmu") as archive:
        archive.extractall(folder)
    with open_system(folder) as system:
        assert list(system.slaves) == ["wheel"]


def test_a_broken_off_run_of_one_model_is_resumed(capability_dir: Path, tmp_path: Path) -> None:
    """It is a run like others: checkpoints, the same bits."""
    with open_system(capability_dir / "plain_lag.fmu") as system:
        simulate(system, output=tmp_path / "whole", in_process=True)
        with pytest.raises(InterruptedRunError):
            simulate(system, output=tmp_path / "parts", in_process=True, observers=[Interrupt(50)])
    master_node.resume(tmp_path / "parts")
    whole, parts = (tmp_path / name / "results.csv" for name in ("whole", "parts"))
    assert whole.read_bytes() == parts.read_bytes()


def test_a_model_that_is_not_there(tmp_path: Path) -> None:
    """It is told as a model, not as a system file that is no TOML."""
    with pytest.raises(ModelError, match="no such file"), open_system(tmp_path / "none.fmu"):
        pass
    with (
        pytest.raises(ConfigurationError, match="no file"),
        open_system(f"{tmp_path / 'none.py'}:Class"),
    ):
        pass


def test_a_check_of_one_model(capability_dir: Path, command: MainCommand) -> None:
    """Inputs that nothing feeds are what one wants to know of a model alone."""
    code, text = command("check", capability_dir / "plain_lag.fmu", "--in-process")
    assert code == 0
    assert "plain_lag.u" in text
    assert "fixed H" in text


# ---- Tables on 80 columns -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "fmu", quick_at(["all_types3"], ["all_types3", "many_variables", "plain_lag"])
)
def test_tables_of_models_keep_80_columns(fmu: str, capability_dir: Path) -> None:
    """Law: no line is longer, and the words of every description are there as a whole."""
    path = capability_dir / f"{fmu}.fmu"
    text = said("slave-node", "inspect", path)
    assert max(map(len, text.splitlines())) <= 80
    told = json.loads(said("slave-node", "inspect", path, "--json"))
    shown = re.sub(r"\s", "", text)
    for variable in told["variables"][:50]:
        for word in variable["description"].split():
            assert word[:12] in shown, (variable["name"], word)
