"""Beginning of a command: its modules are imported, which takes longer than much of what it does.

Until then nothing was begun that would have to be ended, so that Ctrl-C ends the process at once.
"""

from __future__ import annotations

import importlib
import os
import signal

from protocol.text.plain_text import printable  # imports nothing itself

TYPE_CHECKING = False  # as `typing` has it, which takes longer to import than all else here
if TYPE_CHECKING:
    from typing import NoReturn

_INTERRUPTED = 130
_NO_RESOURCES = 3


def run_command(name: str, module: str) -> None:
    """Import the module of a command, and let its function ``main`` run.

    Args:
        name: of the command, for messages.
        module: has a function ``main``, which handles signals and errors itself.
    """

    def interrupted(*_: object) -> NoReturn:
        _end(f"{name}: interrupted", _INTERRUPTED)

    signal.signal(signal.SIGINT, interrupted)
    try:
        importlib.import_module(module).main()
    except (ImportError, MemoryError) as error:  # commands import what they need when they need it
        what = "the host gives it no memory" if isinstance(error, MemoryError) else str(error)
        remedy = "raise its limits (ulimit -v, or those of its container), or install it again"
        _end(f"{name}: cannot be loaded: {what}; {remedy}", _NO_RESOURCES)


def _end(message: str, exit_code: int) -> NoReturn:
    """At once: nothing of the interpreter is to be tidied up."""
    try:
        os.write(2, f"{printable(message)}\n".encode(errors="replace"))
    finally:  # on a full disk, too
        os._exit(exit_code)
