"""Slaves that agents start on their hosts: which agent, which model there, and what became of them.

A model is the same when its SHA-256 is: it is looked for on the agent by that, and sent only when
it is not there and the agent takes it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import socket
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import Self, TypeVar

from master_node.configuration import SlaveSettings, System
from master_node.remote_slave import orphan_time
from protocol.agents import (
    CHUNK_BYTES,
    LICENCE,
    AgentModel,
    AgentStatus,
    Done,
    ModelList,
    OutputRequest,
    Record,
    SlaveOutput,
    SlaveStarted,
    StartSlave,
    StopRun,
    Upload,
    UploadState,
)
from protocol.bus import Bus, PendingReply
from protocol.codec import decode_record, encode_record
from protocol.errors import (
    ConfigurationError,
    DeadlineError,
    DoublestepError,
    ModelError,
    ProtocolError,
    SlaveBusyError,
    SlaveLostError,
)
from protocol.keys import (
    MODELS,
    OUTPUT,
    START,
    STOP,
    UPLOAD,
    AgentKey,
    SlaveKey,
    alive_agents,
)
from protocol.plain_text import printable
from protocol.slave import SlaveDescription
from protocol.slave_processes import end_error

log = logging.getLogger("master_node")

_TOKEN_TIME = 1.0
_STATUS_TIME = 1.0
_MODELS_TIME = 60.0  # an agent reads files that are new to it
_START_TIME = 30.0
_STOP_TIME = 10.0
_CHUNK_TIME = 30.0
_PAUSE = 0.1
_ARRIVAL_TIME = 0.6  # who waits for a master tries again every 0.2 s
_CHECK_PERIOD = 0.5


@dataclass(frozen=True, slots=True)
class Sent:
    """How far a model is on its way.

    Attributes:
        slave: for which it is.
        agent: to which it goes.
        model: file name.
        sent, size: [bytes].
    """

    slave: str
    agent: str
    model: str
    sent: int
    size: int


Uploading = Callable[[Sent], None]
"""Told of every piece that was sent."""


@dataclass(frozen=True)
class _Wanted:
    """A slave that is to be started, and its model as it is known here.

    Attributes:
        slave: its name.
        settings: its table.
        file: the model's file here; None: there is none.
        name: of the model's file, without folders.
        python_class: of a Python model, with its colon; empty for an FMU.
        sha256, size: of ``file``; empty and 0 without it.
    """

    slave: str
    settings: SlaveSettings
    file: Path | None
    name: str
    python_class: str
    sha256: str = ""
    size: int = 0


@dataclass(frozen=True)
class _Placed:
    """A slave that was started."""

    agent: AgentStatus
    key: AgentKey
    sha256: str


@dataclass(frozen=True)
class _Seen:
    key: AgentKey
    status: AgentStatus


class _UnsuitableError(Exception):
    """An agent cannot start a slave; another one may. Its text says why."""


_R = TypeVar("_R", bound=Record)


class Agents:
    """The slaves of one run that agents start; implements `master_node.launcher.Starter`.

    Args:
        bus: opened, with the token of the run on it.
        run: id of the run.
        system: whose slaves they are.
        uploading: told of models that are sent.
    """

    def __init__(
        self, bus: Bus, run: str, system: System, uploading: Uploading | None = None
    ) -> None:
        self._bus = bus
        self._run = run
        self._system = system
        self._uploading = uploading
        self._arrived = monotonic() + _ARRIVAL_TIME
        self._deadline = monotonic() + system.bus.discovery_timeout
        self._placed: dict[str, _Placed] = {}
        self._used: set[AgentKey] = set()
        self._restarts: dict[str, int] = {}
        self._ended: dict[str, DoublestepError] = {}
        self._next_check = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End all that were started."""
        self.stop()

    def start(self, name: str) -> SlaveKey:
        """Have an agent start slave ``name``; its address on the bus, where it will appear.

        Of the agents with the labels that it requires the one with the most free licences is
        taken, and of equal ones the first by name, if it has the model or takes it. Waits for an
        agent, and for a licence, until ``discovery_timeout`` after this object was made.

        Raises:
            SlaveLostError: there is no such agent; says which there are and what they lack.
            ConfigurationError: no suitable agent has the model or takes it.
            SlaveBusyError: all licences are taken; says by whom.
            ProtocolError: two agents of one name.
        """
        wanted = self._wanted(name)
        waiting = False
        sleep(max(0.0, self._arrived - monotonic()))  # choose among all of them
        while True:
            seen = self._seen()
            suitable = _suitable(seen, wanted.settings)
            try:
                return self._start_on_first(suitable, wanted)
            except SlaveBusyError as error:
                if monotonic() > self._deadline:
                    raise error.located(slave=name, phase="start") from None
                if not waiting:
                    log.info("%s waits: %s", name, error.cause)
                waiting = True
            except (SlaveLostError, DeadlineError) as error:
                if monotonic() > self._deadline:
                    raise error.located(slave=name, phase="start") from None
            except ConfigurationError as error:
                raise error.located(slave=name, phase="start") from None
            except _UnsuitableError:
                if monotonic() > self._deadline:
                    raise self._nobody(wanted, seen) from None
            sleep(_PAUSE)

    def restart(self, name: str) -> SlaveKey:
        """Have slave ``name`` started once more, by another agent if the first does not answer.

        Raises:
            DoublestepError: as `start`.
        """
        self._deadline = monotonic() + self._system.bus.discovery_timeout
        self._placed.pop(name, None)
        self._ended.pop(name, None)
        self._restarts[name] = self._restarts.get(name, 0) + 1
        return self.start(name)

    def verify(self, descriptions: Mapping[str, SlaveDescription]) -> None:
        """Check that the agents have loaded the models that were meant.

        Raises:
            ModelError: a model has another SHA-256.
        """
        for name, placed in self._placed.items():
            found = descriptions[name].sha256
            if placed.sha256 and found != placed.sha256:
                raise ModelError(
                    f"agent {placed.agent.name} loaded a model with SHA-256 {found:.64}, not "
                    f"{placed.sha256}",
                    slave=name,
                    phase="start",
                    remedy="the file was changed meanwhile: run again",
                )

    def check(self) -> None:
        """See `Starter`; looks twice in a second."""
        if not self._placed or monotonic() < self._next_check:
            return
        self._next_check = monotonic() + _CHECK_PERIOD
        for name in self._placed:
            error = self.ended(name)
            if error is not None:
                raise error

    def ended(self, name: str) -> DoublestepError | None:
        """See `Starter`; None too when the agent does not answer."""
        placed = self._placed.get(name)
        if placed is None or name in self._ended:
            return self._ended.get(name)
        try:
            request = OutputRequest(self._run, name)
            output = self._ask(placed.key, OUTPUT, request, SlaveOutput, _STATUS_TIME)
        except DoublestepError:
            return None
        if output.exit_code is None:
            return None
        agent = placed.agent
        remedy = (
            f"see {printable(output.log)} on {printable(agent.host)}"
            if output.log
            else f"start the agent {agent.name} with --logs DIR to keep all that it said"
        )
        lines = [printable(line) for line in output.lines]
        error = end_error(name, output.exit_code, lines, remedy)
        error.cause = f"on {printable(agent.host)} (agent {agent.name}): {error.cause}"
        self._ended[name] = error
        return error

    def how_ended(self, name: str) -> str:
        """See `Starter`."""
        error = self.ended(name)
        return "" if error is None else error.cause

    def wait_ended(self, name: str, timeout: float) -> DoublestepError | None:
        """See `Starter`."""
        if name not in self._placed:
            return None
        deadline = monotonic() + timeout
        while True:
            error = self.ended(name)
            if error is not None or monotonic() > deadline:
                return error
            sleep(_PAUSE)

    def stop(self, *, at_once: bool = False) -> None:  # noqa: ARG002  agents bound it themselves
        """See `Starter`."""
        pending: list[PendingReply] = []
        for key in self._used:
            try:
                caller = self._bus.caller(key.verb(STOP), _STOP_TIME)
                pending.append(caller.send(encode_record(StopRun(self._run))))
            except DoublestepError:
                continue
        self._placed.clear()
        self._used.clear()
        for reply in pending:
            try:
                decode_record(Done, reply.result())
            except DoublestepError as error:
                log.warning("an agent did not end its slaves: %s", printable(str(error)))

    def _seen(self) -> list[_Seen]:
        """The agents on the bus that answer, all asked at once."""
        tokens = self._bus.alive(alive_agents(), _TOKEN_TIME)
        keys = [key for key in map(AgentKey.from_alive, tokens) if key is not None]
        pending = []
        for key in keys:
            caller = self._bus.caller(key.status, _STATUS_TIME)
            pending.append((key, caller.send(b"")))
        seen = []
        for key, reply in pending:
            try:
                seen.append(_Seen(key, decode_record(AgentStatus, reply.result())))
            except DoublestepError as error:
                log.warning("agent %s: %s", printable(key.name), printable(str(error)))
        return seen

    def _start_on_first(self, suitable: Sequence[_Seen], wanted: _Wanted) -> SlaveKey:
        """Try them in turn; raises the most hopeful of their reasons."""
        if not suitable:
            raise _UnsuitableError
        reasons: list[DoublestepError] = []
        for seen in suitable:
            try:
                return self._start_on(seen, wanted)
            except (ConfigurationError, SlaveBusyError, SlaveLostError, DeadlineError) as error:
                error.cause = f"agent {seen.key.name} on {seen.status.host}: {error.cause}"
                reasons.append(error)
        busy = [reason for reason in reasons if isinstance(reason, SlaveBusyError)]
        wrong = [reason for reason in reasons if isinstance(reason, ConfigurationError)]
        first = (busy or wrong or reasons)[0]
        first.cause = printable("; ".join(reason.cause for reason in reasons))
        raise first

    def _start_on(self, seen: _Seen, wanted: _Wanted) -> SlaveKey:
        requires = wanted.settings.requires
        licence = requires.get(LICENCE, "")
        for counted in seen.status.licences:
            if counted.name == licence and not counted.free:  # before a model is sent for nothing
                if all(f" of run {self._run} on " in holder for holder in counted.holders):
                    raise ConfigurationError(
                        f"it has {counted.total} licences {licence}, and the system needs more",
                        remedy="raise --licence of the agent, or use several agents",
                    )
                raise SlaveBusyError(
                    f"all {counted.total} licences {licence} are taken: "
                    + ", ".join(counted.holders),
                    remedy="wait for these to end, or raise discovery_timeout",
                )
        model, sha256 = self._model_on(seen, wanted)
        request = StartSlave(
            run=self._run,
            host=socket.gethostname(),
            pid=os.getpid(),
            orphan_time=orphan_time(self._system.bus.reconnect_time),
            slave=wanted.slave,
            model=model,
            requires=requires,
            restart=self._restarts.get(wanted.slave, 0),
        )
        self._used.add(seen.key)
        started = self._ask(seen.key, START, request, SlaveStarted, _START_TIME)
        self._placed[wanted.slave] = _Placed(seen.status, seen.key, sha256)
        log.info("%s is started by agent %s on %s", wanted.slave, seen.key.name, seen.status.host)
        return SlaveKey(wanted.slave, started.instance)

    def _model_on(self, seen: _Seen, wanted: _Wanted) -> tuple[str, str]:
        """What to call the model on that agent, and its SHA-256 if it is known."""
        if wanted.python_class and not wanted.name.endswith(".py"):
            return f"{wanted.name}{wanted.python_class}", ""
        if wanted.python_class and not seen.status.python:
            raise ModelError(
                "it starts no Python models",
                remedy="start it with --allow-python, or export the model as an FMU",
            )
        models = self._ask(seen.key, MODELS, Done(), ModelList, _MODELS_TIME).models
        named = [model for model in models if model.name == wanted.name]
        if wanted.python_class:
            return self._python_model_on(named, wanted)
        if wanted.file is None:
            if not named:
                raise ModelError(
                    f"it has no model {wanted.name}, and there is none here",
                    remedy=f"give the path of {wanted.name} here, or copy it into the agent's "
                    "--models directory",
                )
            return named[0].sha256, named[0].sha256
        if not any(model.sha256 == wanted.sha256 for model in models):
            self._may_send(seen.status, named, wanted)
            self._send(seen, wanted, wanted.file)
        return wanted.sha256, wanted.sha256

    @staticmethod
    def _python_model_on(named: Sequence[AgentModel], wanted: _Wanted) -> tuple[str, str]:
        """A Python file is never sent: it would be a program for that host."""
        if not named:
            raise ModelError(
                f"it has no file {wanted.name}",
                remedy="copy it into the agent's --models directory",
            )
        if wanted.sha256 and wanted.sha256 != named[0].sha256:
            raise ModelError(
                f"its {wanted.name} is another one: SHA-256 {named[0].sha256}, here "
                f"{wanted.sha256}",
                remedy="copy the one from here into the agent's --models directory",
            )
        return f"{wanted.name}{wanted.python_class}", named[0].sha256

    @staticmethod
    def _may_send(agent: AgentStatus, named: Sequence[AgentModel], wanted: _Wanted) -> None:
        if wanted.size <= agent.upload_limit:
            return
        other = f"; its {wanted.name} is another one" if named else ""
        limit = (
            f"it takes only models up to {agent.upload_limit} bytes, and this one has {wanted.size}"
            if agent.upload_limit
            else "models may not be sent to it"
        )
        raise ModelError(
            f"it has no model with the SHA-256 of {wanted.name}, {wanted.sha256}{other}, and "
            f"{limit}",
            remedy=f"copy {wanted.name} into its --models directory, or "
            + (
                "raise its --upload-limit" if agent.upload_limit else "start it with --allow-upload"
            ),
        )

    def _send(self, seen: _Seen, wanted: _Wanted, file: Path) -> None:
        """Send the pieces that are not there yet; goes on after a lost connection."""
        log.info("sending %s (%d bytes) to agent %s", wanted.name, wanted.size, seen.key.name)
        try:
            with file.open("rb") as source:
                state = self._piece(seen.key, Upload(wanted.sha256, wanted.size, 0, b""))
                while not state.complete:
                    offset = state.received
                    source.seek(offset)
                    data = source.read(CHUNK_BYTES)
                    state = self._piece(seen.key, Upload(wanted.sha256, wanted.size, offset, data))
                    if not state.complete and state.received <= offset:
                        raise ProtocolError(
                            f"agent {seen.key.name} did not take the piece at {offset}"
                        )
                    self._tell(seen, wanted, state.received)
        except OSError as error:
            raise ModelError(f"{file} cannot be read: {error}") from error

    def _tell(self, seen: _Seen, wanted: _Wanted, sent: int) -> None:
        if self._uploading is not None:
            self._uploading(Sent(wanted.slave, seen.key.name, wanted.name, sent, wanted.size))

    def _piece(self, key: AgentKey, piece: Upload) -> UploadState:
        deadline = monotonic() + self._system.bus.reconnect_time
        while True:
            try:
                return self._ask(key, UPLOAD, piece, UploadState, _CHUNK_TIME)
            except SlaveLostError:
                if monotonic() > deadline:
                    raise
            sleep(_PAUSE)

    def _ask(
        self, key: AgentKey, verb: str, record: Record, answer: type[_R], timeout: float
    ) -> _R:
        reply = self._bus.caller(key.verb(verb), timeout).request(encode_record(record))
        return decode_record(answer, reply)

    def _wanted(self, name: str) -> _Wanted:
        settings = self._system.slaves[name]
        model = str(settings.model)
        place, colon, python_class = model.rpartition(":")
        is_python = bool(colon) and not model.lower().endswith(".fmu")
        path = place if is_python else model
        python_class = f":{python_class}" if is_python else ""
        file_name = path.replace("\\", "/").rpartition("/")[2]
        file = self._system.base / path
        try:
            if (is_python and not path.endswith(".py")) or not file.is_file():
                return _Wanted(name, settings, None, file_name, python_class)
            with file.open("rb") as source:
                digest = hashlib.file_digest(source, "sha256").hexdigest()
            size = file.stat().st_size
        except OSError as error:
            raise ModelError(f"{file} cannot be read: {error}", slave=name) from error
        return _Wanted(name, settings, file, file_name, python_class, digest, size)

    def _nobody(self, wanted: _Wanted, seen: Sequence[_Seen]) -> SlaveLostError:
        settings = wanted.settings
        there = "; ".join(
            printable(
                f"{s.key.name} on {s.status.host}, which "
                + (
                    "lacks " + ", ".join(lacking)
                    if (lacking := s.status.lacks(settings.requires))
                    else "has another name"
                )
            )
            for s in seen
        )
        asked = ([f"host = {settings.host}"] if settings.host else []) + [
            f"{name} = {value}" for name, value in settings.requires.items()
        ]
        return SlaveLostError(
            f"no agent with {', '.join(asked)} within {self._system.bus.discovery_timeout:g} s; "
            f"found on the bus: {there or 'no agent at all'}",
            slave=wanted.slave,
            phase="discovery",
            remedy="start one with `slave-node agent --models DIR --name NAME --label NAME=VALUE`, "
            "or check --connect and --listen on both sides",
        )


def _suitable(seen: Sequence[_Seen], settings: SlaveSettings) -> list[_Seen]:
    """The agents that a slave may be started by, the best first.

    Raises:
        ProtocolError: one of them has the name of another one.
    """
    found = [
        s
        for s in seen
        if settings.host in (None, s.key.name) and not s.status.lacks(settings.requires)
    ]
    names = Counter(s.key.name for s in seen)
    for s in found:
        if names[s.key.name] > 1:
            places = [f"{o.status.host}/{o.status.pid}" for o in seen if o.key.name == s.key.name]
            raise ProtocolError(
                f"{len(places)} agents are called {s.key.name!r}: {printable(', '.join(places))}",
                remedy="end all but one of them",
            )
    licence = settings.requires.get(LICENCE, "")
    return sorted(found, key=lambda s: (-s.status.free(licence), s.key.name))
