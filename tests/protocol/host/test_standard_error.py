"""A full disk behind the standard error: nothing can be told there, and all else is as ever."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.test_processes import system_file
from tests.support.waiting import BOUND

FULL = Path("/dev/full")

pytestmark = [
    pytest.mark.skipif(not FULL.exists(), reason="needs a device that is full"),
    pytest.mark.usefixtures("no_process_left"),
]


def into_full_disk(*words: object) -> int:
    """The exit code of a Python process that cannot write a word."""
    with FULL.open("wb") as full:
        command = [sys.executable, *map(str, words)]
        return subprocess.run(
            command, stdout=full, stderr=full, timeout=BOUND, check=False
        ).returncode


TALKER = """
from slave_node.model import Model, real

class Talker(Model):
    states = (real("x"),)
    outputs = states

    def derivatives(self, t, x, u):
        print("one line after the other", flush=True)
        return [1.0 - x[0]]
"""


@pytest.mark.parametrize("options", [(), ("--in-process",)])
def test_a_run_is_as_ever(options: tuple[str, ...], tmp_path: Path) -> None:
    """Exit code and results, with a model that prints in each step."""
    (tmp_path / "talker.py").write_text(TALKER)
    file = tmp_path / "talker.toml"
    file.write_text(
        "[simulation]\nstop_time = 0.1\n[slaves.talker]\n"
        f'model = "{tmp_path / "talker.py"}:Talker"\n'
    )
    words = ("-m", "master_node", "run", file, "--no-plot", "--output", tmp_path / "out")
    assert into_full_disk(*words, "--quiet", *options) == 0
    assert (tmp_path / "out" / "results.csv").exists()


@pytest.mark.parametrize(
    ("module", "words"),
    [("master_node", ("run", "nothing.toml")), ("slave_node", ("inspect", "nothing.fmu"))],
)
def test_an_error_keeps_its_exit_code(module: str, words: tuple[str, ...]) -> None:
    """2 and not 1, though there is no message."""
    assert into_full_disk("-m", module, *words) == 2


def test_a_run_that_warns_and_draws(tmp_path: Path) -> None:
    """The progress and warnings are lost, no row is; the summary has nowhere to go: exit code 7."""
    file = system_file(tmp_path, simulation="stop_time = 0.02\n")
    words = ("-m", "master_node", "run", file, "--in-process", "--output", tmp_path / "out")
    assert into_full_disk(*words, "--no-plot") == 7
    assert (tmp_path / "out" / "results.csv").exists()


def test_what_models_print_in_their_own_process() -> None:
    """A print ends no model, with or without a buffer, and no process at its end."""
    words = (
        "from protocol.host.standard_error import forgive_models as f; f(); print('x' * 10**6); "
    )
    assert into_full_disk("-c", f"{words} print('y', flush=True)") == 0
    assert into_full_disk("-c", "print('x' * 10**6)") != 0
