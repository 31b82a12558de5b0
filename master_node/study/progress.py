"""Progress of a study at the prompt: a bar on the way, a line for each failure."""

from __future__ import annotations

from time import monotonic
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from master_node.observing.progress import UPDATE_INTERVAL
from master_node.study.directory import run_name
from master_node.study.records import RunRecord
from protocol.host.tables import StandardError, plain


class StudyProgress:
    """Shows how many runs have ended, are under way, have failed, and the time left.

    Where there is no terminal it prints a line at the start, one for each failure, and one at the
    end.

    Args:
        quiet: print nothing at all.
        console: where to; standard error when None.
    """

    def __init__(self, quiet: bool = False, console: Console | None = None) -> None:
        self._quiet = quiet
        self._console = StandardError() if console is None else console
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._runs = self._ended = self._failed = 0
        self._next_update = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, _: TracebackType | None
    ) -> None:
        """Leave the last state on the screen."""
        if self._progress is not None:
            self._draw(self._progress, 0)
            self._progress.stop()
            self._progress = None
        if self._runs:
            self._line(f"{self._ended} of {self._runs} runs ended, {self._failed} failed")

    def begin(self, runs: int, skipped: int, failed: int) -> None:
        """Show the bar, or the first line.

        Args:
            runs: how many there are.
            skipped: of these, how many had been run before.
            failed: of the skipped ones.
        """
        self._runs, self._ended, self._failed = runs, skipped, failed
        known = f", {skipped} of them ended before" if skipped else ""
        self._line(f"{runs} runs{known}")
        if self._quiet or not self._console.is_terminal:
            return
        self._progress = Progress(
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}", markup=False),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=self._console,
            auto_refresh=False,
        )
        self._task = self._progress.add_task("", total=runs, completed=skipped, state="")
        self._progress.start()

    def ended(self, number: int, record: RunRecord) -> None:
        """Count a run; say why it failed."""
        self._ended += 1
        if not record.is_completed:
            self._failed += 1
            self._line(
                f"run {run_name(number)} failed, exit code {record.exit_code}: {record.message}"
            )

    def update(self, under_way: int) -> None:
        """Redraw, at most every ``UPDATE_INTERVAL``."""
        if self._progress is None or monotonic() < self._next_update:
            return
        self._draw(self._progress, under_way)
        self._next_update = monotonic() + UPDATE_INTERVAL

    def _draw(self, progress: Progress, under_way: int) -> None:
        state = f"{under_way} under way  {self._failed} failed"
        progress.update(self._task, completed=self._ended, state=state)
        progress.refresh()

    def _line(self, text: str) -> None:
        if not self._quiet:
            self._console.print(plain(text), highlight=False, soft_wrap=True)
