"""The agent: starts slaves on this host for masters, and tells what became of them.

It chooses what may be loaded: files of a directory, named by the master without any path, and
models that were sent if that is allowed. Knows no transport: it takes a `Bus`.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from shutil import rmtree
from typing import TypeVar

from protocol.bus.bus import Bus
from protocol.bus.room import Room
from protocol.errors import (
    ConfigurationError,
    DoublestepError,
    ModelError,
    SlaveBusyError,
    SlaveLostError,
)
from protocol.host.clock import SYSTEM_CLOCK
from protocol.host.processes import PeerProcess
from protocol.slave_processes import SlaveProcess, end_all
from protocol.text.references import split_reference
from protocol.wire.agents import (
    AGENT_MESSAGE_BYTES,
    LICENCE,
    AgentSlave,
    AgentStatus,
    Done,
    Licence,
    ModelList,
    OutputRequest,
    Record,
    SlaveOutput,
    SlaveStarted,
    StartSlave,
    StopRun,
    Upload,
    UploadState,
    is_sha256,
    lacking,
)
from protocol.wire.keys import (
    MODELS,
    OUTPUT,
    START,
    STOP,
    UPLOAD,
    AgentKey,
    SlaveKey,
    alive_agents,
)
from protocol.wire.records import decode_record, encode_error_map, encode_record
from slave_node.agent.model_store import ModelStore
from slave_node.agent.upload_cache import MAX_PARTS, UploadCache
from slave_node.serving.master_watch import Master, MasterWatch
from slave_node.shutdown import wait_for_end

log = logging.getLogger("slave_node")

_PEER_TIME = 1.0
_MAX_SLAVES = 256
_INSTALLED_MODEL = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*")
_CLASS = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(frozen=True)
class Offer:
    """Offer of an agent to masters.

    Attributes:
        labels: what it says of its host.
        licences: how many slaves may hold each of them at once.
        store: models that are there.
        cache: for models that masters send; None: they may not.
        python: start Python models.
    """

    labels: Mapping[str, str]
    licences: Mapping[str, int]
    store: ModelStore
    cache: UploadCache | None = None
    python: bool = False


@dataclass(frozen=True)
class Surroundings:
    """Where the slaves of an agent live.

    Attributes:
        connection: options of ``slave-node serve`` that lead them to the bus.
        scratch: existing directory for temporary files.
        logs: existing directory for what they say; None: kept only until their run has ended.
    """

    connection: Sequence[str]
    scratch: Path
    logs: Path | None = None


@dataclass
class _Run:
    """Slaves that were started for a run."""

    slaves: dict[str, tuple[StartSlave, SlaveProcess]] = field(default_factory=dict)
    ending: bool = False


_R = TypeVar("_R", bound=Record)


class Agent:
    """One agent on the bus.

    Args:
        bus: opened; the caller closes it.
        key: name and instance.
        offer: what it has.
        surroundings: where the slaves live.
    """

    def __init__(self, bus: Bus, key: AgentKey, offer: Offer, surroundings: Surroundings) -> None:
        self._bus = bus
        self._key = key
        self._offer = offer
        self._surroundings = surroundings
        self._runs: dict[str, _Run] = {}
        self._masters = MasterWatch(bus, SYSTEM_CLOCK, self._end_orphans)
        self._lock = threading.RLock()
        self._closed = False
        self._since = time.time()

    def serve(self, ending: threading.Event) -> None:
        """Serve until ``ending`` is set; then all slaves are ended.

        Raises:
            ConfigurationError: an agent of this name is on the bus already, or the models cannot
                be read.
        """
        others = self._bus.alive(alive_agents(self._key.name), _PEER_TIME)
        if others:
            raise ConfigurationError(
                f"an agent named {self._key.name!r} is on the bus already: {', '.join(others)}",
                remedy="end it, or give this one another --name",
            )
        models = self._offer.store.models()
        self._bus.serve(self._key.status, lambda _: encode_record(self.status()))
        self._serve(MODELS, lambda _: self.models())
        self._serve_record(UPLOAD, Upload, self.upload, Room(MAX_PARTS * AGENT_MESSAGE_BYTES))
        self._serve_record(START, StartSlave, self.start)
        self._serve_record(STOP, StopRun, self.stop)
        self._serve_record(OUTPUT, OutputRequest, self.output)
        self._masters.start()
        self._bus.announce(self._key.alive)
        log.info("ready: agent with %d models, instance %s", len(models), self._key.instance)
        try:
            wait_for_end(ending)
        finally:
            self.close()

    def close(self) -> None:
        """End all slaves and start no more."""
        with self._lock:
            self._closed = True
            processes = [p for run in self._runs.values() for _, p in run.slaves.values()]
        end_all(processes)
        if self._offer.cache is not None:
            self._offer.cache.close()

    def _serve(
        self, verb: str, handle: Callable[[bytes], Record], room: Room | None = None
    ) -> None:
        def answer(data: bytes) -> bytes:
            try:
                return encode_record(handle(data))
            except DoublestepError as error:
                log.warning("%s refused: %s", verb, error)
                return encode_error_map(error)

        self._bus.serve(self._key.verb(verb), answer, room)

    def _serve_record(
        self,
        verb: str,
        cls: type[_R],
        handle: Callable[[_R], Record],
        room: Room | None = None,
    ) -> None:
        self._serve(verb, lambda data: handle(decode_record(cls, data)), room)

    def status(self) -> AgentStatus:
        """Status of the agent."""
        offer = self._offer
        with self._lock:
            running = self._running()
            licences = self._licences()
        try:
            count = offer.store.count() + (len(offer.cache.models()) if offer.cache else 0)
        except ConfigurationError as error:
            log.warning("%s", error)
            count = 0
        return AgentStatus(
            name=self._key.name,
            instance=self._key.instance,
            host=socket.gethostname(),
            pid=os.getpid(),
            labels=offer.labels,
            licences=licences,
            models=count,
            upload_limit=0 if offer.cache is None else offer.cache.largest,
            python=offer.python,
            slaves=tuple(
                AgentSlave(p.key.name, p.key.instance, p.pid, r.run, r.model) for r, p in running
            ),
            since=self._since,
            time=time.time(),
        )

    def models(self) -> ModelList:
        """All that can be started by hash or name; raises as `ModelStore.models`."""
        cache = self._offer.cache
        uploaded = () if cache is None else cache.models()
        return ModelList((*self._offer.store.models(), *uploaded))

    def upload(self, piece: Upload) -> UploadState:
        """Take a piece of a model.

        Raises:
            ConfigurationError: this agent takes no models, or as `UploadCache.receive`.
            ProtocolError, ModelError, SlaveBusyError: as `UploadCache.receive`.
        """
        cache = self._offer.cache
        if cache is None:
            raise ConfigurationError(
                "models may not be sent",
                remedy="copy the model into its --models directory, or start the agent with "
                "--allow-upload",
            )
        with self._lock:
            in_use = {r.model for r, _ in self._running() if is_sha256(r.model)}
        return cache.receive(piece, in_use)

    def start(self, request: StartSlave) -> SlaveStarted:
        """Start a slave; the same request again gets the same answer.

        One with a larger number of restarts takes the place of what was started before.

        Raises:
            ConfigurationError: a label is missing, or the process cannot be started.
            ModelError: there is no such model, or it may not be started.
            SlaveBusyError: the licence is taken; or the run has a slave of this name.
        """
        with self._lock:
            process = self._known(request)
        if process is None:
            base, model = self._model(request.model)  # may read large files: others are answered
            with self._lock:
                process = self._known(request) or self._start(request, base, model)
        return SlaveStarted(process.key.instance, process.pid)

    def _known(self, request: StartSlave) -> SlaveProcess | None:
        """Slave that was started at this very request."""
        run = self._runs.get(request.run)
        started = run.slaves.get(request.slave) if run else None
        return started[1] if started is not None and started[0] == request else None

    def _start(self, request: StartSlave, base: Path, model: str) -> SlaveProcess:
        """Start a slave, in place of the one before if it is to be started again."""
        run = self._runs.get(request.run) or _Run()
        before = run.slaves.get(request.slave)
        is_other = before is not None and before[0].restart >= request.restart
        if run.ending or is_other:
            raise SlaveBusyError(f"run {request.run} has ended, or has another such slave")
        if before is not None:
            end_all([before[1]], at_once=True)
            self._forget(before[1])
        self._check(request)
        process = self._process(model, base, request)
        run.slaves[request.slave] = request, process
        self._runs[request.run] = run
        log.info(
            "started %s with %s for run %s",
            request.slave,
            request.model,
            request.run,
            extra={"run": request.run, "slave": request.slave},
        )
        process_of_master = PeerProcess(request.host, request.pid)
        self._masters.follow(
            request.run, Master(request.run, process_of_master, request.orphan_time)
        )
        return process

    def stop(self, request: StopRun) -> Done:
        """End all slaves of a run, in a bounded time."""
        self._end(request.run)
        return Done()

    def output(self, request: OutputRequest) -> SlaveOutput:
        """Output and exit code of a slave.

        Raises:
            SlaveLostError: no such slave was started, or its run has ended.
        """
        with self._lock:
            run = self._runs.get(request.run)
            started = run.slaves.get(request.slave) if run else None
        if started is None:
            raise SlaveLostError(f"run {request.run} has no slave {request.slave!r} here")
        process = started[1]
        kept = "" if self._surroundings.logs is None else str(process.log)
        return SlaveOutput(process.exit_code, process.last_lines(), kept)

    def _check(self, request: StartSlave) -> None:
        """True if there is what it asks for, now."""
        if self._closed:
            raise SlaveLostError("the agent is ending")
        offer = self._offer
        for name, value in lacking(request.requires, offer.labels, offer.licences).items():
            raise ConfigurationError(
                f"it has no {name} = {value}",
                remedy=f"start the agent with --label {name}={value}",
            )
        wanted = request.requires.get(LICENCE)
        for licence in self._licences():
            if licence.name == wanted and not licence.free:
                raise SlaveBusyError(
                    f"all {licence.total} licences {licence.name} are taken: "
                    + ", ".join(licence.holders),
                    remedy="wait for these to end",
                )
        if sum(len(run.slaves) for run in self._runs.values()) >= _MAX_SLAVES:
            raise SlaveBusyError(f"it has {_MAX_SLAVES} slaves already")

    def _running(self) -> list[tuple[StartSlave, SlaveProcess]]:
        return [
            started
            for run in self._runs.values()
            for started in run.slaves.values()
            if started[1].exit_code is None
        ]

    def _licences(self) -> tuple[Licence, ...]:
        """A process that has ended holds nothing any more."""
        holders: dict[str, list[str]] = {name: [] for name in self._offer.licences}
        for request, _ in self._running():
            wanted = request.requires.get(LICENCE, "")
            if wanted in holders:
                holders[wanted].append(
                    f"{request.slave} of run {request.run} on {request.host} (pid {request.pid})"
                )
        return tuple(
            Licence(name, total, tuple(holders[name]))
            for name, total in self._offer.licences.items()
        )

    def _model(self, model: str) -> tuple[Path, str]:
        """Directory and name of a model that may be started."""
        if split_reference(model) is not None:
            return self._python_model(model)
        store, cache = self._offer.store, self._offer.cache
        if is_sha256(model):
            name = store.name_of(model)
            if name is not None:
                return store.directory, name
            path = None if cache is None else cache.path(model)
            if path is not None:
                return path.parent, path.name
        elif not model.endswith(".py") and store.has(model):
            return store.directory, model
        raise ModelError(
            f"it has no model {model!r:.140}", remedy="copy it into its --models directory"
        )

    def _python_model(self, model: str) -> tuple[Path, str]:
        if not self._offer.python:
            raise ModelError(
                f"it starts no Python models, such as {model!r:.140}",
                remedy="start the agent with --allow-python, or export the model as an FMU",
            )
        place, name = split_reference(model) or ("", "")
        is_file = place.endswith(".py") and self._offer.store.has(place)
        is_installed = not place.endswith(".py") and _INSTALLED_MODEL.fullmatch(place)
        if not (_CLASS.fullmatch(name) and (is_file or is_installed)):
            raise ModelError(
                f"it has no Python model {model!r:.140}",
                remedy="name package.module:Class, or file.py:Class of a file in its --models "
                "directory",
            )
        return self._offer.store.directory, model

    def _process(self, model: str, base: Path, request: StartSlave) -> SlaveProcess:
        places = self._surroundings
        slave = request.slave
        key = SlaveKey.of_run(slave, request.run)
        scratch = places.scratch / key.instance
        log_file = (places.logs or places.scratch) / f"{slave}.{key.instance}.log"
        try:
            scratch.mkdir()
        except OSError as error:
            raise ConfigurationError(f"{scratch} cannot be made: {error}") from error
        return SlaveProcess(
            model,
            base,
            key,
            connection=places.connection,
            load_timeout=request.load_timeout,
            log=log_file,
            scratch=scratch,
        )

    def _end_orphans(self, run: str) -> None:
        log.warning("run %s has no master any more: ending its slaves", run, extra={"run": run})
        self._end(run)

    def _end(self, run: str) -> None:
        with self._lock:
            known = self._runs.get(run)
            if known is None:
                return
            known.ending = True
            self._masters.forget(run)
        processes = [process for _, process in known.slaves.values()]
        end_all(processes)
        with self._lock:
            self._runs.pop(run, None)
        for process in processes:
            about = {"run": run, "slave": process.key.name}
            log.info("ended %s of run %s", process.key.name, run, extra=about)
            self._forget(process)

    def _forget(self, process: SlaveProcess) -> None:
        """Remove what a process that has ended leaves behind."""
        if self._surroundings.logs is None:
            with suppress(OSError):
                process.log.unlink()
        rmtree(self._surroundings.scratch / process.key.instance, ignore_errors=True)
