"""One run of a study: ``master-node run`` in a process of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from secrets import token_hex
from time import monotonic

from master_node.study.case import Case, write_case
from master_node.study.directory import put_in_place
from master_node.study.records import CASE_FILE, LOG_FILE, RunRecord, write_record
from protocol.errors import DeadlineError, ResultsError
from protocol.host.python_processes import out_of_reach, python_command, temporary_files_in
from protocol.host.scratch import ScratchDirectory

END_TIME = 0.2
"""Time in which an interrupted run has to end by itself [s]; nothing that it wrote is kept."""

_LATE_TIME = 2.0
_KILL_TIME = 5.0
_PREFIX = "master-node: "
_MESSAGE_LENGTH = 2000


@dataclass(frozen=True)
class RunTask:
    """All that a process needs to know of a run; plain data, the same on every host.

    Attributes:
        number: of the run.
        system_file: absolute.
        directory: where the run belongs when it has ended, absolute.
        case: its parameters.
        fingerprint: see `PlannedRun`.
        in_process, plot, timeout: see ``RunSettings``.
    """

    number: int
    system_file: str
    directory: str
    case: Case
    fingerprint: str
    in_process: bool
    plot: bool
    timeout: float


class RunProcess:
    """A run under way. It ends with the process that started it, whatever ends that.

    Args:
        task: what to run.

    Raises:
        ResultsError: its directory cannot be written, or the process cannot be started.
    """

    def __init__(self, task: RunTask) -> None:
        self.task = task
        self._directory = Path(task.directory)
        self._part = self._directory.with_name(f"{self._directory.name}.part-{token_hex(4)}")
        self._begin = monotonic()
        self._is_late = False
        try:
            # What a run that is killed leaves behind goes with it.
            self._scratch = ScratchDirectory()
            self._part.mkdir(parents=True)
            write_case(self._part / CASE_FILE, task.case)
            with (self._part / LOG_FILE).open("wb") as log:
                self._process = subprocess.Popen(
                    self._command(),
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env=_environment(self._scratch.path),
                    **out_of_reach(),  # the sweep ends its runs
                )
        except OSError as error:
            raise ResultsError(f"cannot start run {task.number}: {error}") from error

    def _command(self) -> list[str]:
        words = python_command("-m", "master_node", "run", self.task.system_file)
        words += ["--case", str(self._part / CASE_FILE), "--output", str(self._part)]
        words += ["--quiet", "--stay-with-parent"]
        words += ["--in-process"] if self.task.in_process else []
        words += [] if self.task.plot else ["--no-plot"]
        return words

    def poll(self) -> RunRecord | None:
        """Record of the run, which is in its place then; None while it goes on.

        Raises:
            ResultsError: its directory cannot be written.
        """
        if self._process.poll() is None:
            if not self._is_late and monotonic() - self._begin > self.task.timeout:
                self._is_late = True
                self.interrupt()
                self.finish(monotonic() + _LATE_TIME)
            else:
                return None
        self.interrupt()  # it has ended: its standard input is of no more use
        record = self._record(self._process.returncode)
        self._scratch.close()
        try:
            write_record(self._part, record)
            put_in_place(self._part, self._directory)
        except OSError as error:
            raise ResultsError(f"cannot write {self._directory}: {error}") from error
        return record

    def interrupt(self) -> None:
        """Let the run end: its standard input closes. Returns at once."""
        if self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def finish(self, deadline: float | None = None) -> None:
        """Wait for the end of an interrupted run, to ``deadline`` [s] of the clock, then kill it.

        Its slaves end as their standard input closes.
        """
        deadline = monotonic() + END_TIME if deadline is None else deadline
        try:
            self._process.wait(max(0.0, deadline - monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(_KILL_TIME)

    def remove(self) -> None:
        """Take away what an interrupted run has written."""
        self._scratch.close()
        shutil.rmtree(self._part, ignore_errors=True)

    def _record(self, exit_code: int) -> RunRecord:
        wall_time = monotonic() - self._begin
        if self._is_late:
            late = f"the run did not end within {self.task.timeout:g} s"
            return RunRecord(
                self.task.fingerprint, "failed", DeadlineError.exit_code, late, wall_time
            )
        if exit_code == 0:
            return RunRecord(self.task.fingerprint, "completed", 0, "", wall_time)
        message = self._last_words()
        if exit_code < 0:
            message = f"ended by signal {-exit_code}" + (f": {message}" if message else "")
        return RunRecord(self.task.fingerprint, "failed", exit_code, message, wall_time)

    def _last_words(self) -> str:
        with suppress(OSError):
            text = (self._part / LOG_FILE).read_text(encoding="utf-8", errors="replace").strip()
            _, prefix, words = f"\n{text}".rpartition(f"\n{_PREFIX}")
            return (words if prefix else text.rpartition("\n")[2])[-_MESSAGE_LENGTH:]
        return ""


def _environment(scratch: Path) -> dict[str, str]:
    """Runs beside each other are what uses the processors: no threads of NumPy within one."""
    quiet = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    return {**quiet, **os.environ, **temporary_files_in(scratch)}
