"""Progress of a run at the prompt: a bar on the way, a table at the end."""

from __future__ import annotations

from collections.abc import Mapping
from time import monotonic
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table

from master_node.numerics.extrapolation import InputPolynomial
from master_node.observing.observers import Attempt, RunEnd, RunStart, SlaveStatistics, slowest
from protocol.host.tables import StandardError, plain

UPDATE_INTERVAL = 0.1
"""Shortest time between two redraws [s]."""


class ProgressBar:
    """An observer that shows simulated time, H, order, rejections and the time left.

    Draws in the run's own thread, between steps: no second thread takes time from the run. Where
    there is no terminal it prints one line at the start and one at the end.

    Args:
        quiet: print nothing at all.
        console: where to; standard error when None.
    """

    def __init__(self, quiet: bool = False, console: Console | None = None) -> None:
        self._quiet = quiet
        self._console = StandardError() if console is None else console
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._start_time = 0.0
        self._rejected = 0
        self._time = 0.0
        self._next_update = 0.0
        self._begin = 0.0
        self._statistics: Mapping[str, SlaveStatistics] = {}

    def started(self, start: RunStart) -> None:
        """Show the empty bar, or the first line."""
        self._start_time = self._time = start.start_time
        self._rejected = 0
        self._begin = monotonic()
        self._statistics = start.statistics
        if self._quiet:
            return
        if not self._console.is_terminal:
            self._line(f"simulating from {start.start_time:g} to {start.stop_time:g} s")
            return
        self._progress = Progress(
            BarColumn(bar_width=30),
            TextColumn("[progress.percentage]{task.percentage:>3.0f}%"),
            TextColumn("{task.fields[state]}", markup=False),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=self._console,
            auto_refresh=False,
        )
        self._task = self._progress.add_task(
            "", total=start.stop_time - start.start_time, state=f"t = {start.start_time:.4g} s"
        )
        self._progress.start()
        self._next_update = monotonic() + UPDATE_INTERVAL

    def attempted(self, attempt: Attempt) -> None:
        """Redraw, at most every ``UPDATE_INTERVAL``."""
        if not attempt.accepted:
            self._rejected += 1
        if attempt.points:
            self._time = attempt.points[-1][0]
        if self._progress is None or monotonic() < self._next_update:
            return
        self._draw(
            self._progress,
            f"t = {self._time:.4g} s  H = {attempt.step_size:.2e} s  k = {_polynomial(attempt)}"
            f"  {self._rejected} rejected"
            f"{_slowest(self._statistics, monotonic() - self._begin, '  slowest: ')}",
        )
        self._next_update = monotonic() + UPDATE_INTERVAL

    def ended(self, end: RunEnd) -> None:
        """Leave the last state on the screen."""
        if self._quiet:
            return
        statistics = end.statistics
        self._time = statistics.time
        if self._progress is not None:
            self._draw(self._progress, f"t = {self._time:.4g} s  {end.outcome}")
            self._progress.stop()
            self._progress = None
            return
        self._line(
            f"{end.outcome} at t = {statistics.time:g} s: {statistics.communication_steps} steps, "
            f"{statistics.rejected_double_steps} rejected, {statistics.wall_time:.3g} s"
            f"{_slowest(statistics.slaves, statistics.wall_time, ', slowest: ')}"
        )

    def _draw(self, progress: Progress, state: str) -> None:
        progress.update(self._task, completed=self._time - self._start_time, state=state)
        progress.refresh()

    def _line(self, text: str) -> None:
        self._console.print(plain(text), highlight=False, soft_wrap=True)


def _slowest(statistics: Mapping[str, SlaveStatistics], wall_time: float, label: str) -> str:
    """The slave that computed for the longest time, with its part of ``wall_time`` [s]."""
    name = slowest(statistics)
    if not name or wall_time <= 0.0:
        return ""
    return f"{label}{name} {min(1.0, statistics[name].compute_time / wall_time):.0%}"


_FACTS = (
    ("outcome", "outcome", ""),
    ("message", "message", ""),
    ("simulated_time", "simulated time", " s"),
    ("wall_time", "wall time", " s"),
    ("wait_time", "of it waiting for slaves", " s"),
    ("estimator", "estimator", ""),
    ("order", "order of the inputs", ""),
    ("communication_steps", "communication steps", ""),
    ("rejected_double_steps", "rejected double steps", ""),
    ("discontinuities", "discontinuities", ""),
    ("smallest_step_size", "smallest step size", " s"),
    ("largest_step_size", "largest step size", " s"),
    ("round_trips", "round trips", ""),
)
_PER_SLAVE = (
    ("state_kind", "state"),
    ("do_steps", "do_steps"),
    ("rollbacks", "rollbacks"),
    ("requests", "requests"),
    ("compute_time", "compute time [s]"),
    ("transport_time", "transport [s]"),
)


def summary_table(result_summary: Mapping[str, Any]) -> Table:
    """For ``rich.print``: the summary of ``results.summarize``; leaves out what is not known."""
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim")
    facts.add_column(overflow="fold")
    for key, label, unit in _FACTS:
        value = result_summary.get(key)
        if value not in (None, ""):
            style = _outcome_style(value) if key == "outcome" else ""
            facts.add_row(label, plain(_text(value) + unit, style))
    for label, text in _control(result_summary):
        facts.add_row(label, plain(text))
    parts: list[RenderableType] = [facts]
    per_slave = [(result_summary.get(key) or {}, label) for key, label in _PER_SLAVE]
    names = dict.fromkeys(name for values, _ in per_slave for name in values)
    if names:
        first = Column("slave", overflow="fold")
        slaves = Table(first, box=None, padding=(0, 2, 0, 0), header_style="dim")
        for _, label in per_slave:
            slaves.add_column(plain(label), justify="right")
        for name in names:
            slaves.add_row(plain(name), *(plain(_text(v.get(name, ""))) for v, _ in per_slave))
        parts += ["", slaves]
    table = Table.grid()
    for part in parts:
        table.add_row(part)
    return table


def _control(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Labels and texts on which outputs are controlled how, where not all are in one way."""
    controlled_by = summary.get("controlled_by") or {}
    if not controlled_by.get("input_defects"):
        return []
    rows = [
        (label, ", ".join(controlled_by[key]))
        for key, label in (
            ("double_step", "controlled by double steps"),
            ("input_defects", "controlled by input defects"),
        )
        if controlled_by.get(key)
    ]
    return [*rows, ("steps above tolerance", _text(summary.get("steps_above_tolerance", "")))]


def _outcome_style(outcome: object) -> str:
    return {"completed": "bold green", "failed": "bold red"}.get(str(outcome), "bold yellow")


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _polynomial(attempt: Attempt) -> str:
    """The degree, with a prime for each point at which derivatives are met."""
    return str(InputPolynomial(attempt.order, attempt.derivative_points))
