"""Starts the slaves of a run again when their processes are gone."""

from __future__ import annotations

from collections.abc import Callable

from master_node.hosts.launcher import Starter
from master_node.hosts.presence import Presence
from master_node.slaves.remote import RemoteSlave
from master_node.system.system import System
from protocol.errors import DoublestepError, SlaveLostError
from protocol.wire.keys import SlaveKey


class Restarts:
    """Gives a slave a new process: a new worker where its node still answers, else a new node.

    Args:
        system: what is run.
        remotes: the slaves by name; the present ones, kept up to date here.
        claim: claims the slave at a key for this run.
        start: starts a slave of this run once more, here or by an agent; gives its address, and who
            can say what becomes of it.
        presence: follows the slaves' tokens.
        started: names of the slaves that were started for this run.
    """

    def __init__(  # noqa: PLR0917  what starting a slave takes
        self,
        system: System,
        remotes: dict[str, RemoteSlave],
        claim: Callable[[SlaveKey], RemoteSlave],
        start: Callable[[str], tuple[SlaveKey, Starter]],
        presence: Presence,
        started: frozenset[str],
    ) -> None:
        self._system = system
        self._remotes = remotes
        self._claim = claim
        self._start = start
        self._presence = presence
        self._started = started

    def is_mine(self, name: str) -> bool:
        """True if the slave of that name is one that can be started again here."""
        return name in self._started

    def restart(self, name: str) -> RemoteSlave:
        """A slave as it was loaded first.

        Raises:
            DoublestepError: it cannot be had now; a second attempt may succeed.
        """
        remote = self._remotes[name]
        if remote.is_present:
            try:
                remote.renew()
            except DoublestepError:
                if name not in self._started:
                    raise
            else:
                return remote
        if name not in self._started:
            raise SlaveLostError("its process is gone, and it was not started for this run")
        self._presence.forget(remote)
        key, starter = self._start(name)
        self._presence.wait_for(key, starter, float(self._system.bus.load_timeout))
        self._remotes[name] = remote = self._claim(key)
        self._presence.follow(remote)
        return remote

    def give_up(self, name: str, cause: str) -> None:
        """The slave is lost for good: waits for other slaves end, too."""
        self._presence.abandon(name, cause)
