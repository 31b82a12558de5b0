"""Slaves on the bus: the wait for them at first, and for those that vanish in mid run."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress

from master_node.hosts.launcher import Starter
from master_node.slaves.remote import RemoteSlave, slave_status
from protocol.bus.bus import Bus
from protocol.errors import DeadlineError, DoublestepError, ProtocolError, SlaveLostError
from protocol.host.clock import SYSTEM_CLOCK, Clock
from protocol.text.names import some
from protocol.wire.keys import SlaveKey, alive_slaves

log = logging.getLogger("master_node")

_POLL_TIME = 0.02
_GRACE_TIME = 0.1  # a process that is just dying is soon known to be dead
_LIVELINESS_TIME = 1.0
_END_TIME = 5.0
_START_TIME = 15.0  # of a process, before it loads its model, and which says itself if that is late
_SHOWN_INSTANCES = 4


class Presence:
    """Follows the liveliness tokens of slaves.

    Args:
        bus: opened.
        clock: for its waits.
    """

    def __init__(self, bus: Bus, clock: Clock = SYSTEM_CLOCK) -> None:
        self._bus = bus
        self._clock = clock
        self._changed = clock.condition()
        self._alive: set[SlaveKey] = set()
        self._remotes: Mapping[SlaveKey, RemoteSlave] = {}
        self._is_guarded = False
        bus.watch(alive_slaves(), self._told)

    def _told(self, key: str, alive: bool) -> None:
        slave = SlaveKey.from_alive(key)
        if slave is None:
            return
        with self._changed:
            (self._alive.add if alive else self._alive.discard)(slave)
            remote = self._remotes.get(slave)
            self._changed.notify_all()
        if remote is not None:
            (remote.returned if alive else remote.lost)()

    def wait(
        self,
        names: list[str],
        keys: Mapping[str, SlaveKey],
        starters: Sequence[Starter],
        *,
        discovery_timeout: float,
        load_timeout: float,
    ) -> dict[str, SlaveKey]:
        """Wait until slaves called ``names`` and those at ``keys``, which were started, are alive.

        Args:
            names: of slaves that are found.
            keys: of slaves that were started, by name.
            starters: of these.
            discovery_timeout: bound on the wait for those that are found [s].
            load_timeout: the others may take so long to load their models [s].

        Returns:
            The keys of the slaves called ``names``.

        Raises:
            SlaveLostError: a slave did not appear in time; says what was found.
            ModelError, SlaveCrashedError, SlaveLostError: one that was started ended.
            ProtocolError: two slaves are found by one name.
        """
        begin = self._clock.monotonic()
        while True:
            for starter in starters:
                starter.check()
            with self._changed:
                alive = set(self._alive)
            missing = [n for n in names if not any(_is_called(n, k) for k in alive)]
            loading = [name for name, key in keys.items() if key not in alive]
            if not missing and not loading:
                found = self._only_instances(names)
                missing = [name for name in names if name not in found]
                if not missing:
                    return found
            waited = self._clock.monotonic() - begin
            if missing and waited > discovery_timeout:
                raise self._not_found(missing, alive, discovery_timeout)
            if loading and waited > load_timeout + _START_TIME:
                raise self._not_loaded(loading, load_timeout)
            with self._changed:
                self._changed.wait(_POLL_TIME)

    def _only_instances(self, names: Sequence[str]) -> dict[str, SlaveKey]:
        """Asked for now: the one slave of each name; none of one that has just gone again."""
        found = {}
        for name in names:
            tokens = self._bus.alive(alive_slaves(name), _LIVELINESS_TIME)
            keys_there = (k for k in map(SlaveKey.from_alive, tokens) if k is not None)
            instances = [k for k in keys_there if _is_called(name, k)]
            if len(instances) > 1:
                places = [self._whereabouts(k) for k in instances[:_SHOWN_INSTANCES]]
                more = ", ..." if len(instances) > _SHOWN_INSTANCES else ""
                raise ProtocolError(
                    f"{len(instances)} instances of {name!r}: {', '.join(places)}{more}",
                    slave=name,
                    remedy="end all but one of them",
                )
            if instances:
                found[name] = instances[0]
        return found

    def wait_for(self, key: SlaveKey, starter: Starter, load_timeout: float) -> None:
        """Wait until a slave that was started again is alive.

        Raises:
            DeadlineError: it was not loaded within ``load_timeout`` seconds.
            SlaveLostError: it ended.
            ModelError: it ended because its model cannot be used.
        """
        deadline = self._clock.monotonic() + load_timeout + _START_TIME
        while True:
            error = starter.ended(key.name)  # may ask another host: not while tokens are told of
            with self._changed:
                if key in self._alive:
                    return
                if error is not None:
                    raise error
                if self._clock.monotonic() > deadline:
                    raise self._not_loaded([key.name], load_timeout)
                self._changed.wait(_POLL_TIME)

    def follow(self, remote: RemoteSlave) -> None:
        """Look after a slave that was started again, too."""
        with self._changed:
            self._remotes = {**self._remotes, remote.key: remote}
            is_lost = remote.key not in self._alive
            self._changed.notify_all()
        if is_lost:
            remote.lost()

    @staticmethod
    def _not_found(missing: list[str], alive: set[SlaveKey], timeout: float) -> SlaveLostError:
        there = some(sorted({k.name for k in alive})) or "no slave at all"
        return SlaveLostError(
            f"did not appear within {timeout:g} s; found on the bus: {there}",
            slave=", ".join(missing),
            phase="discovery",
            remedy="start it with `slave-node serve MODEL --name NAME`, check --connect and "
            "--listen on both sides, or wait longer with --timeout",
        )

    @staticmethod
    def _not_loaded(loading: list[str], timeout: float) -> DeadlineError:
        return DeadlineError(
            f"the model was not loaded within {timeout:g} s",
            slave=", ".join(loading),
            phase="load",
            remedy="look into its log; if it is only slow, raise load_timeout in [bus]",
        )

    def _whereabouts(self, key: SlaveKey) -> str:
        with suppress(DoublestepError):
            status = slave_status(self._bus, key)
            return f"{status.get('host')!s}/{status.get('pid')!s}"
        return key.instance

    @contextmanager
    def guarded(
        self,
        remotes: list[RemoteSlave],
        why_ended: Callable[[RemoteSlave], str],
        reconnect_time: float,
        can_restart: Callable[[str], bool] = lambda _: False,
    ) -> Iterator[None]:
        """Look after the slaves of a run: tell them when their token goes and comes.

        One that stays away ends the run, however long the steps of the others take, unless it can
        be started again.

        Args:
            remotes: the slaves.
            why_ended: why a slave's process is no more; "": it may live.
            reconnect_time: how long to wait for one that vanished [s].
            can_restart: whether the slave of a name can be started again: then it alone is told.
        """
        with self._changed:
            self._remotes = {remote.key: remote for remote in remotes}
            self._is_guarded = True
            lost = [remote for remote in remotes if remote.key not in self._alive]
        for remote in lost:
            remote.lost()
        guard = self._clock.start(
            lambda: self._guard(why_ended, reconnect_time, can_restart), "presence"
        )
        try:
            yield
        finally:
            with self._changed:
                self._remotes, self._is_guarded = {}, False
                self._changed.notify_all()
            guard.join(_END_TIME)

    def _guard(
        self,
        why_ended: Callable[[RemoteSlave], str],
        reconnect_time: float,
        can_restart: Callable[[str], bool],
    ) -> None:
        since: dict[str, float] = {}
        warned: set[str] = set()
        while True:
            with self._changed:
                absent = self._absent()
                if not self._is_guarded:
                    return
                if not absent and not since:
                    self._changed.wait()
                    continue
            now = self._clock.monotonic()
            names = {remote.key.name for remote in absent}
            if back := sorted(warned - names):
                away = max(now - since[name] for name in back)
                names_back = ", ".join(back)
                about = {"slave": names_back}
                log.info("the connection to %s is back after %.1f s", names_back, away, extra=about)
            since = {name: since.get(name, now) for name in names}
            warned &= names
            for remote in absent:
                name = remote.key.name
                cause = why_ended(remote)
                if not cause:
                    if now - since[name] <= reconnect_time:
                        continue
                    cause = (
                        "the connection to it was lost and did not come back within "
                        f"{reconnect_time:g} s"
                    )
                if not can_restart(name):
                    self.abandon(name, cause)
                    return
                self.forget(remote)
                remote.abandon(name, cause)
                names.discard(name)
                warned.discard(name)
                since.pop(name)
            late = {name for name in names if now - since[name] > _GRACE_TIME} - warned
            if late:
                log.warning(
                    "the connection to %s was lost; waiting for it, %g s at most (reconnect_time)",
                    ", ".join(sorted(late)),
                    reconnect_time,
                    extra={"slave": ", ".join(sorted(late))},
                )
                warned |= late
            with self._changed:
                self._changed.wait(_POLL_TIME)

    def _absent(self) -> list[RemoteSlave]:
        return [remote for key, remote in self._remotes.items() if key not in self._alive]

    def forget(self, remote: RemoteSlave) -> None:
        """Another one will take its place."""
        with self._changed:
            self._remotes = {key: r for key, r in self._remotes.items() if r is not remote}

    def abandon(self, slave: str, cause: str) -> None:
        """The run ends because of ``slave``: no wait for another one goes on."""
        with self._changed:
            remotes = list(self._remotes.values())
        for remote in remotes:
            remote.abandon(slave, cause)


def _is_called(name: str, key: SlaveKey) -> bool:
    """True if a slave is found by ``name``; those that were started for a run are not."""
    return key.name == name and not key.is_of_run
