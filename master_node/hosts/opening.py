"""From the system's slaves to links: launched here or by agents, found on the bus, or in process.

Each way is a context manager that gives a `Slaves` and leaves nothing running behind it.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from secrets import token_hex

from master_node.hosts.agent_models import Uploading
from master_node.hosts.agents import Agents
from master_node.hosts.announcement import announce_run
from master_node.hosts.launcher import Launcher, Starter
from master_node.hosts.presence import Presence
from master_node.hosts.restarts import Restarts
from master_node.slaves.link import LocalSlave, SlaveLink
from master_node.slaves.remote import RemoteSlave
from master_node.slaves.request_bounds import RequestBounds
from master_node.slaves.shared_process import Baseline, SharedProcess, shared_process
from master_node.system.system import System
from protocol.bus.bus import DEFAULT_ENDPOINT, Bus
from protocol.bus.credentials import Credentials, Role
from protocol.bus.endpoints import Endpoints, Mode, free_endpoint
from protocol.bus.opening import open_bus
from protocol.calls import Describe
from protocol.description import SlaveDescription
from protocol.errors import (
    ConfigurationError,
    DeadlineError,
    DoublestepError,
    InterruptedRunError,
    SlaveLostError,
)
from protocol.host.clock import SYSTEM_CLOCK, Clock
from protocol.host.log_files import SILENT, LogOutput
from protocol.host.logs import add_log_fields
from protocol.host.scratch import ScratchDirectory
from protocol.slave_processes import connection_options
from protocol.wire.keys import SlaveKey

_DEATH_TIME = 1.0


@dataclass(frozen=True)
class Slaves:
    """The slaves of a run, instantiated, in the order of the system file.

    Attributes:
        links: to each of them.
        descriptions: what each said of itself.
        starters: of those that were started for this run.
        restarts: starts them again, None in process and without recovery.
        hosts: on which they run, by name.
    """

    links: Mapping[str, SlaveLink]
    descriptions: Mapping[str, SlaveDescription]
    starters: Sequence[Starter] = ()
    restarts: Restarts | None = None
    hosts: Mapping[str, str] = field(default_factory=dict)

    def explain(self, error: DoublestepError) -> DoublestepError:
        """A lost slave's error with the exit code and last words of its process, if it is ours."""
        if not isinstance(error, SlaveLostError):
            return error
        if self.restarts is not None and self.restarts.is_mine(error.slave):
            return error  # it says itself what became of it
        for starter in self.starters:
            ended = starter.wait_ended(error.slave, _DEATH_TIME)
            if ended is not None:
                return SlaveLostError(ended.cause, remedy=ended.remedy).located(
                    slave=error.slave, phase=error.phase, time=error.time, step_size=error.step_size
                )
        return error


@contextmanager
def opened_slaves(
    system: System,
    log_directory: Path | None,
    *,
    in_process: bool = False,
    launch: bool = True,
    uploading: Uploading | None = None,
    baseline: Baseline | None = None,
) -> Iterator[Slaves]:
    """The slaves of a system, wherever they run; raises as the two ways below.

    Args:
        system: what to run.
        log_directory: gets the logs of slaves that are launched, for which it has to be there, or
            run in process; None: these are not kept.
        in_process: all slaves in this process; else over Zenoh.
        launch: start slaves that have a model; False: find all of them on the bus.
        uploading: told of models that are sent to agents.
        baseline: see `slaves_in_process`.
    """
    if in_process:
        with slaves_in_process(system, baseline, log_directory) as slaves:
            yield slaves
        return
    with ScratchDirectory() as temporary:
        logs = temporary if log_directory is None else log_directory
        with slaves_on_bus(system, logs, launch=launch, uploading=uploading) as slaves:
            yield slaves


@contextmanager
def slaves_in_process(
    system: System, baseline: Baseline | None = None, log_directory: Path | None = None
) -> Iterator[Slaves]:
    """All slaves in this process, without a bus.

    Args:
        system: what to run.
        baseline: to which the process returns from what models do to it; None: as it is now.
        log_directory: made, if it is not there, for what models say; None: that is not kept.

    Raises:
        ConfigurationError: a slave has no model, or its model cannot be loaded.
    """
    load = entry_points(group="doublestep.in_process")["slave"].load()
    with ExitStack() as stack:
        if baseline is None:
            baseline = stack.enter_context(shared_process())
        links: dict[str, SlaveLink] = {}
        descriptions = {}
        for name, settings in system.slaves.items():
            if settings.model is None:
                raise ConfigurationError(
                    f"{system.places.slave(name)} has no model, so it cannot run in process"
                )
            scratch = stack.enter_context(ScratchDirectory())
            process = SharedProcess(baseline)
            try:
                executor = process.run(
                    load,
                    settings.model,
                    system.base,
                    name,
                    scratch,
                    output=_log_of(name, log_directory),
                )
            except DoublestepError as error:
                raise error.located(slave=name) from None
            stack.callback(process.run, executor.close)
            links[name] = LocalSlave(executor, process)
            descriptions[name] = executor.description
        yield Slaves(links, descriptions, hosts=dict.fromkeys(links, socket.gethostname()))


def _log_of(name: str, directory: Path | None) -> LogOutput:
    """A new log, in place of one that is there."""
    if directory is None:
        return SILENT
    file = directory.absolute() / f"{name}.log"
    with suppress(OSError):
        file.unlink(missing_ok=True)
    return LogOutput(str(file))


@contextmanager
def slaves_on_bus(
    system: System,
    log_directory: Path,
    *,
    launch: bool = True,
    uploading: Uploading | None = None,
) -> Iterator[Slaves]:
    """Slaves over Zenoh: started by agents or here, as the system says, or found by name.

    Args:
        system: what to run.
        log_directory: existing; gets the launched slaves' logs.
        launch: False: all slaves are expected on the bus.
        uploading: told of models that are sent to agents.

    Raises:
        ConfigurationError: an address cannot be used, or a model cannot be loaded.
        SlaveLostError: a slave or an agent did not appear in time; says what was found.
        ProtocolError: two slaves of one name, or a slave held by another master.
    """
    started = {n for n, s in system.slaves.items() if launch and s.model is not None}
    elsewhere = {name for name in started if system.slaves[name].needs_agent}
    launched = started - elsewhere
    found = [name for name in system.slaves if name not in started]
    private = free_endpoint()
    with ExitStack() as stack:
        endpoints = _endpoints(
            system, private, launched=bool(launched), found=bool(found or elsewhere)
        )
        bus = open_bus(endpoints, timeout=system.bus.discovery_timeout)
        stack.callback(bus.close)
        run = token_hex(4)
        add_log_fields(run=run)
        announce_run(bus, run, system)
        launcher = stack.enter_context(
            Launcher(
                run,
                _connection(endpoints, private),
                log_directory,
                load_timeout=float(system.bus.load_timeout),
                pin=system.bus.pin,
            )
        )
        agents = stack.enter_context(Agents(bus, run, system, uploading))
        starters = (launcher, agents)
        keys = {
            name: launcher.launch(name, str(system.slaves[name].model), system.base)
            for name in system.slaves
            if name in launched
        }
        keys |= {name: agents.start(name) for name in system.slaves if name in elsewhere}
        presence = Presence(bus)
        keys |= presence.wait(
            found,
            keys,
            starters,
            discovery_timeout=system.bus.discovery_timeout,
            load_timeout=system.bus.load_timeout,
        )

        def why_ended(remote: RemoteSlave) -> str:
            died = "its process died" if remote.has_ended else ""
            if died:
                launcher.wait_ended(remote.key.name, _DEATH_TIME)
            found = (starter.how_ended(remote.key.name) for starter in starters)
            return next(filter(None, found), died)

        recovers = system.simulation.recovery == "auto"
        claim = partial(
            claim_slave,
            bus,
            run=run,
            bounds=RequestBounds.of(system),
            reconnect_time=system.bus.reconnect_time,
        )
        remotes = stack.enter_context(
            claimed_slaves(
                claim,
                presence,
                {name: keys[name] for name in system.slaves},
                why_ended,
                reconnect_time=system.bus.reconnect_time,
                can_restart=lambda name: recovers and name in started,
            )
        )

        def start_again(name: str) -> tuple[SlaveKey, Starter]:
            if name in elsewhere:
                return agents.restart(name), agents
            model = str(system.slaves[name].model)
            return launcher.launch(name, model, system.base), launcher

        restarts = Restarts(system, remotes, claim, start_again, presence, frozenset(started))
        slaves = Slaves(
            dict(remotes),
            describe(remotes),
            starters,
            restarts if recovers else None,
            {name: remote.host for name, remote in remotes.items()},
        )
        agents.verify(slaves.descriptions)
        try:
            yield slaves
        except (KeyboardInterrupt, InterruptedRunError):
            launcher.stop(at_once=True)
            raise
        except DoublestepError as error:
            if isinstance(error, DeadlineError) and error.slave in remotes:
                remotes[error.slave].abort()
            raise slaves.explain(error) from error.__cause__


def claim_slave(
    bus: Bus,
    key: SlaveKey,
    *,
    run: str,
    bounds: RequestBounds,
    reconnect_time: float,
    clock: Clock = SYSTEM_CLOCK,
) -> RemoteSlave:
    """Claim a slave for a run.

    Args:
        bus: on which it is.
        key: its address.
        run: id of the run.
        bounds: on its requests.
        reconnect_time: how long to wait for one that vanished [s].
        clock: for all waits.

    Raises:
        SlaveBusyError, SlaveLostError, DeadlineError: it cannot be claimed; names it.
    """
    try:
        return RemoteSlave(
            bus,
            key,
            run=run,
            bounds=bounds,
            reconnect_time=reconnect_time,
            clock=clock,
        )
    except DoublestepError as error:
        raise error.located(slave=key.name, phase="claim") from None


@contextmanager
def claimed_slaves(
    claim: Callable[[SlaveKey], RemoteSlave],
    presence: Presence,
    keys: Mapping[str, SlaveKey],
    why_ended: Callable[[RemoteSlave], str],
    *,
    reconnect_time: float,
    can_restart: Callable[[str], bool] = lambda _: False,
) -> Iterator[dict[str, RemoteSlave]]:
    """Claim slaves for a run, look after them, and give them back at the end.

    Args:
        claim: claims one, see `claim_slave`, whose errors it raises.
        presence: follows their tokens.
        keys: their addresses by name, in the order in which they are claimed.
        why_ended: why a slave's process is no more; "": it may live.
        reconnect_time: how long to wait for one that vanished [s].
        can_restart: whether the slave of a name can be started again; one that was is put in the
            place of the old one.
    """
    with ExitStack() as stack:
        remotes: dict[str, RemoteSlave] = {}
        stack.callback(_release, remotes)
        for name, key in keys.items():
            remotes[name] = claim(key)
        stack.enter_context(
            presence.guarded(list(remotes.values()), why_ended, reconnect_time, can_restart)
        )
        yield remotes


def _release(remotes: Mapping[str, RemoteSlave]) -> None:
    for remote in reversed(list(remotes.values())):
        remote.release()


def describe(links: Mapping[str, SlaveLink]) -> dict[str, SlaveDescription]:
    """Descriptions of the slaves; raises a slave's error, with its name."""
    for link in links.values():
        link.start([Describe()])
    descriptions = {}
    for name, link in links.items():
        try:
            reply = link.finish()
            if reply.error is not None:
                raise reply.error
        except DoublestepError as error:
            raise error.located(slave=name, phase=Describe.verb) from error.__cause__
        description = reply.results[0]
        assert isinstance(description, SlaveDescription)
        descriptions[name] = description
    return descriptions


def _endpoints(system: System, private: str, *, launched: bool, found: bool) -> Endpoints:
    bus = system.bus
    mode = Mode(bus.mode)
    listen, connect = list(bus.listen), list(bus.connect)
    if mode is Mode.CLIENT:
        connect = connect or [DEFAULT_ENDPOINT]
    else:
        if found and not listen and not connect:
            listen.append(DEFAULT_ENDPOINT)
        if launched:
            listen.append(private)
    try:
        credentials = (
            None
            if system.certificates is None
            else Credentials(system.certificates.absolute(), Role.MASTER)
        )
        return Endpoints(tuple(listen), tuple(connect), bus.insecure, mode, credentials)
    except ConfigurationError as error:
        raise ConfigurationError(
            f"{system.source}: [bus] {error.cause}", remedy=error.remedy
        ) from None


def _connection(endpoints: Endpoints, private: str) -> list[str]:
    """The options by which a slave that is started here comes to the same bus."""
    connect = endpoints.connect if endpoints.mode is Mode.CLIENT else (private,)
    return connection_options(endpoints.mode, connect, endpoints)
