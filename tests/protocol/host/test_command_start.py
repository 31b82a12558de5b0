"""Beginnings of commands: Ctrl-C while modules are imported, and hosts that give too little."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from random import Random

import pytest

import master_node
from tests.faults.test_processes import BOUND
from tests.support.quarter_car_case import EXAMPLES
from tests.support.slow import quick_at

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals and limits"),
    pytest.mark.usefixtures("no_process_left"),
]

SITE = """
import os, signal, sys
class Interrupt:
    number = None
    def find_spec(self, name, *_):
        if name in ("master_node.cli.app", "slave_node.cli.app"):
            Interrupt.number = 0
        if Interrupt.number is not None:
            Interrupt.number += 1
            if Interrupt.number == int(os.environ["INTERRUPT_AT"]):
                os.write(2, f"interrupted at the import of {name}\\n".encode())
                os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
"""
"""A process interrupts itself at the import of a certain number."""

COMMANDS = {
    "master_node": ("run", EXAMPLES / "displacement_python.toml", "--in-process", "--no-plot"),
    "slave_node": ("serve", f"{EXAMPLES / 'quarter_car.py'}:Wheel", "--connect", "tcp/127.0.0.1:1"),
}
IMPORTS = {"master_node": 950, "slave_node": 350}
"""There are some more than that."""


@pytest.mark.parametrize("seed", quick_at([0], range(5)))
@pytest.mark.parametrize("module", COMMANDS)
def test_ctrl_c_while_modules_are_imported(module: str, seed: int, tmp_path: Path) -> None:
    """At a drawn import, of a command or of what it imports later: one line, exit code 130."""
    (tmp_path / "sitecustomize.py").write_text(SITE)
    number = Random(seed).randint(1, IMPORTS[module])
    words = [sys.executable, "-m", module, *map(str, COMMANDS[module])]
    words += ["--output", str(tmp_path / "out")] if module == "master_node" else []
    done = subprocess.run(
        words,
        env={**os.environ, "PYTHONPATH": str(tmp_path), "INTERRUPT_AT": str(number)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=2 * BOUND,
        check=False,
    )
    told = done.stderr.splitlines()
    assert told[0].startswith("interrupted at the import of"), done.stderr
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert told[-1].startswith(f"{module.replace('_', '-')}: interrupted")


LIMITED = (
    "import os, resource, sys; resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2); "
)
LIMITED += "os.execv(sys.executable, [sys.executable, *sys.argv[2:]])"


def limited(megabytes: int, *words: object) -> subprocess.CompletedProcess[str]:
    """A Python process that gets no more memory than that."""
    command = [sys.executable, "-c", LIMITED, str(megabytes * 2**20), *map(str, words)]
    # with more threads there is too little for them, too
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=2 * BOUND, check=False
    )


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the limit is not that of ulimit -v")
@pytest.mark.parametrize("megabytes", [250, 400, 600])
def test_too_little_memory_is_named(megabytes: int, tmp_path: Path) -> None:
    """Limits of the command itself or of a slave that it launches: cause, remedy, no traceback."""
    file = EXAMPLES / "displacement_python.toml"
    done = limited(megabytes, "-m", "master_node", "run", file, "--output", tmp_path / "out")
    assert done.returncode == 3, done.stderr
    last = done.stderr.splitlines()[-1]
    assert "ulimit -v" in last, done.stderr
    assert "Traceback" not in done.stderr


def test_modules_that_cannot_be_loaded_are_named(tmp_path: Path) -> None:
    """A broken installation is one line, too."""
    (tmp_path / "typer.py").write_text("raise ImportError('half a package')")
    done = subprocess.run(
        [sys.executable, "-m", "master_node", "--help"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=2 * BOUND,
        check=False,
    )
    assert done.returncode == 3
    (told,) = done.stderr.splitlines()
    assert told.startswith("master-node: cannot be loaded: half a package; ")
    assert told.endswith("or install it again")


def test_the_package_gives_what_it_says() -> None:
    """Names are imported when they are asked for: all of them are there, and no others."""
    for name in master_node.__all__:
        assert getattr(master_node, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        master_node.nothing  # noqa: B018
    words = "import sys, master_node; print('numpy' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, timeout=BOUND, check=True
    )
    assert done.stdout.strip() == "False"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
