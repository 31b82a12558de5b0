"""Models that change the process around them: results, signals and output stay as they were."""

from __future__ import annotations

import ctypes
import decimal
import json
import locale
import logging
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_node import System, simulate
from master_node.observing.observers import Attempt
from protocol.errors import InterruptedRunError
from slave_node.floating_point import restore_floating_point
from tests.support.places import SUPPORT

MEDDLER = f"{SUPPORT / 'meddling_models.py'}:Meddler"
FUNCTION = f"{SUPPORT / 'meddling_models.py'}:overflowing"
TIMEOUT = 120.0


def process_state() -> dict[str, Any]:
    """All of the process that the models change, as far as it can be seen."""
    mask = os.umask(0)
    os.umask(mask)
    return {
        "directory": Path.cwd(),
        "umask": mask,
        "locale": locale.setlocale(locale.LC_ALL),
        "logging": logging.root.manager.disable,
        "errors": np.geterr(),
        "precision": decimal.getcontext().prec,
        "recursion": sys.getrecursionlimit(),
        "path": list(sys.path),
        "environment": dict(os.environ),
        "filters": list(warnings.filters),
        "signals": [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)],
        "streams": (sys.stdout, sys.stderr),
        "descriptors": [os.fstat(n)[:3] for n in (0, 1, 2)],
        "rounding": (1.0 + FRACTION == 1.0, -1.0 - FRACTION == -1.0),
    }


FRACTION = float.fromhex("0x1p-53")


def system(
    *models: str | Path, inputs: Mapping[str, Any] | None = None, **simulation: Any
) -> System:
    """A chain of models with input u and output y."""
    names = [f"m{i}" for i in range(len(models))]
    return System(
        inputs=inputs or {},
        simulation={"stop_time": 1.0, **simulation},
        slaves={n: {"model": str(m)} for n, m in zip(names, models, strict=True)},
        connections=[(f"{a}.y", f"{b}.u") for a, b in pairwise(names)],
    )


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_process_is_as_it_was(elsewhere: Path, capability_fmu: Callable[[str], Path]) -> None:
    """After a run in process with an FMU, a Python model and a function that change it all.

    And the results are where the user said, relative to where the run began.
    """
    before = process_state()
    models = (MEDDLER, capability_fmu("changes_process"), capability_fmu("plain_lag"))
    meddled = system(*models, inputs={"m0.u": {"function": FUNCTION}})
    simulate(meddled, in_process=True, output="results", trace="trace.json")
    assert process_state() == before
    assert sorted(p.name for p in elsewhere.iterdir()) == ["results", "trace.json"]
    for path in (elsewhere / "results").iterdir():
        assert path.is_dir() or path.stat().st_mode & 0o400


def test_numbers_are_those_of_a_model_that_changes_nothing(
    capability_fmu: Callable[[str], Path],
) -> None:
    """Bit for bit: neither rounding nor traps of one model reach the master or the next model."""
    names = ("changes_process", "plain_lag")
    results = [
        simulate(system(capability_fmu(first), capability_fmu("plain_lag")), in_process=True)
        for first in names
    ]
    assert results[0].time.tobytes() == results[1].time.tobytes()
    assert results[0].outputs.tobytes() == results[1].outputs.tobytes()


@pytest.mark.usefixtures("no_process_left")
def test_in_process_and_in_processes_the_same(
    capability_fmu: Callable[[str], Path], tmp_path: Path
) -> None:
    """Bit for bit, whoever shares a process with whom."""
    meddled = system(capability_fmu("changes_process"), MEDDLER)
    here = simulate(meddled, in_process=True)
    there = simulate(meddled, output=tmp_path / "there")
    assert here.time.tobytes() == there.time.tobytes()
    assert here.outputs.tobytes() == there.outputs.tobytes()


class SignalAt:
    """An observer that sends its own process a signal after some attempts."""

    def __init__(self, number: signal.Signals, attempts: int) -> None:
        self._signal, self._left = number, attempts

    def started(self, _: object) -> None:
        """Nothing."""

    def attempted(self, _: Attempt) -> None:
        """Count down."""
        self._left -= 1
        if not self._left:
            os.kill(os.getpid(), self._signal)

    def ended(self, _: object) -> None:
        """Nothing."""


@pytest.mark.parametrize("model", ["changes_process", MEDDLER])
def test_ctrl_c_is_heard(model: str, capability_fmu: Callable[[str], Path]) -> None:
    """Although the model has told the process to ignore it when it was loaded."""
    fmu = model if ":" in model else capability_fmu(model)
    endless = system(fmu, stop_time=1e6, largest_step_size=1e-2)
    with pytest.raises(InterruptedRunError):
        simulate(endless, in_process=True, observers=[SignalAt(signal.SIGINT, 3)])


def command(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
        cwd=cwd,
    )


@pytest.mark.parametrize("model", ["changes_process", MEDDLER])
@pytest.mark.parametrize("verb", ["inspect", "validate"])
def test_json_is_json(
    verb: str, model: str, capability_fmu: Callable[[str], Path], tmp_path: Path
) -> None:
    """Standard output, whatever the model prints, and whereto, until the process has ended."""
    fmu = model if ":" in model else capability_fmu(model)
    done = command("slave_node", verb, "--json", fmu, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    json.loads(done.stdout)
    if ":" in model:
        assert "a line while the module is loaded" in done.stderr


def test_a_quiet_run_is_quiet(capability_fmu: Callable[[str], Path], tmp_path: Path) -> None:
    """Prints of models in process do not come on the standard output of the run."""
    models = {"a": capability_fmu("changes_process"), "b": MEDDLER}
    tables = [f"[slaves.{name}]\nmodel = '{model}'\n" for name, model in models.items()]
    (tmp_path / "system.toml").write_text("[simulation]\nstop_time = 0.1\n" + "".join(tables))
    words = ("master_node", "run", "system.toml", "--in-process", "--no-plot", "--output", "out")
    quiet = command(*words, "--quiet", cwd=tmp_path)
    assert (quiet.returncode, quiet.stdout) == (0, ""), quiet.stderr
    assert (tmp_path / "out" / "results.csv").is_file()
    told = command(*words, cwd=tmp_path)
    assert "results in out" in told.stdout
    assert "a line" not in told.stdout


def test_the_floating_point_environment_comes_back() -> None:
    """Law: rounding is to nearest again after whatever C code did to it."""
    upward = 0x800  # FE_UPWARD of x86; elsewhere another number, which changes nothing here
    library = ctypes.CDLL(None)
    library.fesetround(upward)
    restore_floating_point()
    assert (1.0 + FRACTION == 1.0, -1.0 - FRACTION == -1.0) == (True, True)
