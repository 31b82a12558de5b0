"""Puts a run together: slaves, connections, observers and the algorithm."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from master_node.coupling.external import Signals
from master_node.coupling.step_sizes import check_step_sizes
from master_node.hosts.agent_models import Uploading
from master_node.hosts.model_hashes import check_hashes
from master_node.hosts.opening import Slaves, opened_slaves
from master_node.inputs.loading import load_signals
from master_node.observing.observers import Observer, Observers, Outcome
from master_node.preparing.examinations import as_plain_data
from master_node.preparing.readiness import make_ready
from master_node.results import (
    Recording,
    Result,
    ResultsWriter,
    SelectedResults,
    SelectionMemory,
    check_variables,
    exclusive,
    finish,
    is_complete,
)
from master_node.results.files import cannot_write
from master_node.results.trace import TraceWriter
from master_node.resuming.checkpoints import Checkpoints, ResultPosition, Resumed
from master_node.resuming.files import CheckpointStore
from master_node.resuming.saved_system import (
    RunMode,
    can_be_saved,
    check_models,
    programs,
    reopened,
    saved_system,
)
from master_node.running.co_simulation import CoSimulation
from master_node.running.session import Session
from master_node.slaves.restorable import RestorableSlave
from master_node.slaves.shared_process import SharedProcess, shared_process
from master_node.system.summary import settings_of
from master_node.system.system import System
from master_node.system.trust import check_own
from protocol.errors import InterruptedRunError
from protocol.host.new_files import own_folder
from protocol.text.names import some

log = logging.getLogger("master_node")


def simulate(
    system: System,
    *,
    output: Path | str | None = None,
    in_process: bool = False,
    launch: bool = True,
    observers: Sequence[Observer] = (),
    trace: Path | str | None = None,
    **simulation: Any,
) -> Result:
    """Run a system and give its result.

    Args:
        system: slaves, connections and settings.
        output: directory for the result files; None: none are written.
        in_process: run the slaves in this process, without a bus.
        launch: start slaves that have a model; False: find all of them on the bus.
        observers: are told of everything that happens.
        trace: file for a trace of all requests, see ``docs/observability.md``; None: none.
        **simulation: settings that override ``system.simulation``, such as ``stop_time=4.0``; None
            leaves one as it is.

    Raises:
        DoublestepError: see ``protocol/errors.py``; the result files hold what was accepted.
    """
    system = system.with_simulation(**simulation)
    recording = Recording(settings_of(system, {}))
    directory = None if output is None else Path(output)
    run(
        system,
        directory,
        in_process=in_process,
        launch=launch,
        observers=observers,
        recording=recording,
        trace=None if trace is None else Path(trace),
    )
    return recording.result()


def open_run(
    system: System,
    *,
    output: Path | str | None = None,
    in_process: bool = False,
    launch: bool = True,
    observers: Sequence[Observer] = (),
    trace: Path | str | None = None,
    **simulation: Any,
) -> Session:
    """Open a run that is stepped, asked, changed and branched from here, see docs/steering.md.

    Args and errors as for `simulate`. The session stands at T_0; its slaves end with it::

        with open_run(system, output="results") as run:
            run.until(1.0)
            run.set({"chassis.k": 2e4})
            run.until(4.0)
        result = run.result()
    """
    system = system.with_simulation(**simulation)
    recording = Recording(settings_of(system, {}))
    with ExitStack() as stack:
        co_simulation = stack.enter_context(
            _opened(
                system,
                None if output is None else Path(output).absolute(),
                RunMode(in_process, launch),
                observers,
                recording=recording,
                trace=None if trace is None else Path(trace).absolute(),
            )
        )
        run = stack.enter_context(co_simulation.opened())
        return Session(run, stack.pop_all(), recording.result)


def run(
    system: System,
    directory: Path | None,
    *,
    in_process: bool = False,
    launch: bool = True,
    observers: Sequence[Observer] = (),
    recording: Recording | None = None,
    uploading: Uploading | None = None,
    trace: Path | None = None,
) -> None:
    """Run a system; raises as `simulate`.

    Args:
        system: slaves, connections and settings.
        directory: where results are streamed to; None: nowhere.
        in_process: run the slaves in this process, without a bus.
        launch: start slaves that have a model; False: find all of them on the bus.
        observers: are told of everything that happens.
        recording: is told of the results that the system asks for, as the files are.
        uploading: told of models that are sent to agents.
        trace: file for a trace of all requests; None: none.
    """
    mode = RunMode(in_process, launch)
    _run(
        system,
        None if directory is None else directory.absolute(),
        mode,
        observers,
        recording=recording,
        uploading=uploading,
        trace=None if trace is None else trace.absolute(),
    )


def resume(
    directory: Path | str, *, observers: Sequence[Observer] = (), trust: bool = False
) -> None:
    """Go on with a run whose master was interrupted or killed, or that failed.

    Its results continue those in the directory, and end up the same, bit for bit, as if nothing
    had happened. One that was broken off before its first checkpoint begins anew. Of one that got
    to its end and no further what its results lack is made.

    Args:
        directory: with the results and the checkpoint of the run.
        observers: are told of everything that happens from there on.
        trust: run what the checkpoint names, whoever has written it.

    A run that is complete is left as it is, and that is said.

    Raises:
        ResultsError: there is nothing to go on with, a file cannot be read, or another run writes
            there.
        ConfigurationError: a model or a table is not the one with which the run began; or the
            checkpoint is not the user's own.
        DoublestepError: as `simulate`.
    """
    directory = Path(directory).absolute()
    store = CheckpointStore(directory)
    with exclusive(directory):
        if finish(directory):
            log.info("the run had got to its end: its results are complete now")
            store.remove()
            return
        if is_complete(directory):
            log.info("the run in %s is complete: there is nothing to go on with", directory)
            store.remove()  # its master may have been killed just then
            return
        saved, checkpoint = store.load()
        if checkpoint is None:
            log.info("the run was broken off before its first checkpoint: it begins anew")
            resumption = Resumption(saved, CheckpointStore(directory, saved), None)
        else:
            resumption = Resumption(saved, store, Resumed.of(checkpoint))
        if not trust:
            check_own((directory, *store.files))
        with reopened(saved) as (system, mode):
            log.info("the checkpoint names what is run: %s", some(programs(system)))
            _run(system, directory, mode, observers, resumption=resumption)


@dataclass(frozen=True)
class Resumption:
    """A run that goes on.

    Attributes:
        saved: what was run.
        store: of its checkpoints.
        resumed: where it goes on; None: at its start.
    """

    saved: Mapping[str, Any]
    store: CheckpointStore
    resumed: Resumed | None


def _run(
    system: System,
    directory: Path | None,
    mode: RunMode,
    observers: Sequence[Observer],
    *,
    recording: Recording | None = None,
    resumption: Resumption | None = None,
    uploading: Uploading | None = None,
    trace: Path | None = None,
) -> None:
    co_simulation: CoSimulation | None = None
    try:
        with _opened(
            system,
            directory,
            mode,
            observers,
            recording=recording,
            resumption=resumption,
            uploading=uploading,
            trace=trace,
        ) as co_simulation:
            co_simulation.run()
    except (KeyboardInterrupt, InterruptedRunError) as error:
        if co_simulation is None or not co_simulation.has_begun:
            step = "first" if resumption is None else "next"
            raise InterruptedRunError(f"interrupted before the {step} step") from None
        raise _interruption(error, co_simulation, directory) from None


def _interruption(
    error: BaseException, co_simulation: CoSimulation, directory: Path | None
) -> InterruptedRunError:
    """Error of a run that was interrupted behind its beginning, with what became of it."""
    end = co_simulation.end
    if end is not None and end.outcome.is_complete:
        if directory is None:
            return InterruptedRunError("interrupted behind the end of the run")
        if is_complete(directory):
            return InterruptedRunError(
                f"interrupted behind the end of the run; the results in {directory} are complete"
            )
    if isinstance(error, InterruptedRunError):
        return error
    remedy = co_simulation.checkpoints.remedy
    if end is not None and end.outcome is Outcome.FAILED:
        return InterruptedRunError(
            f"interrupted behind the end of the run, which had failed: {end.message}", remedy=remedy
        )
    return InterruptedRunError("interrupted while the results were completed", remedy=remedy)


@contextmanager
def _opened(
    system: System,
    directory: Path | None,
    mode: RunMode,
    observers: Sequence[Observer],
    *,
    recording: Recording | None = None,
    resumption: Resumption | None = None,
    uploading: Uploading | None = None,
    trace: Path | None = None,
) -> Iterator[CoSimulation]:
    """A run that is ready to begin; at the end its slaves end."""
    check_step_sizes(system)
    with ExitStack() as stack:
        baseline = stack.enter_context(shared_process())
        signals = SharedProcess(baseline).run(load_signals, system)
        if directory is not None:
            ResultsWriter(directory, settings_of(system, {})).prepare()
            if resumption is None:
                stack.enter_context(exclusive(directory))
        traces = [] if trace is None else [stack.enter_context(closing(TraceWriter(trace)))]
        slaves = stack.enter_context(
            opened_slaves(
                system,
                None if directory is None else _logs(directory, is_needed=not mode.in_process),
                in_process=mode.in_process,
                launch=mode.launch,
                uploading=uploading,
                baseline=baseline,
            )
        )
        yield _co_simulation(
            system, signals, directory, mode, observers, slaves, traces, recording, resumption
        )


def _co_simulation(  # noqa: PLR0917  what a run is made of
    system: System,
    signals: Signals,
    directory: Path | None,
    mode: RunMode,
    observers: Sequence[Observer],
    slaves: Slaves,
    traces: Sequence[TraceWriter],
    recording: Recording | None,
    resumption: Resumption | None,
) -> CoSimulation:
    """The run, ready to begin."""
    if resumption is not None:
        check_models(resumption.saved, slaves.descriptions)
    check_hashes(system, slaves.descriptions)
    restorable = _restorable(slaves, system, directory)
    links = {**slaves.links, **{slave.name: slave for slave in restorable}}
    ready = make_ready(links, system, slaves.descriptions, signals, traces)
    group, coupled, prepared = ready.group, ready.coupled, ready.prepared
    wanted = system.results
    recorded = (*coupled.recorded.continuous, *coupled.recorded.discrete)
    check_variables(
        wanted.variables,
        (*coupled.output_names, *coupled.discrete.names),
        system.source,
        [one.name for one in recorded],
    )
    resumed = None if resumption is None else resumption.resumed
    store = None
    if resumption is not None:
        store = resumption.store
    elif directory is not None and _writes_checkpoints(system):
        store = CheckpointStore(directory, saved_system(system, mode, slaves.descriptions))
    settings = settings_of(prepared.system, prepared.descriptions)
    settings["examinations"] = as_plain_data(prepared.examinations)
    keepers: list[Observer] = []
    if recording is not None:
        recording.set_settings(settings)
        keepers.append(recording)
    writer = None
    if directory is not None:
        rows = None if resumed is None else resumed.rows
        writer = ResultsWriter(directory, settings, rows, can_resume=store is not None)
        keepers.append(writer)
    selection = SelectionMemory() if resumed is None else resumed.files.selection
    selected = SelectedResults(Observers(keepers), wanted.variables, wanted.every, selection)
    observer = Observers([*observers, *traces, selected])
    checkpoints = Checkpoints(
        restorable,
        store,
        system.simulation.checkpoint_interval,
        _Kept(selected, writer, recording),
        0 if resumed is None else resumed.checkpoint.number,
    )
    return CoSimulation(
        group, coupled, prepared.system, observer, prepared.outputs, checkpoints, resumed
    )


def _writes_checkpoints(system: System) -> bool:
    return bool(system.simulation.checkpoint_interval) and can_be_saved(system)


@dataclass(frozen=True)
class _Kept:
    """Implements `ResultFiles`, with what is kept in memory."""

    selected: SelectedResults
    writer: ResultsWriter | None
    recording: Recording | None

    def position(self) -> ResultPosition:
        """See `ResultFiles`."""
        counting = self.recording if self.writer is None else self.writer
        rows = (0, 0) if counting is None else counting.rows
        return ResultPosition(*rows, self.selected.memory)

    def flush(self) -> None:
        """See `ResultFiles`."""
        if self.writer is not None:
            self.writer.synchronize()

    def cut(self, position: ResultPosition) -> None:
        """See `ResultFiles`."""
        self.selected.memory = position.selection
        for keeper in (self.writer, self.recording):
            if keeper is not None:
                keeper.cut(position.points, position.attempts)


def _restorable(slaves: Slaves, system: System, directory: Path | None) -> list[RestorableSlave]:
    """The slaves in front of which calls are noted: all or none."""
    restarts = slaves.restarts
    if restarts is not None:
        return [
            RestorableSlave(
                name,
                link,
                slaves.descriptions[name],
                partial(restarts.restart, name),
                partial(restarts.give_up, name),
            )
            for name, link in slaves.links.items()
        ]
    if directory is None or not _writes_checkpoints(system):
        return []
    return [
        RestorableSlave(name, link, slaves.descriptions[name], None)
        for name, link in slaves.links.items()
    ]


def _logs(directory: Path, *, is_needed: bool) -> Path:
    """Folder of logs, made if it is needed from the start."""
    folder = directory / "logs"
    try:
        return own_folder(folder) if is_needed else folder
    except OSError as error:
        raise cannot_write(folder, error) from error
