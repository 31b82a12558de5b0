"""Tables and progress on a terminal. Nothing in a cell is markup, and all of it is printable."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console
from rich.table import Table
from rich.text import Text

from protocol.text.plain_text import shortened

LONGEST = 2000
"""Characters of a cell that are shown."""


def plain(text: object, style: str = "", longest: int = LONGEST) -> Text:
    """A cell that shows ``text`` on one line and does nothing else."""
    return Text(shortened(str(text), longest), style)


def lines(texts: Iterable[object]) -> Text:
    """Several texts as one cell, each on a line of its own."""
    return Text("\n").join(map(plain, texts))


def show(*tables: Table) -> None:
    """Print tables whose cells are `plain`."""
    console = Console()
    for table in tables:
        console.print(table)


class StandardError(Console):
    """Rich ends the program when its pipe breaks; a run must not end for that."""

    def __init__(self) -> None:
        super().__init__(stderr=True)

    def on_broken_pipe(self) -> None:
        """Be silent from now on."""
        self.quiet = True
