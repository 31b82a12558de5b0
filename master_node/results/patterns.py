"""Patterns for ``slave.variable``.

``*`` stands for any text and ``?`` for one character, case counts, and brackets are what they are,
as FMI has them in names. A pattern that begins with ``!`` leaves out.
"""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray


def matches(name: str, pattern: str) -> bool:
    """True if a pattern without ``!`` means a name."""
    return fnmatchcase(name, pattern.replace("[", "[[]"))


def is_name(pattern: str) -> bool:
    """True if a pattern means one name alone."""
    return not pattern.startswith("!") and "*" not in pattern and "?" not in pattern


def chosen(patterns: Sequence[str], names: Sequence[str]) -> NDArray[np.bool_]:
    """Names that match a pattern, and none that begins with ``!``; shape (len(names),).

    Without a pattern to match, all names do.
    """
    wanted = [pattern for pattern in patterns if not pattern.startswith("!")] or ["*"]
    unwanted = [pattern[1:] for pattern in patterns if pattern.startswith("!")]
    return np.array(
        [
            any(matches(name, pattern) for pattern in wanted)
            and not any(matches(name, pattern) for pattern in unwanted)
            for name in names
        ],
        np.bool_,
    )
