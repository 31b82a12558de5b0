"""Masters that vanish: who is told of it, and when it is certain.

A master has a token on the bus as long as its run goes on. The bus tells when it goes away. It can
also be asked whether it is there, but on a busy host the answer may come too late: one empty answer
means nothing. A process of this host that has ended is not waited for.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar

from protocol.bus.bus import Bus
from protocol.errors import SlaveLostError
from protocol.host.clock import Clock, Timer
from protocol.host.processes import PeerProcess
from protocol.wire.keys import alive_master

log = logging.getLogger("slave_node")

_K = TypeVar("_K", bound=Hashable)

_PEER_TIME = 1.0
_PERIOD = 0.2  # a process that is just dying is soon known to be dead
_QUESTIONS = 3  # without an answer, where the bus never told of the master
_MOST_TOKENS = 4096


@dataclass(frozen=True)
class Master:
    """The master of a run.

    Attributes:
        run: its id.
        process: in which it runs.
        orphan_time: how long it is waited for when it vanished [s].
    """

    run: str
    process: PeerProcess
    orphan_time: float


@dataclass
class _Followed:
    """A master that is followed.

    Attributes:
        master: which.
        absent_since: by the clock.
        questions: how often it is still to be asked for in vain.
        look: the next one, if it is absent.
    """

    master: Master
    absent_since: float
    questions: int
    look: Timer | None = None

    @property
    def token(self) -> str:
        """Liveliness token of its run."""
        return alive_master(self.master.run)


class MasterWatch(Generic[_K]):
    """Follows masters by their runs.

    Args:
        bus: opened.
        clock: for its waits.
        gone: is told the key of one that is gone for good; on a thread of its own.
    """

    def __init__(self, bus: Bus, clock: Clock, gone: Callable[[_K], None]) -> None:
        self._bus = bus
        self._clock = clock
        self._gone = gone
        self._lock = clock.lock()
        self._tokens: set[str] = set()
        self._followed: dict[_K, _Followed] = {}

    def start(self) -> None:
        """Let the bus tell of masters from here on."""
        self._bus.watch(alive_master("*"), self._told)

    def follow(self, key: _K, master: Master) -> None:
        """Follow a master, in place of whoever was followed under this key."""
        with self._lock:
            self._forget(key)
            followed = _Followed(master, self._clock.monotonic(), _QUESTIONS)
            self._followed[key] = followed
            if followed.token not in self._tokens:  # it may have come and gone before
                self._look_again(key, followed)

    def forget(self, key: _K) -> None:
        """Follow it no more."""
        with self._lock:
            self._forget(key)

    def _forget(self, key: _K) -> None:
        followed = self._followed.pop(key, None)
        if followed is not None and followed.look is not None:
            followed.look.cancel()

    def _told(self, token: str, alive: bool) -> None:
        with self._lock:
            if not alive:
                self._tokens.discard(token)
            elif len(self._tokens) < _MOST_TOKENS:  # others are asked for
                self._tokens.add(token)
            meant = [(key, f) for key, f in self._followed.items() if f.token == token]
            for key, followed in meant:
                if followed.look is not None:
                    followed.look.cancel()
                    followed.look = None
                if not alive:
                    followed.absent_since, followed.questions = self._clock.monotonic(), 1
                    self._look_again(key, followed)
        for _, followed in meant:
            run = followed.master.run
            if alive:
                log.info("the master of run %s is there", run, extra={"run": run})
            else:
                log.warning("the master of run %s is gone", run, extra={"run": run})

    def _look_again(self, key: _K, followed: _Followed) -> None:
        """Look for the master again when it is late, or sooner where its process is here.

        The lock is held.
        """
        master = followed.master
        left = followed.absent_since + master.orphan_time - self._clock.monotonic()
        wait = left if left > 0.0 else _PERIOD
        if master.process.is_here:
            wait = min(wait, _PERIOD)
        followed.look = self._clock.later(wait, lambda: self._look(key, followed))

    def _look(self, key: _K, followed: _Followed) -> None:
        """See whether it is gone for good; the bus is asked without the lock."""
        master, since = followed.master, followed.absent_since
        has_ended = master.process.has_ended
        is_late = self._clock.monotonic() >= since + master.orphan_time
        is_there = is_late and not has_ended and self._is_on_bus(followed.token)
        with self._lock:
            is_followed = self._followed.get(key) is followed
            was_told = followed.token in self._tokens or followed.absent_since != since
            if not is_followed or was_told or is_there:  # when it goes, that is told
                return
            followed.questions -= is_late
            if not has_ended and followed.questions > 0:
                self._look_again(key, followed)
                return
            del self._followed[key]
        self._gone(key)

    def _is_on_bus(self, token: str) -> bool:
        try:
            return bool(self._bus.alive(token, _PEER_TIME))
        except SlaveLostError:  # the bus is closed: we are ending
            return True
