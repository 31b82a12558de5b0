"""Starts slave processes on this host, watches them, and ends them. Each has a log file."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from secrets import token_hex
from time import monotonic
from typing import Self

from protocol.errors import ConfigurationError, DoublestepError, ModelError, SlaveLostError
from protocol.keys import SlaveKey

_END_TIME = 2.0
_KILL_TIME = 5.0
_TAIL_LINES = 5
_USAGE_EXIT_CODE = 2


class Launcher:
    """The slave processes of one run.

    A slave ends when its standard input closes: a launched process never outlives this one.

    Args:
        connection: options of ``slave-node serve`` that lead the slaves to the bus.
        log_directory: existing; gets ``NAME.log`` of each slave.
        pin: give each slave one processor of its own, in turn, where the platform can.
    """

    def __init__(
        self, connection: Sequence[str], log_directory: Path, *, pin: bool = False
    ) -> None:
        self._connection = connection
        self._processors = _processors() if pin else []
        self._log_directory = log_directory
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        # What a slave that is killed leaves behind goes with it.
        self._scratch = tempfile.TemporaryDirectory(
            prefix="doublestep-", ignore_cleanup_errors=True
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End all, at once after Ctrl-C: a slave that is still loading would not hear it."""
        self.stop(at_once=kind is not None and issubclass(kind, KeyboardInterrupt))

    def launch(self, name: str, model: str, base: Path) -> SlaveKey:
        """Start a slave; its address on the bus, where it will appear.

        Raises:
            ConfigurationError: the process cannot be started.
        """
        key = SlaveKey(name, token_hex(4))
        command = [sys.executable, "-m", "slave_node", "serve", model]
        options = {
            "--base": str(base),
            "--name": name,
            "--instance": key.instance,
        }
        command += [word for option in options.items() for word in option]
        command += [*self._connection, "--stay-with-parent"]
        if self._processors:
            processor = self._processors[len(self._processes) % len(self._processors)]
            command += ["--processor", str(processor)]
        try:
            with self._log(name).open("wb") as log:
                self._processes[name] = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # Ctrl-C is for the master, who tells the slaves
                    env=_environment(self._scratch.name),
                )
        except OSError as error:
            raise ConfigurationError(
                f"cannot start {shlex.join(command)}: {error}", slave=name
            ) from error
        return key

    def check(self) -> None:
        """Raise for the first slave process that has ended.

        Raises:
            ModelError: it ended because its model cannot be used.
            SlaveLostError: it ended for any other reason.
        """
        for name in self._processes:
            error = self.ended(name)
            if error is not None:
                raise error

    def ended(self, name: str) -> DoublestepError | None:
        """Why the process of slave ``name`` ended; None while it runs or when it is not ours."""
        process = self._processes.get(name)
        code = process.poll() if process else None
        if code is None:
            return None
        last = self._last_words(name)
        if code == _USAGE_EXIT_CODE:
            return ModelError(last, slave=name)
        how = f"died by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return SlaveLostError(
            f"its process {how}; its log ends: {last}",
            slave=name,
            remedy=f"see {self._log(name)}",
        )

    def wait_ended(self, name: str, timeout: float) -> DoublestepError | None:
        """The same after giving a dying process ``timeout`` seconds."""
        process = self._processes.get(name)
        if process is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout)
        return self.ended(name)

    def stop(self, *, at_once: bool = False) -> None:
        """End all: ask, wait, kill. Idempotent."""
        for process in self._processes.values():
            if process.stdin is not None:
                with suppress(OSError):
                    process.stdin.close()
            if at_once and process.poll() is None:
                process.kill()
        deadline = monotonic() + _END_TIME
        for process in self._processes.values():
            try:
                process.wait(max(0.0, deadline - monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(_KILL_TIME)
        self._scratch.cleanup()

    def _log(self, name: str) -> Path:
        return self._log_directory / f"{name}.log"

    def _last_words(self, name: str) -> str:
        with suppress(OSError):
            text = self._log(name).read_text(encoding="utf-8", errors="replace")
            lines = [line.strip() for line in text.splitlines() if line.strip()]
            errors = [line for line in lines if line.startswith("slave-node: ")]
            words = errors[-1:] or lines[-_TAIL_LINES:]
            return " | ".join(word.removeprefix("slave-node: ") for word in words) or "nothing"
        return "nothing"


def _processors() -> list[int]:
    """The processors that this process may use; none where the platform does not tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def _environment(scratch: str) -> dict[str, str]:
    return {
        **os.environ,
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "TMPDIR": scratch,
    }
