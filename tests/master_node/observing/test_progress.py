"""Progress: seen by people at a terminal, harmless everywhere else."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import numpy as np
import pytest
from rich.console import Console

from master_node.cli.upload_bar import UploadBar
from master_node.hosts.agent_models import Sent
from master_node.observing import progress as progress_module
from master_node.observing.observers import (
    Attempt,
    Outcome,
    RunEnd,
    RunStart,
    SlaveStatistics,
    Statistics,
)
from master_node.observing.progress import ProgressBar, summary_table
from master_node.results import summarize
from tests.support.waiting import BOUND

START = RunStart(("s.x",), ("m",), 1.0, 5.0, np.zeros(1))
END = RunEnd(
    Outcome.COMPLETED,
    Statistics(
        communication_steps=6,
        rejected_double_steps=1,
        round_trips=9,
        wait_time=0.25,
        wall_time=1.5,
        time=5.0,
        smallest_step_size=0.5,
        largest_step_size=1.0,
        slaves={"s[1]": SlaveStatistics(10, 2, 6, 0.75, 1.0)},
    ),
)


def drive(bar: ProgressBar, attempts: int = 4) -> None:
    """A whole run, every fourth attempt of it rejected."""
    bar.started(START)
    for i in range(attempts):
        time = 1.0 + 4.0 * i / attempts
        accepted = i % 4 != 1
        points = ((time + 1.0 / attempts, np.zeros(1)),) if accepted else ()
        bar.attempted(Attempt(time, 0.5, 3, 2, 0.3, accepted, "s.x", points))
    bar.ended(END)


def test_without_a_terminal_two_plain_lines() -> None:
    """In a log file there are a first and a last line, no control characters, nothing between."""
    out = io.StringIO()
    drive(ProgressBar(console=Console(file=out)), attempts=1000)
    assert out.getvalue().splitlines() == [
        "simulating from 1 to 5 s",
        "completed at t = 5 s: 6 steps, 1 rejected, 1.5 s, slowest: s[1] 50%",
    ]


@pytest.mark.parametrize("terminal", [True, False])
def test_quiet_prints_nothing(terminal: bool) -> None:
    """Quiet is quiet, at a terminal and elsewhere."""
    out = io.StringIO()
    drive(ProgressBar(quiet=True, console=Console(file=out, force_terminal=terminal)))
    assert not out.getvalue()


def test_at_a_terminal_a_bar_with_the_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time, H, polynomial, rejections are shown, the cursor comes back, the last state stays."""
    monkeypatch.setattr(progress_module, "UPDATE_INTERVAL", 0.0)
    out = io.StringIO()
    drive(ProgressBar(console=Console(file=out, force_terminal=True, width=120)))
    text = out.getvalue()
    for part in ("H = 5.00e-01 s", "k = 3''  ", "1 rejected", "t = 5 s  completed", "100%", "left"):
        assert part in text
    assert text.rstrip().endswith("\x1b[?25h"), "the cursor is visible again"


def test_redraws_are_rare_however_many_attempts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten redraws a second at most: attempts between them cost a look at the clock."""
    now = 0.0
    monkeypatch.setattr(progress_module, "monotonic", lambda: now)
    bar = ProgressBar(console=Console(file=io.StringIO(), force_terminal=True))
    redraws = 0

    def draw(*_: object) -> None:
        nonlocal redraws
        redraws += 1

    monkeypatch.setattr(bar, "_draw", draw)
    bar.started(START)
    for i in range(10_000):
        now = i * 1e-3  # ten seconds
        bar.attempted(Attempt(now, 0.5, 2, 0, 0.3, False, "s.x"))
    assert 90 <= redraws <= 100
    bar.ended(END)


@pytest.mark.skipif(sys.platform == "win32", reason="closed pipes are told by EPIPE on POSIX")
def test_a_closed_pipe_does_not_end_the_run() -> None:
    """A closed standard error stops no run, and standard output still works."""
    reading, writing = os.pipe()
    os.close(reading)
    code = """
from master_node.observing.observers import Outcome, RunEnd, RunStart, Statistics
from master_node.observing.progress import ProgressBar
from tests.support.waiting import BOUND
import numpy as np
bar = ProgressBar()
for _ in range(2):
    bar.started(RunStart((), (), 0.0, 1.0, np.zeros(0)))
    bar.ended(RunEnd(Outcome.COMPLETED, Statistics()))
print("still here")
"""
    process = subprocess.run(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=writing,
        check=False,
        timeout=BOUND,
    )
    os.close(writing)
    assert process.stdout == b"still here\n"


def printed(summary: dict[str, object]) -> str:
    """The summary table as text."""
    console = Console(width=100, file=io.StringIO())
    with console.capture() as captured:
        console.print(summary_table(summary))
    return captured.get()


def test_summary_table_has_run_and_slaves() -> None:
    """The table tells what happened, how long and where; brackets in names are no markup."""
    settings = {"simulation": {"estimator": "richardson", "order": 2}}
    lines = [line.split() for line in printed(summarize(START, END, settings)).splitlines()]
    assert ["outcome", "completed"] in lines
    assert ["simulated", "time", "4", "s"] in lines
    assert ["estimator", "richardson"] in lines
    assert ["rejected", "double", "steps", "1"] in lines
    assert ["s[1]", "10", "2", "6", "0.75", "0.25"] in lines


def test_summary_table_leaves_out_what_is_not_known() -> None:
    """Neither a run without steps nor a summary that is not there is an error."""
    empty = summarize(START, RunEnd(Outcome.FAILED, Statistics(time=1.0), "s: lost"), {})
    text = printed(empty)
    assert "failed" in text
    assert "s: lost" in text
    assert "step size" not in text
    assert printed({}).strip() == ""


def test_a_model_on_its_way_is_seen_at_a_terminal_only() -> None:
    """Model, agent and bytes, whatever is in the names; and the cursor is back after a failure."""
    seen = {}
    for terminal in (True, False):
        out = io.StringIO()
        console = Console(file=out, force_terminal=terminal, width=120)
        with pytest.raises(OSError, match="lost"), UploadBar(console=console) as bar:  # noqa: PT012
            bar(Sent("wheel", "winbox", "[b]wheel.fmu", 1_000_000, 3_000_000))
            raise OSError("lost")
        seen[terminal] = out.getvalue()
    assert seen[False] == ""
    assert "[b]wheel.fmu to winbox" in seen[True]
    assert "1.0/3.0 MB" in seen[True]
    assert seen[True].rindex("\x1b[?25h") > seen[True].index("\x1b[?25l")
    out = io.StringIO()
    with UploadBar(quiet=True, console=Console(file=out, force_terminal=True)) as bar:
        bar(Sent("wheel", "winbox", "wheel.fmu", 1, 1))
    assert out.getvalue() == ""
