"""Runs on a Dask cluster that there is already. The only file that knows `distributed`.

The workers need Doublestep in the same version and see the directories of the study and of the
system under the same paths. A run is a process that a worker starts, as on one host. Dask hands
tasks on by pickle: whoever reaches the scheduler can run any code on the workers.
"""

from __future__ import annotations

import time
from collections import Counter
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from time import monotonic
from types import TracebackType

from distributed import Client, Future, wait

from master_node.study.directory import StudyDirectory, is_wanted
from master_node.study.records import RunRecord
from master_node.study.run_process import END_TIME, RunProcess, RunTask
from master_node.study.runner import Runner
from protocol.errors import ConfigurationError, DoublestepError, SlaveLostError

_CONNECTION_TIME = 10.0
_WORKER_TIME = 30.0
_POLL_TIME = 0.05
_WANTED_TIME = 0.2
_MOST_UNDER_WAY = 1000


class DaskRunner(Runner):
    """Runs as tasks of a cluster.

    A licence is a resource of that name: a worker has as many as it was started with, as by
    ``dask worker --resources dymola=2``, and no more runs are handed out than the study has
    licences for.

    Args:
        address: of the scheduler, such as ``tcp://10.0.0.1:8786``.
        directory: of the study, held.
        needs: the licences that a run holds.
        licence_limit: how many runs at a time have their licences; None: no limit.

    Raises:
        ConfigurationError: there is no scheduler, no worker, or none with the licences.
    """

    def __init__(
        self,
        address: str,
        directory: StudyDirectory,
        needs: tuple[str, ...],
        licence_limit: int | None,
    ) -> None:
        self._address = address
        self._directory = directory
        self._needs = {name: float(number) for name, number in Counter(needs).items()}
        self._places = min(_MOST_UNDER_WAY, licence_limit or _MOST_UNDER_WAY)
        self._under_way: dict[Future, RunTask] = {}
        try:
            self._client = Client(address, timeout=_CONNECTION_TIME, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ConfigurationError(
                f"no Dask scheduler at {address}: {error}",
                remedy="check --dask, or start one with `dask scheduler`",
            ) from error
        try:
            self._check_workers()
        except BaseException:
            self._client.close(_CONNECTION_TIME)
            raise

    def _check_workers(self) -> None:
        try:
            self._client.wait_for_workers(1, timeout=_WORKER_TIME)
        except TimeoutError as error:
            raise ConfigurationError(
                f"the Dask scheduler at {self._address} has no worker",
                remedy=f"start one with `dask worker {self._address}`",
            ) from error
        workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        if not any(
            all(worker["resources"].get(name, 0.0) >= n for name, n in self._needs.items())
            for worker in workers
        ):
            resources = " ".join(f"{name}={n:g}" for name, n in self._needs.items())
            raise ConfigurationError(
                f"no worker at {self._address} has the licences that a run needs: {resources}",
                remedy=f"start workers with `dask worker --resources '{resources}'`",
            )

    @property
    def has_room(self) -> bool:
        """See `Runner`."""
        return len(self._under_way) < self._places

    def start(self, task: RunTask) -> None:
        """See `Runner`."""
        future = self._client.submit(
            execute,
            task,
            str(self._directory.path),
            self._directory.token,
            version("doublestep"),
            key=f"doublestep-{self._directory.token}-{task.number}",
            resources=self._needs or None,
            pure=False,
        )
        self._under_way[future] = task

    def ended(self) -> list[tuple[RunTask, RunRecord]]:
        """See `Runner`."""
        found = []
        if self._client.status not in ("running", "connecting"):
            raise self._lost()
        for future in [future for future in self._under_way if future.done()]:
            task = self._under_way[future]
            found.append((task, self._record(future, task)))
            del self._under_way[future]
        return found

    def _record(self, future: Future, task: RunTask) -> RunRecord:
        if future.cancelled() or future.status == "lost":
            raise self._lost()
        error = future.exception()
        if error is None:
            record = future.result()
            assert isinstance(record, RunRecord)
            return record
        if isinstance(error, DoublestepError):
            raise error
        raise ConfigurationError(
            f"run {task.number} cannot be executed on the cluster: {type(error).__name__}: {error}",
            remedy="the workers need Doublestep, in the same version as here",
        )

    def _lost(self) -> SlaveLostError:
        return SlaveLostError(
            f"the Dask scheduler at {self._address} is gone",
            remedy="give the command again to go on where it ended",
        )

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, _: TracebackType | None
    ) -> None:
        """See `Runner`."""
        self._directory.release_runs()
        with suppress(Exception):  # the cluster may be gone: nothing is left to be done there
            queued = [future for future in self._under_way if not future.done()]
            if queued:
                self._client.cancel(queued, asynchronous=False, force=True)
                wait(queued, timeout=END_TIME)
        self._under_way = {}
        with suppress(Exception):
            self._client.close(END_TIME)


def execute(task: RunTask, study: str, token: str, doublestep: str) -> RunRecord:
    """Execute a run on the host of a worker, to its end or as long as its sweep wants it.

    Args:
        task: the run.
        study: directory of the study, the same on all hosts.
        token: of the sweep that wants it.
        doublestep: the version of the sweep.

    Raises:
        ConfigurationError: this host does not see the study, or has another version.
        ResultsError: as `RunProcess`.
        SlaveLostError: the sweep is gone.
    """
    here = version("doublestep")
    if here != doublestep:
        raise ConfigurationError(f"a worker has Doublestep {here}, the sweep {doublestep}")
    if not Path(study).is_dir():
        raise ConfigurationError(
            f"a worker does not see the directory of the study, {study}",
            remedy="put it where all hosts have it under the same path",
        )
    gone = SlaveLostError("the sweep that wanted this run is gone")
    if not is_wanted(Path(study), token):
        raise gone
    process = RunProcess(task)
    next_look = monotonic() + _WANTED_TIME
    try:
        while True:
            record = process.poll()
            if record is not None:
                return record
            if monotonic() >= next_look:
                next_look = monotonic() + _WANTED_TIME
                if not is_wanted(Path(study), token):
                    raise gone
            time.sleep(_POLL_TIME)
    except BaseException:
        process.interrupt()
        process.finish()
        process.remove()
        raise
