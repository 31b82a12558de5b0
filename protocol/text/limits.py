"""Limits of texts in messages, by their kind [characters].

The receiver of a message refuses longer names. The sender cuts sentences, so that none is refused
for its length. Values of variables are bounded by the length of a message alone.
"""

from __future__ import annotations

from typing import Final

MAX_HOST: Final = 255
"""Limit of the name of a host, as in DNS."""

MAX_NAME: Final = 4096
"""Limit of the name of a variable, a unit, a model, a file or a path."""

MAX_SENTENCE: Final = 16_384
"""Limit of a description, a cause, a remedy, a remark."""


def cut(text: str, length: int = MAX_SENTENCE) -> str:
    """``text``, or as much of it as there is room for and a sign that there is more."""
    return text if len(text) <= length else f"{text[: length - 1]}…"
