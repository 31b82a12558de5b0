"""Starts the slaves of a run again when their processes are gone."""

from __future__ import annotations

from collections.abc import Callable

from master_node.configuration import System
from master_node.launcher import Launcher
from master_node.presence import Presence
from master_node.remote_slave import RemoteSlave
from protocol.errors import ConfigurationError, DoublestepError, SlaveLostError
from protocol.keys import SlaveKey


class Restarts:
    """Gives a slave a new process: a new worker where its node still answers, else a new node.

    Args:
        system: what is run.
        remotes: the slaves by name; the present ones, kept up to date here.
        claim: claims the slave at a key for this run.
        launcher: of the slaves that were started here.
        presence: follows the slaves' tokens.
        launched: names of the slaves that were started here.
    """

    def __init__(  # noqa: PLR0917  what starting a slave takes
        self,
        system: System,
        remotes: dict[str, RemoteSlave],
        claim: Callable[[SlaveKey], RemoteSlave],
        launcher: Launcher,
        presence: Presence,
        launched: frozenset[str],
    ) -> None:
        self._system = system
        self._remotes = remotes
        self._claim = claim
        self._launcher = launcher
        self._presence = presence
        self._launched = launched

    def is_mine(self, name: str) -> bool:
        """Whether the slave of that name is one that can be started again here."""
        return name in self._launched

    def restart(self, name: str) -> RemoteSlave:
        """A slave as it was loaded first.

        Raises:
            DoublestepError: it is not to be had; waits for other slaves end then, too.
        """
        try:
            return self._restart(name)
        except DoublestepError as error:
            self._presence.abandon(name, error.cause)
            raise

    def _restart(self, name: str) -> RemoteSlave:
        remote = self._remotes[name]
        if remote.is_present:
            try:
                remote.renew()
            except DoublestepError:
                if name not in self._launched:
                    raise
            else:
                return remote
        if name not in self._launched:
            raise SlaveLostError("its process is gone, and it was not started by this master")
        model = self._system.slaves[name].model
        if model is None:
            raise ConfigurationError(f"[slaves.{name}] has no model to start")
        self._presence.forget(remote)
        key = self._launcher.launch(name, model, self._system.base)
        self._presence.wait_for(key, self._launcher, self._system.bus.discovery_timeout)
        self._remotes[name] = remote = self._claim(key)
        self._presence.follow(remote)
        return remote
