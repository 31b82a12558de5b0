"""Slaves that agents start on their hosts: which agent it is, and what became of them."""

from __future__ import annotations

import logging
import os
import socket
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import monotonic, sleep
from typing import Self

from master_node.hosts.agent_models import ModelPlacing, Uploading, WantedModel, wanted_model
from master_node.hosts.agent_requests import SeenAgent, ask_agent
from master_node.slaves.remote import orphan_time
from master_node.system.system import System
from master_node.system.tables import SlaveSettings
from protocol.bus.bus import Bus, PendingReply
from protocol.description import SlaveDescription
from protocol.errors import (
    ConfigurationError,
    DeadlineError,
    DoublestepError,
    ModelError,
    ProtocolError,
    SlaveBusyError,
    SlaveLostError,
)
from protocol.slave_processes import end_error
from protocol.wire.agents import (
    LICENCE,
    AgentStatus,
    Done,
    OutputRequest,
    SlaveOutput,
    SlaveStarted,
    StartSlave,
    StopRun,
)
from protocol.wire.keys import (
    OUTPUT,
    START,
    STOP,
    AgentKey,
    SlaveKey,
    alive_agents,
)
from protocol.wire.records import decode_record, encode_record

log = logging.getLogger("master_node")

_TOKEN_TIME = 1.0
_STATUS_TIME = 1.0
_START_TIME = 30.0
_STOP_TIME = 10.0
_PAUSE = 0.1
_MAX_AGENTS = 256
_AT_ONCE = 8
_ARRIVAL_TIME = 0.6  # who waits for a master tries again every 0.2 s
_CHECK_PERIOD = 0.5


@dataclass(frozen=True)
class _Placed:
    """A slave that was started."""

    agent: AgentStatus
    key: AgentKey
    sha256: str


class _UnsuitableError(Exception):
    """No agent has the name and the labels."""


class Agents:
    """The slaves of one run that agents start; implements `master_node.hosts.launcher.Starter`.

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
        self._models = ModelPlacing(bus, system.bus.reconnect_time, uploading)
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
        wanted = wanted_model(self._system, name)
        settings = self._system.slaves[name]
        waiting = False
        sleep(max(0.0, self._arrived - monotonic()))  # choose among all of them
        while True:
            seen = self._seen()
            try:
                return self._start_on_first(_suitable(seen, settings), wanted)
            except SlaveBusyError as error:
                if monotonic() > self._deadline:
                    raise error.located(slave=name, phase="start") from None
                if not waiting:
                    log.info("%s waits: %s", name, error.cause)
                waiting = True
            except (SlaveLostError, DeadlineError) as error:
                if monotonic() > self._deadline:
                    raise error.located(slave=name, phase="start") from None
            except (ConfigurationError, ProtocolError) as error:
                raise error.located(slave=name, phase="start") from None
            except _UnsuitableError:
                if monotonic() > self._deadline:
                    raise self._no_agent(name, settings, seen) from None
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
            output = ask_agent(
                self._bus, placed.key, OUTPUT, request, SlaveOutput, timeout=_STATUS_TIME
            )
        except DoublestepError:
            return None
        if output.exit_code is None:
            return None
        agent = placed.agent
        remedy = (
            f"see {output.log} on {agent.host}"
            if output.log
            else f"start the agent {agent.name} with --logs DIR to keep all that it said"
        )
        error = end_error(name, output.exit_code, output.lines, remedy)
        error.cause = f"on {agent.host} (agent {agent.name}): {error.cause}"
        if self._placed.get(name) is not placed:
            return None  # it was started again meanwhile, and this was about the one before
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
                log.warning("an agent did not end its slaves: %s", error)

    def _seen(self) -> list[SeenAgent]:
        """The agents on the bus that answer, some asked at once: answers are held till then."""
        tokens = self._bus.alive(alive_agents(), _TOKEN_TIME)
        keys = [key for key in map(AgentKey.from_alive, tokens) if key is not None][:_MAX_AGENTS]
        seen = []
        for i in range(0, len(keys), _AT_ONCE):
            callers = [
                (k, self._bus.caller(k.status, _STATUS_TIME)) for k in keys[i : i + _AT_ONCE]
            ]
            for key, reply in [(key, caller.send(b"")) for key, caller in callers]:
                try:
                    seen.append(SeenAgent(key, decode_record(AgentStatus, reply.result())))
                except DoublestepError as error:
                    log.warning("agent %s: %s", key.name, error)
        return seen

    def _start_on_first(self, suitable: Sequence[SeenAgent], wanted: WantedModel) -> SlaveKey:
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
        first.cause = "; ".join(reason.cause for reason in reasons)
        raise first

    def _start_on(self, seen: SeenAgent, wanted: WantedModel) -> SlaveKey:
        requires = self._system.slaves[wanted.slave].requires
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
        model, sha256 = self._models.place(seen, wanted)
        request = StartSlave(
            run=self._run,
            host=socket.gethostname(),
            pid=os.getpid(),
            orphan_time=orphan_time(self._system.bus.reconnect_time),
            slave=wanted.slave,
            model=model,
            requires=requires,
            restart=self._restarts.get(wanted.slave, 0),
            load_timeout=float(self._system.bus.load_timeout),
        )
        self._used.add(seen.key)
        started = ask_agent(self._bus, seen.key, START, request, SlaveStarted, timeout=_START_TIME)
        self._placed[wanted.slave] = _Placed(seen.status, seen.key, sha256)
        log.info("%s is started by agent %s on %s", wanted.slave, seen.key.name, seen.status.host)
        return SlaveKey(wanted.slave, started.instance)

    def _no_agent(
        self, name: str, settings: SlaveSettings, seen: Sequence[SeenAgent]
    ) -> SlaveLostError:
        there = "; ".join(
            f"{s.key.name} on {s.status.host}, which "
            + (
                "lacks " + ", ".join(lacking)
                if (lacking := s.status.lacks(settings.requires))
                else "has another name"
            )
            for s in seen
        )
        asked = ([f"host = {settings.host}"] if settings.host else []) + [
            f"{name} = {value}" for name, value in settings.requires.items()
        ]
        return SlaveLostError(
            f"no agent with {', '.join(asked)} within {self._system.bus.discovery_timeout:g} s; "
            f"found on the bus: {there or 'no agent at all'}",
            slave=name,
            phase="discovery",
            remedy="start one with `slave-node agent --models DIR --name NAME --label NAME=VALUE`, "
            "or check --connect and --listen on both sides",
        )


def _suitable(seen: Sequence[SeenAgent], settings: SlaveSettings) -> list[SeenAgent]:
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
                f"{len(places)} agents are called {s.key.name!r}: {', '.join(places)}",
                remedy="end all but one of them",
            )
    licence = settings.requires.get(LICENCE, "")
    return sorted(found, key=lambda s: (-s.status.free(licence), s.key.name))
