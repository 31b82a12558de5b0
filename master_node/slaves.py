"""From the system's slaves to links: launched here, found on the bus, or in this process.

Each way is a context manager that gives a `Slaves` and leaves nothing running behind it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from secrets import token_hex

from master_node.announcement import announce_run
from master_node.configuration import System
from master_node.launcher import Launcher
from master_node.presence import Presence
from master_node.remote_slave import RemoteSlave
from master_node.slave_link import LocalSlave, SlaveLink
from protocol.bus import DEFAULT_ENDPOINT, Bus
from protocol.calls import Describe
from protocol.clock import SYSTEM_CLOCK, Clock
from protocol.credentials import Credentials, Role
from protocol.endpoints import Endpoints, Mode, free_endpoint
from protocol.errors import (
    ConfigurationError,
    DeadlineError,
    DoublestepError,
    InterruptedRunError,
    SlaveLostError,
)
from protocol.keys import SlaveKey
from protocol.logs import add_log_fields
from protocol.slave import SlaveDescription
from protocol.zenoh_bus import ZenohBus

_DEATH_TIME = 1.0


@dataclass(frozen=True)
class Slaves:
    """The slaves of a run, instantiated, in the order of the system file.

    Attributes:
        links: to each of them.
        descriptions: what each said of itself.
        launcher: of those started here, None in process.
    """

    links: Mapping[str, SlaveLink]
    descriptions: Mapping[str, SlaveDescription]
    launcher: Launcher | None = None

    def explain(self, error: DoublestepError) -> DoublestepError:
        """A lost slave's error with the exit code and last words of its process, if it is ours."""
        if self.launcher is None or not isinstance(error, SlaveLostError):
            return error
        ended = self.launcher.wait_ended(error.slave, _DEATH_TIME)
        if ended is None:
            return error
        return SlaveLostError(ended.cause, remedy=ended.remedy).located(
            slave=error.slave, phase=error.phase, time=error.time, step_size=error.step_size
        )


@contextmanager
def slaves_in_process(system: System) -> Iterator[Slaves]:
    """All slaves in this process, without a bus.

    Raises:
        ConfigurationError: a slave has no model, or its model cannot be loaded.
    """
    load = entry_points(group="doublestep.in_process")["slave"].load()
    with ExitStack() as stack:
        links: dict[str, SlaveLink] = {}
        descriptions = {}
        for name, settings in system.slaves.items():
            if settings.model is None:
                raise ConfigurationError(
                    f"{system.source}: [slaves.{name}] has no model, so it cannot run in process"
                )
            scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="doublestep-"))
            try:
                executor = load(settings.model, system.base, name, Path(scratch))
            except DoublestepError as error:
                raise error.located(slave=name) from None
            stack.callback(executor.close)
            links[name] = LocalSlave(executor)
            descriptions[name] = executor.description
        yield Slaves(links, descriptions)


@contextmanager
def slaves_on_bus(system: System, log_directory: Path, *, launch: bool = True) -> Iterator[Slaves]:
    """Slaves over Zenoh: those with a model are started here, the others found by name.

    Args:
        system: what to run.
        log_directory: existing; gets the launched slaves' logs.
        launch: False: all slaves are expected on the bus.

    Raises:
        ConfigurationError: an address cannot be used, or a model cannot be loaded.
        SlaveLostError: a slave did not appear in time; says what was found.
        ProtocolError: two slaves of one name, or a slave held by another master.
    """
    launched = {n for n, s in system.slaves.items() if launch and s.model is not None}
    found = [name for name in system.slaves if name not in launched]
    private = free_endpoint()
    with ExitStack() as stack:
        endpoints = _endpoints(system, private, launched=bool(launched), found=bool(found))
        bus = ZenohBus(endpoints, timeout=system.bus.discovery_timeout)
        stack.callback(bus.close)
        run = token_hex(4)
        add_log_fields(run=run)
        announce_run(bus, run, system)
        launcher = stack.enter_context(
            Launcher(_connection(endpoints, private), log_directory, pin=system.bus.pin)
        )
        keys = {
            name: launcher.launch(name, str(system.slaves[name].model), system.base)
            for name in system.slaves
            if name in launched
        }
        presence = Presence(bus)
        keys |= presence.wait(found, keys, launcher, system.bus.discovery_timeout)

        def has_ended(remote: RemoteSlave) -> bool:
            return remote.has_ended or launcher.ended(remote.key.name) is not None

        remotes = stack.enter_context(
            claimed_slaves(
                bus,
                presence,
                {name: keys[name] for name in system.slaves},
                has_ended,
                run=run,
                step_timeout=system.bus.step_timeout,
                reconnect_time=system.bus.reconnect_time,
            )
        )
        slaves = Slaves(remotes, describe(remotes), launcher)
        try:
            yield slaves
        except (KeyboardInterrupt, InterruptedRunError):
            launcher.stop(at_once=True)
            raise
        except DoublestepError as error:
            if isinstance(error, DeadlineError) and error.slave in remotes:
                remotes[error.slave].abort()
            raise slaves.explain(error) from error.__cause__


@contextmanager
def claimed_slaves(
    bus: Bus,
    presence: Presence,
    keys: Mapping[str, SlaveKey],
    has_ended: Callable[[RemoteSlave], bool],
    *,
    run: str,
    step_timeout: float,
    reconnect_time: float,
    clock: Clock = SYSTEM_CLOCK,
) -> Iterator[dict[str, RemoteSlave]]:
    """Claim slaves for a run, look after them, and give them back at the end.

    Args:
        bus: on which they are.
        presence: follows their tokens.
        keys: their addresses by name, in the order in which they are claimed.
        has_ended: whether it is certain that a slave's process is no more.
        run: id of the run.
        step_timeout: bound on one request [s].
        reconnect_time: how long to wait for one that vanished [s].
        clock: for all waits.

    Raises:
        SlaveBusyError, SlaveLostError, DeadlineError: one cannot be claimed; names it.
    """
    with ExitStack() as stack:
        remotes: dict[str, RemoteSlave] = {}
        for name, key in keys.items():
            try:
                remotes[name] = RemoteSlave(
                    bus,
                    key,
                    run=run,
                    step_timeout=step_timeout,
                    reconnect_time=reconnect_time,
                    clock=clock,
                )
            except DoublestepError as error:
                raise error.located(slave=name, phase="claim") from None
            stack.callback(remotes[name].release)
        stack.enter_context(presence.guarded(list(remotes.values()), has_ended, reconnect_time))
        yield remotes


def describe(links: Mapping[str, SlaveLink]) -> dict[str, SlaveDescription]:
    """What each slave says of itself; raises what it answers instead, with its name."""
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
    words = []
    if endpoints.mode is Mode.CLIENT:
        words = ["--mode", "client"]
        words += [word for endpoint in endpoints.connect for word in ("--connect", endpoint)]
    else:
        words = ["--connect", private]
    if endpoints.insecure:
        words.append("--insecure")
    if endpoints.credentials is not None:
        words += ["--tls", str(endpoints.credentials.directory)]
    return words
