"""Texts of others, made fit for a terminal or a log."""

from __future__ import annotations


def printable(text: str) -> str:
    """``text`` with a question mark for each control character, line ends too."""
    return "".join(c if c.isprintable() else "?" for c in text)
