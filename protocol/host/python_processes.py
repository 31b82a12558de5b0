"""Python processes that we start: none imports from the working directory.

Python puts that folder in front of its path for ``-m`` and ``-c``. There a file ``json.py`` of
whoever wrote a system file would run, or end the run.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypedDict

_SAFE_PATH = "PYTHONSAFEPATH"


def python_command(*words: str) -> list[str]:
    """The command line of a Python process with the interpreter of this one."""
    return [sys.executable, "-P", *words]


class OutOfReach(TypedDict, total=False):
    """Arguments of `subprocess.Popen`, see `out_of_reach`."""

    start_new_session: bool
    creationflags: int


def out_of_reach() -> OutOfReach:
    """Arguments with which Ctrl-C reaches this process alone, and not the one that is started."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    else:  # noqa: RET505  what the type checker sees of a platform
        return {"start_new_session": True}


def temporary_files_in(scratch: Path) -> dict[str, str]:
    """Environment in which a process, and what it loads, has its temporary files in a directory."""
    return dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(scratch))


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
