"""Python processes that we start: none imports from the working directory.

Python puts that folder in front of its path for ``-m`` and ``-c``. There a file ``json.py`` of
whoever wrote a system file would run, or end the run.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_SAFE_PATH = "PYTHONSAFEPATH"


def python_command(*words: str) -> list[str]:
    """The command line of a Python process with the interpreter of this one."""
    return [sys.executable, "-P", *words]


@contextmanager
def safe_path() -> Iterator[None]:
    """For processes that ``multiprocessing`` starts within, whose command line is its own.

    Such a process calls `restore_path` before it runs code of others: what that starts is not ours.
    """
    given = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = given or _OURS
    try:
        yield
    finally:
        if given is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = given


_OURS = "doublestep"
"""Any text that is not empty turns it on; this one says by whom."""


def restore_path() -> None:
    """Leave to later processes what the user's environment says; see `safe_path`."""
    if os.environ.get(_SAFE_PATH) == _OURS:
        del os.environ[_SAFE_PATH]
