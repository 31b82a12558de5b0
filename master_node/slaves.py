"""From the system's slaves to links: launched here, found on the bus, or in this process.

Each way is a context manager that gives a `Slaves` and leaves nothing running behind it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from secrets import token_hex

from master_node.configuration import System
from master_node.launcher import Launcher
from master_node.remote_slave import RemoteSlave, slave_status
from master_node.slave_link import LocalSlave, SlaveLink
from protocol.bus import DEFAULT_ENDPOINT, Bus
from protocol.calls import Describe
from protocol.clock import SYSTEM_CLOCK, Clock
from protocol.errors import (
    ConfigurationError,
    DeadlineError,
    DoublestepError,
    InterruptedRunError,
    ProtocolError,
    SlaveLostError,
)
from protocol.keys import SlaveKey, alive_master, alive_slaves
from protocol.slave import SlaveDescription
from protocol.zenoh_bus import Endpoints, ZenohBus, free_endpoint

_POLL_TIME = 0.02
_RETURN_TIME = 0.5
_DEATH_TIME = 1.0
_LIVELINESS_TIME = 1.0


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
        bus = ZenohBus(_endpoints(system, private, launched=bool(launched), found=bool(found)))
        stack.callback(bus.close)
        run = token_hex(4)
        bus.announce(alive_master(run))
        launcher = stack.enter_context(Launcher(private, log_directory, pin=system.bus.pin))
        keys = {
            name: launcher.launch(name, str(system.slaves[name].model), system.base)
            for name in system.slaves
            if name in launched
        }
        presence = Presence(bus)
        keys |= presence.wait(found, keys, launcher, system.bus.discovery_timeout)
        keys = {name: keys[name] for name in system.slaves}
        remotes = stack.enter_context(
            claimed_slaves(bus, presence, keys, run=run, step_timeout=system.bus.step_timeout)
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
    *,
    run: str,
    step_timeout: float,
) -> Iterator[dict[str, RemoteSlave]]:
    """Claim slaves for a run, be told when one vanishes, and give them back at the end.

    Args:
        bus: on which they are.
        presence: follows their tokens.
        keys: their addresses by name, in the order in which they are claimed.
        run: id of the run.
        step_timeout: bound on one request [s].

    Raises:
        SlaveBusyError, SlaveLostError, DeadlineError: one cannot be claimed; names it.
    """
    with ExitStack() as stack:
        remotes: dict[str, RemoteSlave] = {}
        for name, key in keys.items():
            try:
                remotes[name] = RemoteSlave(bus, key, run, step_timeout)
            except DoublestepError as error:
                raise error.located(slave=name, phase="claim") from None
            stack.callback(remotes[name].release)
        presence.on_loss({remote.key.alive: remote for remote in remotes.values()})
        stack.callback(presence.on_loss, {})
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
    listen = list(system.bus.listen)
    if found and not listen and not system.bus.connect:
        listen.append(DEFAULT_ENDPOINT)
    if launched:
        listen.append(private)
    try:
        return Endpoints(tuple(listen), tuple(system.bus.connect), system.bus.insecure)
    except ConfigurationError as error:
        raise ConfigurationError(
            f"{system.source}: [bus] {error.cause}", remedy=error.remedy
        ) from None


class Presence:
    """Which slaves are on the bus, as their liveliness tokens come and go.

    Args:
        bus: opened.
        clock: for its waits.
    """

    def __init__(self, bus: Bus, clock: Clock = SYSTEM_CLOCK) -> None:
        self._bus = bus
        self._clock = clock
        self._changed = clock.condition()
        self._alive: set[SlaveKey] = set()
        self._remotes: Mapping[str, RemoteSlave] = {}
        bus.watch(alive_slaves(), self._told)

    def _told(self, key: str, alive: bool) -> None:
        slave = SlaveKey.from_alive(key)
        if slave is None:
            return
        with self._changed:
            (self._alive.add if alive else self._alive.discard)(slave)
            self._changed.notify_all()
        remote = self._remotes.get(key)
        if remote is not None and not alive:
            self._lost(remote)

    def on_loss(self, remotes: Mapping[str, RemoteSlave]) -> None:
        """From now on tell these slaves' links when their token goes away."""
        with self._changed:
            self._remotes = remotes
            lost = [remote for remote in remotes.values() if remote.key not in self._alive]
        for remote in lost:
            self._lost(remote)

    def _lost(self, remote: RemoteSlave) -> None:
        remote.lost()
        self._clock.later(_RETURN_TIME, lambda: self._abandon(remote.key))

    def _abandon(self, gone: SlaveKey) -> None:
        """A slave that stays away ends the run, however long the steps of the others take."""
        with self._changed:
            remotes = [] if gone in self._alive else list(self._remotes.values())
        for remote in remotes:
            remote.abandon(gone.name)

    def wait(
        self, names: list[str], keys: Mapping[str, SlaveKey], launcher: Launcher, timeout: float
    ) -> dict[str, SlaveKey]:
        """Wait until slaves called ``names`` and those at ``keys`` are alive.

        Returns:
            The keys of the slaves called ``names``.
        """
        deadline = self._clock.monotonic() + timeout
        while True:
            launcher.check()
            with self._changed:
                alive = set(self._alive)
            missing = [n for n in names if not any(k.name == n for k in alive)]
            missing += [name for name, key in keys.items() if key not in alive]
            found = {} if missing else self._only_instances((*names, *keys))
            missing = missing or [name for name in names if name not in found]
            if not missing:
                return {name: found[name] for name in names}
            if self._clock.monotonic() > deadline:
                raise self._not_found(missing, alive, timeout)
            with self._changed:
                self._changed.wait(_POLL_TIME)

    def _only_instances(self, names: Sequence[str]) -> dict[str, SlaveKey]:
        """Asked for now: the one slave of each name; none of one that has just gone again."""
        found = {}
        for name in names:
            tokens = self._bus.alive(alive_slaves(name), _LIVELINESS_TIME)
            instances = [k for k in map(SlaveKey.from_alive, tokens) if k is not None]
            if len(instances) > 1:
                raise ProtocolError(
                    f"{len(instances)} instances of {name!r}: "
                    + ", ".join(self._whereabouts(k) for k in instances),
                    slave=name,
                    remedy="end all but one of them",
                )
            if instances:
                found[name] = instances[0]
        return found

    @staticmethod
    def _not_found(missing: list[str], alive: set[SlaveKey], timeout: float) -> SlaveLostError:
        there = ", ".join(sorted({k.name for k in alive})) or "no slave at all"
        return SlaveLostError(
            f"did not appear within {timeout:g} s; found on the bus: {there}",
            slave=", ".join(missing),
            phase="discovery",
            remedy="start it with `slave-node serve MODEL --name NAME`, or check --connect "
            "and --listen on both sides",
        )

    def _whereabouts(self, key: SlaveKey) -> str:
        with suppress(DoublestepError):
            status = slave_status(self._bus, key)
            return f"{status.get('host')!s}/{status.get('pid')!s}"
        return key.instance
