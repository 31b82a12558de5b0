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
    except SystemExit as ending:
        if ending.code == _INTERRUPTED:
            _end_at_once(_INTERRUPTED)
        raise
    except (ImportError, MemoryError) as error:  # commands import what they need when they need it
        what = "the host gives it no memory" if isinstance(error, MemoryError) else str(error)
        remedy = "raise its limits (ulimit -v, or those of its container), or install it again"
        _end(f"{name}: cannot be loaded: {what}; {remedy}", _NO_RESOURCES)


def _end_at_once(exit_code: int) -> NoReturn:
    """Run what is to be done at the exit, and leave the interpreter as it is.

    Ctrl-C breaks off waits for the bus. A thread of Zenoh that calls back while the interpreter is
    taken down would abort the process, with another exit code.
    """
    import atexit  # noqa: PLC0415  as it ends
    import sys  # noqa: PLC0415

    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):  # a full disk, or closed: there is no place to tell it
            pass
    os._exit(exit_code)


def _end(message: str, exit_code: int) -> NoReturn:
    """At once: nothing of the interpreter is to be tidied up."""
    try:
        os.write(2, f"{printable(message)}\n".encode(errors="replace"))
    finally:  # on a full disk, too
        os._exit(exit_code)
