"""End of a run whose parent process is gone."""

from __future__ import annotations

import os
import sys
import time

from protocol.errors import InterruptedRunError
from protocol.host.processes import interrupt_main_thread
from protocol.host.threads import start_thread

_END_TIME = 5.0


def end_with_parent() -> None:
    """Interrupt this process when standard input, a pipe from the parent process, closes."""

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        interrupt_main_thread()
        time.sleep(_END_TIME)
        os._exit(InterruptedRunError.exit_code)  # a model in this process does not come back

    start_thread(watch, "parent")
