"""The keeper: the process above all that hold one model by forking. It holds no model itself.

Holders come and go and are each other's parents, so that none of them could answer for the rest.
The keeper adopts those whose parent is gone, buries the dead, reports how they died, and ends
all of them, even in the middle of a step, when its standard input closes: the other end is with the
slave that started it, and closes at the latest with that process.

It imports hardly more than the standard library, and so stays small.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import sys
import traceback

from slave_node.states.obituaries import report

_PR_SET_CHILD_SUBREAPER = 36
_LIFELINE = 0


def main(channel: int, obituaries: int) -> None:
    """Start the first holder and look after its family.

    Args:
        channel: descriptor of the socket on which the first holder is driven.
        obituaries: descriptor of the pipe into which deaths are written.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started us
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_CHILD_SUBREAPER)")
    first = os.fork()
    if first == 0:
        _hold(channel, obituaries)
    os.close(channel)
    os.setpgid(first, first)
    signal.signal(signal.SIGCHLD, lambda *_: _bury(obituaries))
    _bury(obituaries)  # who died before
    while os.read(_LIFELINE, 1):
        pass
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    _end_all(first)


def _hold(channel: int, obituaries: int) -> None:
    """Be the first holder; does not return."""
    exit_code = 1  # the model leaves
    try:
        os.setpgid(0, 0)
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, _LIFELINE)
        os.close(nothing)
        from slave_node.states.fork_holder import hold  # noqa: PLC0415  not in the keeper

        hold(socket.socket(fileno=channel), obituaries)
    except Exception:
        traceback.print_exc()
        from slave_node.execution.exit_codes import OWN_FAILURE  # noqa: PLC0415  as above

        exit_code = OWN_FAILURE
    finally:
        sys.stderr.flush()
        os._exit(exit_code)


def _bury(obituaries: int) -> None:
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if pid == 0:
            return
        report(obituaries, pid, status)


def _end_all(group: int) -> None:
    """Holders have a process group of their own, which their forks are born into."""
    while True:
        try:
            os.killpg(group, signal.SIGKILL)
            os.waitpid(-group, 0)
        except (ProcessLookupError, ChildProcessError):
            return
