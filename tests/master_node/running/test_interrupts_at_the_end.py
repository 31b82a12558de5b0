"""Ctrl-C at the end of a run: what is complete is told as complete, all else can be resumed."""

from __future__ import annotations

import gc
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import master_node.simulation as simulation_module
from master_node import Result, System, load_system, resume, simulate
from master_node.cli import run as run_command
from master_node.methods.base import Ended
from master_node.results import completion
from master_node.results.completion import is_complete
from master_node.resuming.files import CheckpointStore
from master_node.running.co_simulation import CoSimulation
from master_node.running.loop import Loop
from protocol.errors import InterruptedRunError, StepSizeError
from tests.faults.test_processes import MainCommand, command, system_file
from tests.support.interrupting import Interrupt

__all__ = ["command"]

OURS = tuple(
    str(Path(simulation_module.__file__).parents[1] / room)
    for room in ("master_node", "slave_node", "protocol")
)
# Files stay open where an interrupt came just before they would have been closed.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

FORMATS = "formats = ['csv', 'parquet']\n"


def car(folder: Path, more: str = "") -> Path:
    """A short run of the quarter car."""
    file = system_file(folder, simulation="stop_time = 0.02\n")
    with file.open("a", encoding="utf-8") as text:
        text.write(f"[results]\n{more}")
    return file


class LateInterrupt:
    """KeyboardInterrupt before one of the lines that follow the last step.

    Args:
        number: of the line, from 1 on.

    Attributes:
        lines: number of lines that were reached.
    """

    def __init__(self, number: int) -> None:
        self.lines = 0
        self._number = number

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Count lines from the last step on."""
        advance = Loop.advance

        def watched(loop: Loop, *args: Any) -> Ended | None:
            ended = advance(loop, *args)
            if ended is not None:
                frame = sys._getframe(1)
                while frame is not None:
                    frame.f_trace = self._trace
                    frame = frame.f_back  # type: ignore[assignment]
                sys.settrace(self._trace)
            return ended

        patch.setattr(Loop, "advance", watched)

    def _trace(self, frame: FrameType, event: str, _: object) -> Callable[..., Any]:
        if event == "line" and frame.f_code.co_filename.startswith(OURS):
            self.lines += 1
            if self.lines == self._number:
                sys.settrace(None)
                raise KeyboardInterrupt
        return self._trace


def run_until(number: int, system: System, out: Path) -> tuple[InterruptedRunError | None, int]:
    """Run, with an interrupt before the line of that number behind the last step."""
    interrupt = LateInterrupt(number)
    before = sys.gettrace()
    with pytest.MonkeyPatch.context() as patch:
        interrupt.install(patch)
        try:
            simulate(system, output=out, in_process=True)
        except InterruptedRunError as error:
            return error.with_traceback(None), interrupt.lines
        except KeyboardInterrupt:  # behind all that knows of runs
            return InterruptedRunError(f"the results in {out} are complete"), interrupt.lines
        finally:
            sys.settrace(before)
    return None, interrupt.lines


def rows(folder: Path) -> dict[str, bytes]:
    """Files of results."""
    names = ("results.csv", "steps.csv", "results.parquet")
    return {name: (folder / name).read_bytes() for name in names if (folder / name).exists()}


@pytest.mark.parametrize("formats", ["", FORMATS])
def test_ctrl_c_behind_the_last_step(formats: str, tmp_path: Path) -> None:
    """Law, over the lines of the end: the error says "complete" where the results are, and nowhere
    else; `resume` brings all other runs to the same files, and says nothing against complete ones.
    """
    system = load_system(car(tmp_path, formats))
    whole = tmp_path / "whole"
    run_until(0, system, whole)  # modules are imported
    error, lines = run_until(0, system, whole)
    assert error is None
    assert lines > 200
    seen = set()
    for number in sorted({*range(1, 40, 4), *range(40, lines, max(1, lines // 25)), lines - 9}):
        out = tmp_path / "out"
        error, _ = run_until(number, system, out)
        assert error is not None, number
        complete = is_complete(out)
        seen.add(complete)
        if complete:
            assert f"the results in {out} are complete" in str(error), number
            assert rows(out) == rows(whole)
        else:
            assert "results are complete" not in str(error), number
            assert f"master-node resume {out}" in error.remedy, (number, str(error))
        resume(out)
        assert rows(out) == rows(whole), number
        assert not (out / "checkpoint").exists()
        shutil.rmtree(out)
    gc.collect()  # files that were not closed, which are no matter here
    assert seen == {True, False}


def test_a_complete_run_is_not_resumed(tmp_path: Path) -> None:
    """Nothing is run again and nothing is changed; asked twice, too."""
    out = tmp_path / "out"
    simulate(load_system(car(tmp_path)), output=out, in_process=True)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    for _ in range(2):
        resume(out, observers=(Interrupt(1),))
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


PLACES: dict[str, tuple[Any, str, str]] = {
    "while slaves are terminated": (CoSimulation, "_terminate", "results in .* are complete"),
    "before files are completed": (completion, "convert", "all rows are there.*resume"),
    "while the checkpoint goes": (CheckpointStore, "remove", "results in .* are complete"),
    "while slaves are closed": (simulation_module, "_opened", "results in .* are complete"),
    "while the picture is drawn": (run_command, "_draw", "results are complete; `master-node plot"),
}


def closed_late(has_come: list[int]) -> type:
    """`_opened` of simulations, with SIGINT when the run is left."""
    original = simulation_module._opened

    class Opened:
        def __init__(self, *args: Any, **options: Any) -> None:
            self._inner = original(*args, **options)

        def __enter__(self) -> Any:
            return self._inner.__enter__()

        def __exit__(self, *error: Any) -> Any:
            try:
                has_come.append(1)
                os.kill(os.getpid(), signal.SIGINT)
            finally:
                self._inner.__exit__(*error)

    return Opened


@pytest.mark.parametrize("place", PLACES)
def test_the_command_at_its_end(
    place: str, tmp_path: Path, command: MainCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGINT: exit code 130 with true words; then ``resume`` exits 0 with results and picture."""
    owner, name, words = PLACES[place]
    original = getattr(owner, name)
    file, out = car(tmp_path, FORMATS), tmp_path / "out"
    has_come: list[int] = []

    def press(*args: Any, **options: Any) -> Any:
        if not has_come and (name != "remove" or (out / "summary.json").exists()):
            has_come.append(1)
            os.kill(os.getpid(), signal.SIGINT)
        return original(*args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, closed_late(has_come) if name == "_opened" else press)
        code, text = command("run", file, "--in-process", "--output", out, "--quiet")
    assert has_come
    assert code == 130, text
    assert re.search(words, text), text
    code, text = command("resume", out)
    assert code == 0, text
    assert "completed" in text
    assert (out / "results.png").exists()
    code, text = command("resume", out)
    assert code == 0
    assert "is complete: there is nothing to go on with" in text


def test_ctrl_c_does_not_hide_a_failure(
    tmp_path: Path, command: MainCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message of a run that had failed before tells why."""

    def fail(*_: object) -> None:
        raise StepSizeError("H is too small")

    monkeypatch.setattr(Loop, "advance", fail)
    monkeypatch.setattr(simulation_module, "_opened", closed_late([]))
    words = ("run", car(tmp_path), "--in-process", "--output", tmp_path / "out", "--no-plot")
    code, text = command(*words)
    assert code == 130
    assert "behind the end of the run, which had failed: H is too small" in text


@pytest.mark.parametrize("options", [[], ["--no-plot"]])
def test_ctrl_c_in_mid_run_names_resume_and_draws(
    options: list[str], tmp_path: Path, command: MainCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture shows what there is, unless it was not wanted; the last line says what to do."""
    advance = Loop.advance
    steps: list[int] = []

    def press(loop: Loop, *args: Any) -> Ended | None:
        steps.append(1)
        if len(steps) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return advance(loop, *args)

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(Loop, "advance", press)
        code, text = command("run", car(tmp_path), "--in-process", "--output", out, *options)
    assert code == 130, text
    last = text.splitlines()[-1]
    assert "interrupted at t=" in last
    assert f"`master-node resume {out}` goes on from there" in last
    assert (out / "results.png").exists() == (not options)
    assert Result.load(out).summary["outcome"] == "interrupted"
    assert command("resume", out, "--no-plot", "--quiet")[0] == 0


def test_an_interrupt_before_the_beginning_leaves_old_results_alone(
    tmp_path: Path, command: MainCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The complete results of an earlier run are not taken for those of this one."""
    file, out = car(tmp_path), tmp_path / "out"
    assert command("run", file, "--in-process", "--output", out, "--quiet", "--no-plot")[0] == 0
    before = rows(out)

    def press(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(simulation_module, "check_hashes", press)
    code, text = command("run", file, "--in-process", "--output", out)
    assert code == 130
    assert "interrupted before the first step" in text
    assert "complete" not in text
    assert rows(out) == before
    assert not (out / "results.png").exists()
