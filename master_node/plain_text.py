"""Texts of others on our terminal: no markup, no control characters, not too long."""

from __future__ import annotations

from rich.text import Text

_LONGEST = 200


def plain(text: object) -> Text:
    """A cell of a table that shows ``text`` and does nothing else."""
    shown = "".join(c if c.isprintable() else "?" for c in str(text)[: _LONGEST + 1])
    return Text(shown if len(shown) <= _LONGEST else f"{shown[:_LONGEST]}…")
