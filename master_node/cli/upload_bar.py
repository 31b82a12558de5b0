"""Progress of uploads to agents, on a terminal."""

from __future__ import annotations

from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskID,
    TextColumn,
    TransferSpeedColumn,
)

from master_node.hosts.agent_models import Sent
from protocol.host.tables import StandardError
from protocol.text.plain_text import printable


class UploadBar:
    """Shows how far a model is on its way to an agent; nothing where there is no terminal.

    A context, which leaves the terminal as it was.

    Args:
        quiet: print nothing at all.
        console: where to; standard error when None.
    """

    def __init__(self, quiet: bool = False, console: Console | None = None) -> None:
        self._console = StandardError() if console is None else console
        self._quiet = quiet or not self._console.is_terminal
        self._progress: Progress | None = None
        self._task = TaskID(0)

    def __call__(self, sent: Sent) -> None:
        """Redraw; the bar ends with the model."""
        if self._quiet:
            return
        if self._progress is None:
            self._progress = Progress(
                TextColumn("{task.description}", markup=False),
                BarColumn(bar_width=30),
                DownloadColumn(),
                TransferSpeedColumn(),
                console=self._console,
                auto_refresh=False,
            )
            what = printable(f"{sent.model} to {sent.agent}")
            self._task = self._progress.add_task(what, total=sent.size)
            self._progress.start()
        self._progress.update(self._task, completed=sent.sent)
        self._progress.refresh()
        if sent.sent >= sent.size:
            self._stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
