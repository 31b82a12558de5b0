"""Runners of the runs of a study: `LocalRunner` here, `DaskRunner` in ``dask_runner.py``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from time import monotonic
from types import TracebackType
from typing import Self

from master_node.study.records import RunRecord
from master_node.study.run_process import END_TIME, RunProcess, RunTask


class Runner(ABC):
    """Executes runs, several at a time. As a context manager it ends all at its end.

    ``with`` takes at most a second to end what is under way; what did not end by itself then can
    be run again.
    """

    @property
    @abstractmethod
    def has_room(self) -> bool:
        """True if one more run can be started now."""

    @abstractmethod
    def start(self, task: RunTask) -> None:
        """Start a run, when there `has_room`.

        Raises:
            ResultsError: its directory cannot be written.
            SlaveLostError: those who would execute it are gone.
        """

    @abstractmethod
    def ended(self) -> list[tuple[RunTask, RunRecord]]:
        """The runs that have ended since this was asked last. Returns at once; raises as `start`.

        Raises:
            ConfigurationError: a host cannot execute runs.
        """

    def __enter__(self) -> Self:
        return self

    @abstractmethod
    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, _: TracebackType | None
    ) -> None:
        """End all that is under way."""


class LocalRunner(Runner):
    """Runs as processes on this host.

    Args:
        workers: how many at a time.
        licence_limit: how many at a time have their licences; None: no limit.
    """

    def __init__(self, workers: int, licence_limit: int | None) -> None:
        self._places = workers if licence_limit is None else min(workers, licence_limit)
        self._running: list[RunProcess] = []

    @property
    def has_room(self) -> bool:
        """See `Runner`."""
        return len(self._running) < self._places

    def start(self, task: RunTask) -> None:
        """See `Runner`."""
        self._running.append(RunProcess(task))

    def ended(self) -> list[tuple[RunTask, RunRecord]]:
        """See `Runner`."""
        found = []
        for process in list(self._running):
            record = process.poll()
            if record is not None:
                self._running.remove(process)
                found.append((process.task, record))
        return found

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, _: TracebackType | None
    ) -> None:
        """See `Runner`."""
        for process in self._running:
            process.interrupt()
        deadline = monotonic() + END_TIME
        for process in self._running:
            process.finish(deadline)
        for process in self._running:
            process.remove()
        self._running = []
