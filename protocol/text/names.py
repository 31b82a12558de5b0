"""Names in messages: what there is, and suggestions for misspelt ones."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def listed(names: Iterable[str]) -> str:
    """Names for a message, all of up to ten."""
    quoted = list(map(repr, names))
    more = f" and {len(quoted) - 10} more" if len(quoted) > 10 else ""
    return ", ".join(quoted[:10]) + more


def nearest(name: str, known: Iterable[str]) -> str:
    """``; did you mean 'x'?`` for an error message, or what there is, or an empty string."""
    names = list(known)
    close = get_close_matches(name, names, n=3, cutoff=0.5)
    if close:
        return f"; did you mean {' or '.join(map(repr, close))}?"
    if 0 < len(names) <= 10:
        return f"; there is {', '.join(map(repr, names))}"
    return ""


def some(names: Iterable[str], most: int = 20) -> str:
    """Names with commas between them, in their order; how many more there are than ``most``."""
    all_names = list(names)
    more = f" and {len(all_names) - most} more" if len(all_names) > most else ""
    return ", ".join(all_names[:most]) + more


def number_of(count: int, noun: str) -> str:
    """``1 input``, ``2 inputs``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
