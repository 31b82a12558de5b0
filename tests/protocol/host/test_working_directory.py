"""The working directory is data: nothing in it is run, imported or taken for a setting."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from protocol.host.python_processes import python_command, restore_path, safe_path
from tests.support.places import ROOT
from tests.support.quarter_car_case import EXAMPLES

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="console scripts without a suffix"),
    pytest.mark.usefixtures("no_process_left"),
]

PACKAGES = [ROOT / name for name in ("protocol", "slave_node", "master_node")]
BIN = Path(sys.executable).parent

TRAPS = (
    *("zenoh", "numpy", "fmpy", "msgpack", "typer", "matplotlib", "lxml", "psutil"),
    *("json", "socket", "pickle", "logging", "subprocess", "multiprocessing", "tempfile"),
    *("protocol", "slave_node", "master_node", "sitecustomize", "usercustomize"),
)
"""Modules of this project, of libraries, and of Python itself."""


@pytest.fixture
def trapped(tmp_path: Path, fmu_dir: Path) -> Path:
    """A folder with a system, and with a program for each name that a process may import."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    for name in TRAPS:
        text = f"open({str(folder / 'RAN')!r}, 'a').write({name!r} + ' ')\nraise ImportError\n"
        if TRAPS.index(name) % 2:
            (folder / name).mkdir()
            (folder / name / "__init__.py").write_text(text)
        else:
            (folder / f"{name}.py").write_text(text)
    for name in ("chassis", "wheel"):
        shutil.copy(fmu_dir / f"{name}.fmu", folder)
    shutil.copy(EXAMPLES / "displacement.toml", folder / "system.toml")
    (folder / "study.toml").write_text(
        'system = "system.toml"\n[parameters]\n"simulation.stop_time" = [0.02]\n'
    )
    return folder


def ours(folder: Path, command: str, *words: str) -> subprocess.CompletedProcess[str]:
    """An installed command, in that folder; without a path of the test session's own."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [BIN / command, *words],
        cwd=folder,
        env={**environment, "TMPDIR": str(folder.parent), "MPLCONFIGDIR": str(folder.parent)},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(
            "master-node run system.toml --stop-time 0.02 --state fork --no-plot", id="forked"
        ),
        pytest.param("slave-node validate wheel.fmu", id="validate"),
        pytest.param("master-node sweep study.toml --workers 1", id="sweep"),
    ],
)
def test_no_process_imports_from_the_working_directory(words: str, trapped: Path) -> None:
    """Masters, nodes, workers, holders of saved states and runs of a study do what they should."""
    done = ours(trapped, *words.split())
    assert done.returncode == 0, done.stdout + done.stderr
    assert not (trapped / "RAN").exists(), (trapped / "RAN").read_text()


def test_settings_of_matplotlib_there_change_no_picture(tmp_path: Path) -> None:
    """A ``matplotlibrc`` in the working directory could have LaTeX run what it says."""
    pictures = []
    for name, settings in (("plain", ""), ("theirs", "text.usetex: True\nfont.size: 30\n")):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "results.csv").write_text("time,a.x\n0.0,1.0\n1.0,2.0\n")
        (folder / "matplotlibrc").write_text(settings)
        done = ours(folder, "master-node", "plot", ".")
        assert done.returncode == 0, done.stdout + done.stderr
        pictures.append((folder / "results.png").read_bytes())
    assert pictures[0] == pictures[1]


def test_python_is_started_in_one_way() -> None:
    """Law: no module but one names the interpreter, so that none can start it otherwise."""
    naming = {
        path.name
        for package in PACKAGES
        for path in package.rglob("*.py")
        if re.search(r"sys\.executable|get_executable", path.read_text())
    }
    assert naming == {"python_processes.py"}
    starting = {
        path.name
        for package in PACKAGES
        for path in package.rglob("*.py")
        if re.search(r"multiprocessing|get_context\(", path.read_text())
        and "safe_path" not in path.read_text()
    }
    naming_only = {"zenoh.py"}  # a remedy
    assert starting <= {"pipe.py", "exit_codes.py", "python_processes.py", *naming_only}, starting


def test_what_a_model_starts_finds_the_environment_of_the_user(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Our own rule ends before code of others begins; a rule of the user's stays."""
    assert "-P" in python_command("-m", "slave_node")
    for given in (None, "1"):
        if given is None:
            monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
        else:
            monkeypatch.setenv("PYTHONSAFEPATH", given)
        with safe_path():
            assert os.environ["PYTHONSAFEPATH"]
            restore_path()
            assert os.environ.get("PYTHONSAFEPATH") == given
            os.environ["PYTHONSAFEPATH"] = given or "doublestep"
        assert os.environ.get("PYTHONSAFEPATH") == given
