"""Starts slave processes on this host, watches them, and ends them. Each has a log file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, Self

from protocol.errors import DoublestepError
from protocol.host.scratch import ScratchDirectory
from protocol.slave_processes import SlaveProcess, describe_exit, end_all, end_error
from protocol.wire.keys import SlaveKey


class Starter(Protocol):
    """Launcher of slaves for a run, which can say what became of their processes."""

    def check(self) -> None:
        """Raise for the first slave process that has ended.

        Raises:
            ModelError: it ended because its model cannot be used.
            SlaveCrashedError: its model crashed while it was loaded.
            SlaveLostError: it ended for any other reason.
        """
        ...

    def ended(self, name: str) -> DoublestepError | None:
        """Why the process of slave ``name`` ended; None while it runs or when it is not ours."""
        ...

    def how_ended(self, name: str) -> str:
        """End of a process in a few words; "" while it runs or when it is not ours."""
        ...

    def wait_ended(self, name: str, timeout: float) -> DoublestepError | None:
        """The error after giving a dying process ``timeout`` seconds."""
        ...

    def stop(self, *, at_once: bool = False) -> None:
        """End all in a bounded time. Idempotent."""
        ...


class Launcher:
    """The slave processes of one run on this host; implements `Starter`.

    A slave ends when its standard input closes: a launched process never outlives this one.

    Args:
        run: its id.
        connection: options of ``slave-node serve`` that lead the slaves to the bus.
        log_directory: existing; gets ``NAME.log`` of each slave.
        load_timeout: a model may take to be loaded or reset [s].
        pin: give each slave one processor of its own, in turn, where the platform can.
    """

    def __init__(
        self,
        run: str,
        connection: Sequence[str],
        log_directory: Path,
        *,
        load_timeout: float,
        pin: bool = False,
    ) -> None:
        self._run = run
        self._connection = connection
        self._processors = _processors() if pin else []
        self._log_directory = log_directory
        self._load_timeout = load_timeout
        self._processes: dict[str, SlaveProcess] = {}
        # What a slave that is killed leaves behind goes with it.
        self._scratch = ScratchDirectory()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End all, at once after Ctrl-C: a slave that is still loading would not hear it."""
        self.stop(at_once=kind is not None and issubclass(kind, KeyboardInterrupt))

    def launch(self, name: str, model: str, base: Path) -> SlaveKey:
        """Start a slave, in place of the one of that name; its address, where it will appear.

        Raises:
            ConfigurationError: the process cannot be started.
        """
        key = SlaveKey.of_run(name, self._run)
        before = self._processes.get(name)
        if before is not None:
            end_all([before], at_once=True)
        processor = None
        if self._processors:
            processor = self._processors[len(self._processes) % len(self._processors)]
        self._processes[name] = SlaveProcess(
            model,
            base,
            key,
            connection=self._connection,
            load_timeout=self._load_timeout,
            log=self._log_directory / f"{name}.log",
            scratch=self._scratch.path,
            processor=processor,
            goes_on=before is not None,
        )
        return key

    def check(self) -> None:
        """See `Starter`."""
        for name in self._processes:
            error = self.ended(name)
            if error is not None:
                raise error

    def ended(self, name: str) -> DoublestepError | None:
        """See `Starter`."""
        process = self._processes.get(name)
        code = process.exit_code if process else None
        if process is None or code is None:
            return None
        return end_error(name, code, process.last_lines(), f"see {process.log}")

    def how_ended(self, name: str) -> str:
        """See `Starter`."""
        process = self._processes.get(name)
        code = process.exit_code if process else None
        return "" if code is None else f"its process {describe_exit(code)}"

    def wait_ended(self, name: str, timeout: float) -> DoublestepError | None:
        """See `Starter`."""
        process = self._processes.get(name)
        if process is not None:
            process.wait(timeout)
        return self.ended(name)

    def stop(self, *, at_once: bool = False) -> None:
        """See `Starter`: ask, wait, kill."""
        end_all(self._processes.values(), at_once=at_once)
        self._scratch.close()


def _processors() -> list[int]:
    """The processors that this process may use; none where the platform does not tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
