"""Texts of others, made fit for a terminal, a log or a picture: the one place that does it.

Errors, logs and all that the commands print go through `printable`. What is not ours can
then neither move the cursor, nor begin a line, nor turn letters around.
"""

from __future__ import annotations

_SPACES = f"\u00a0\u1680{''.join(map(chr, range(0x2000, 0x200B)))}\u202f\u205f\u3000"
"""Other spaces than ours, as in Japanese texts (Zs of Unicode)."""


def printable(text: str) -> str:
    r"""``text`` on one line, with escapes such as ``\x1b`` for all that is no visible character.

    Control characters of both sets, line ends of all kinds, marks that change the direction or have
    no width, and halves of characters.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in _SPACES else repr(c)[1:-1] for c in text)


def shortened(text: str, length: int) -> str:
    """``text`` as `printable`, and no longer than ``length``; of what is longer the first part."""
    shown = printable(text[: length + 1])
    return shown if len(shown) <= length else f"{shown[: length - 1]}…"
