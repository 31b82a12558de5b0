"""``slave-node serve`` in processes of their own: started, watched and ended, with their logs.

For whoever starts slaves on this host: a master, or an agent. A slave ends when its standard input
closes, so that it never outlives the process that started it.
"""

from __future__ import annotations

import os
import shlex
import subprocess
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Final

from protocol.bus.endpoints import Endpoints, Mode
from protocol.errors import (
    ConfigurationError,
    DeadlineError,
    DoublestepError,
    ModelError,
    SlaveCrashedError,
    SlaveLostError,
)
from protocol.host.new_files import open_new, open_old
from protocol.host.python_processes import out_of_reach, python_command, temporary_files_in
from protocol.wire.keys import SlaveKey

_END_TIME = 2.0
_KILL_TIME = 5.0
_TAIL_BYTES = 2**16
_TAIL_LINES = 20
_SHOWN_LINES = 5
_LINE_LENGTH = 500
_USAGE_EXIT_CODE: Final = 2
_ERROR = "slave-node: "


class SlaveProcess:
    """A slave that serves a model.

    Args:
        model: as for ``slave-node serve``.
        base: directory to which the model's path is relative.
        key: its address on the bus, where it will appear.
        connection: options of ``slave-node serve`` that lead it to the bus.
        load_timeout: its model may take to be loaded or reset [s].
        log: file for what it says.
        scratch: existing directory for its temporary files; the caller removes it.
        processor: the only one that it uses; None: any.
        goes_on: leave what is in the log.

    Raises:
        ConfigurationError: the process cannot be started.
    """

    def __init__(
        self,
        model: str,
        base: Path,
        key: SlaveKey,
        *,
        connection: Sequence[str],
        load_timeout: float,
        log: Path,
        scratch: Path,
        processor: int | None = None,
        goes_on: bool = False,
    ) -> None:
        command = python_command("-m", "slave_node", "serve")
        command += ["--base", str(base), "--name", key.name, "--instance", key.instance]
        command += [*connection, "--load-timeout", repr(load_timeout), "--stay-with-parent"]
        command += ["--log-file", str(log.absolute())]
        if processor is not None:
            command += ["--processor", str(processor)]
        command += ["--", model]  # which may begin with a dash
        self.key = key
        self.log = log
        try:
            if not goes_on:
                open_new(log).close()
            with open_old(log, to_append=True) as file:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=file,
                    stderr=subprocess.STDOUT,
                    env=_environment(scratch),
                    **out_of_reach(),  # who started it tells it
                )
        except OSError as error:
            raise ConfigurationError(
                f"cannot start {shlex.join(command)}: {error}", slave=key.name
            ) from error

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Negative for a signal; None while it runs."""
        return self._process.poll()

    def wait(self, timeout: float) -> int | None:
        """The exit code after giving a dying process ``timeout`` seconds."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout)
        return self.exit_code

    def last_lines(self) -> tuple[str, ...]:
        """Last lines that it said: at most 20, each cut to 500 characters, no empty ones."""
        with suppress(OSError), self.log.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - _TAIL_BYTES))
            text = file.read(_TAIL_BYTES).decode("utf-8", "replace")
            lines = (line.strip()[:_LINE_LENGTH] for line in text.splitlines())
            return tuple(deque((line for line in lines if line), maxlen=_TAIL_LINES))
        return ()

    def ask_to_end(self) -> None:
        """Close its standard input; it ends soon, unless it is just loading or computing."""
        if self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()


def end_all(processes: Iterable[SlaveProcess], *, at_once: bool = False) -> None:
    """End processes in a bounded time: ask, wait, kill. Idempotent."""
    processes = list(processes)
    for process in processes:
        process.ask_to_end()
        if at_once:
            process.kill()
    deadline = monotonic() + _END_TIME
    for process in processes:
        if process.wait(max(0.0, deadline - monotonic())) is None:
            process.kill()
            process.wait(_KILL_TIME)


def connection_options(mode: Mode, connect: Sequence[str], endpoints: Endpoints) -> list[str]:
    """The options of ``slave-node serve`` that lead a slave to the bus.

    Args:
        mode: peer or client.
        connect: addresses.
        endpoints: of who starts the slave, which is as safe.
    """
    words = ["--mode", str(mode)] if mode is not Mode.PEER else []
    words += [word for endpoint in connect for word in ("--connect", endpoint)]
    if endpoints.insecure:
        words.append("--insecure")
    if endpoints.credentials is not None:
        words += ["--tls", str(endpoints.credentials.directory)]
    return words


def end_error(name: str, exit_code: int, lines: Sequence[str], remedy: str) -> DoublestepError:
    """Why the process of slave ``name`` ended, from its exit code and last lines.

    Returns:
        A `ModelError` when its model cannot be used, a `SlaveCrashedError` when its model crashed
        while it was loaded, a `DeadlineError` when it took too long for that, else a
        `SlaveLostError`.
    """
    errors = [line for line in lines if line.startswith(_ERROR)]
    words = errors[-1:] or lines[-_SHOWN_LINES:]
    last = " | ".join(word.removeprefix(_ERROR) for word in words) or "nothing"
    if exit_code == _USAGE_EXIT_CODE:
        return ModelError(last, slave=name)
    if exit_code == SlaveCrashedError.exit_code:
        return SlaveCrashedError(last, slave=name, phase="load", remedy=remedy)
    if exit_code == DeadlineError.exit_code:
        return DeadlineError(last.removeprefix("load: "), slave=name, phase="load")
    how = describe_exit(exit_code)
    return SlaveLostError(f"its process {how}; its log ends: {last}", slave=name, remedy=remedy)


def describe_exit(exit_code: int) -> str:
    """End of a process, in a few words."""
    if exit_code < 0:
        return f"died by signal {-exit_code}"
    return f"ended with exit code {exit_code}"


def _environment(scratch: Path) -> dict[str, str]:
    return {
        **os.environ,
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        **temporary_files_in(scratch),
    }
