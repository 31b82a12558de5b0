"""Which slaves are on the bus: waiting for them at first, and for those that vanish in mid run."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress

from master_node.launcher import Launcher
from master_node.remote_slave import RemoteSlave, slave_status
from protocol.bus import Bus
from protocol.clock import SYSTEM_CLOCK, Clock
from protocol.errors import DoublestepError, ProtocolError, SlaveLostError
from protocol.keys import SlaveKey, alive_slaves

log = logging.getLogger("master_node")

_POLL_TIME = 0.02
_GRACE_TIME = 0.1  # a process that is just dying is soon known to be dead
_LIVELINESS_TIME = 1.0
_END_TIME = 5.0


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
        self, names: list[str], keys: Mapping[str, SlaveKey], launcher: Launcher, timeout: float
    ) -> dict[str, SlaveKey]:
        """Wait until slaves called ``names`` and those at ``keys`` are alive.

        Returns:
            The keys of the slaves called ``names``.

        Raises:
            SlaveLostError: a slave did not appear within ``timeout`` seconds; says what was found.
            ModelError, SlaveLostError: a launched one ended.
            ProtocolError: two slaves of one name.
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

    @contextmanager
    def guarded(
        self,
        remotes: list[RemoteSlave],
        has_ended: Callable[[RemoteSlave], bool],
        reconnect_time: float,
    ) -> Iterator[None]:
        """Look after the slaves of a run: tell them when their token goes and comes.

        One that stays away ends the run, however long the steps of the others take.

        Args:
            remotes: the slaves.
            has_ended: whether it is certain that a slave's process is no more.
            reconnect_time: how long to wait for one that vanished [s].
        """
        with self._changed:
            self._remotes = {remote.key: remote for remote in remotes}
            lost = [remote for remote in remotes if remote.key not in self._alive]
        for remote in lost:
            remote.lost()
        guard = self._clock.start(lambda: self._guard(has_ended, reconnect_time), "presence")
        try:
            yield
        finally:
            with self._changed:
                self._remotes = {}
                self._changed.notify_all()
            guard.join(_END_TIME)

    def _guard(self, has_ended: Callable[[RemoteSlave], bool], reconnect_time: float) -> None:
        since: dict[str, float] = {}
        warned: set[str] = set()
        while True:
            with self._changed:
                absent = self._absent()
                if self._remotes and not absent and not since:
                    self._changed.wait()
                    continue
                if not self._remotes:
                    return
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
                if has_ended(remote):
                    self._abandon(remote.key.name, "its process died")
                    return
                if now - since[remote.key.name] > reconnect_time:
                    self._abandon(
                        remote.key.name,
                        f"the connection to it was lost and did not come back within "
                        f"{reconnect_time:g} s",
                    )
                    return
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

    def _abandon(self, slave: str, cause: str) -> None:
        with self._changed:
            remotes = list(self._remotes.values())
        for remote in remotes:
            remote.abandon(slave, cause)
