"""Markdown: tables, paragraphs, numbers."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence

WIDTH = 128
_TIE = "\x00"


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table, without a line end after it."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)


def paragraph(text: str) -> str:
    """A paragraph in lines of the documents' width, of which none ends within a code span."""
    words = re.sub("`[^`]*`", lambda span: span[0].replace(" ", _TIE), " ".join(text.split()))
    lines = textwrap.fill(words, WIDTH, break_long_words=False, break_on_hyphens=False)
    return lines.replace(_TIE, " ")


def page(*parts: str) -> str:
    """Parts with an empty line between them."""
    return "\n\n".join(parts) + "\n"


def short(value: float, digits: int = 3) -> str:
    """A number in scientific notation: ``6.83e-4``."""
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def span(values: Iterable[object]) -> str:
    """The smallest and the largest of some numbers that are already texts or whole numbers."""
    ordered = sorted(map(str, values), key=float)
    return ordered[0] if ordered[0] == ordered[-1] else f"{ordered[0]} to {ordered[-1]}"
