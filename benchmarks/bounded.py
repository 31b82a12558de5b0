"""A command in a process of its own, bounded in time and memory, with nothing left behind."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from tempfile import TemporaryFile
from time import monotonic

import psutil

_PERIOD = 0.2
_LONGEST_OUTPUT = 1 << 20
_TIME_TO_END = 5.0
_PR_SET_CHILD_SUBREAPER = 36


class Bound(StrEnum):
    """The bound that a command was ended for."""

    TIME = "time"
    MEMORY = "memory"


@dataclass(frozen=True, slots=True)
class Outcome:
    """The end of a command.

    Attributes:
        exit_code: as `subprocess.Popen.returncode`.
        stdout, stderr: at most the last megabyte of each.
        seconds: it took [s].
        bound: None: it ended by itself.
        left: command lines of the processes that it left running; they were killed.
    """

    exit_code: int
    stdout: str
    stderr: str
    seconds: float
    bound: Bound | None
    left: tuple[str, ...]


@contextmanager
def _orphans_adopted() -> Iterator[None]:
    """Make processes whose parents die children of this one, so that none is overlooked.

    Only Linux can do that.
    """
    if sys.platform != "linux":
        yield
        return
    prctl = ctypes.CDLL(None).prctl
    prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        yield
    finally:
        prctl(_PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)


def run_bounded(
    command: Sequence[str],
    directory: Path,
    environment: Mapping[str, str],
    seconds: float,
    memory_bytes: float,
) -> Outcome:
    """Run a command.

    Args:
        command: program and arguments.
        directory: working directory.
        environment: variables beside those of this process.
        seconds: it is killed after that time [s].
        memory_bytes: it is killed where it and its children hold more [B].
    """
    with _orphans_adopted(), TemporaryFile() as stdout, TemporaryFile() as stderr:
        begin = monotonic()
        process = subprocess.Popen(
            command,
            cwd=directory,
            env=os.environ | environment,
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
        )
        bound = None
        while bound is None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(_PERIOD)
                break
            if monotonic() - begin > seconds:
                bound = Bound.TIME
            elif _memory(process.pid) > memory_bytes:
                bound = Bound.MEMORY
        taken = monotonic() - begin
        if bound is not None:
            process.kill()
        left = _end_children()
        process.wait(_TIME_TO_END)
        texts = [_last(file) for file in (stdout, stderr)]
    return Outcome(process.returncode, *texts, taken, bound, () if bound else left)


def _memory(pid: int) -> int:
    """Resident memory of a process and all below it [B]."""
    with suppress(psutil.Error):
        process = psutil.Process(pid)
        return sum(_resident(one) for one in (process, *process.children(recursive=True)))
    return 0


def _resident(process: psutil.Process) -> int:
    with suppress(psutil.Error):
        return int(process.memory_info().rss)
    return 0


def _end_children() -> tuple[str, ...]:
    """Kill what is still below this process after a while; the command lines of these."""
    _, running = psutil.wait_procs(psutil.Process().children(recursive=True), _TIME_TO_END)
    left = []
    for child in running:
        with suppress(psutil.Error):
            left.append(" ".join(child.cmdline())[:200])
            child.kill()
    psutil.wait_procs(running, timeout=_TIME_TO_END)
    return tuple(left)


def _last(file: object) -> str:
    size = file.seek(0, 2)  # type: ignore[attr-defined]
    file.seek(max(0, size - _LONGEST_OUTPUT))  # type: ignore[attr-defined]
    return file.read().decode("utf-8", "replace")  # type: ignore[attr-defined,no-any-return]
