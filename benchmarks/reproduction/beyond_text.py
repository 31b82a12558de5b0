"""Markdown for ``beyond.md``: prose, tables and numbers."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence

from benchmarks.reproduction import markdown

WIDTH = 130
"""Columns of prose."""


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; whole numbers and texts as they are."""
    return markdown.table(head, ([str(cell) for cell in row] for row in rows))


def both(*columns: Sequence[object]) -> Iterable[str]:
    """Cells for two runs each: ``one / other``."""
    return (" / ".join(map(str, column)) for column in columns)


def short(value: float, digits: int = 2) -> str:
    """A number in scientific notation with so many digits: ``2.3e-4``."""
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def power(tolerance: float) -> str:
    """A power of ten: ``1e-4``."""
    return short(tolerance, 1)


def block(language: str, *lines: str) -> str:
    """A block of code."""
    return "\n".join((f"```{language}", *lines, "```"))


def commands(*lines: str) -> str:
    """A block of command lines."""
    return block("sh", *lines)


def paragraphs(*parts: str) -> str:
    """Parts with an empty line between them; prose is wrapped."""
    return "\n\n".join(part if _is_set(part) else _wrapped(part) for part in parts)


def verdict(*, reached: bool) -> str:
    """Result of a requirement."""
    return "reached" if reached else "**not reached**"


def _is_set(part: str) -> bool:
    return "\n" in part or part.startswith(("#", "!["))


def _wrapped(part: str) -> str:
    return textwrap.fill(part, WIDTH, break_long_words=False, break_on_hyphens=False)
