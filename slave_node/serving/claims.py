"""Claim on a slave, and the guard that lets every request take effect exactly once.

A master claims a slave for its run and gets an epoch, a number that cannot be guessed; each request
carries the epoch and a sequence number that grows by one. A repeated number gets the reply that was
stored, without a second effect; an old epoch is refused. No clock, no bus.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from hmac import compare_digest
from secrets import randbelow

from protocol.errors import SequenceError, SlaveBusyError
from protocol.wire.administration import DEFAULT_ORPHAN_TIME

_EPOCHS = 2**62


@dataclass(frozen=True, slots=True)
class Holder:
    """A master.

    Attributes:
        run: id of its run.
        host, pid: its process.
        since: wall-clock time of its claim, for people.
        orphan_time: how long it is waited for when it vanished [s].
        claimed: time of its claim in seconds since 1970.
        secret: who claims again for the same run must know it.
    """

    run: str
    host: str
    pid: int
    since: str
    orphan_time: float = DEFAULT_ORPHAN_TIME
    claimed: float = 0.0
    secret: str = field(default="", repr=False)

    def is_again(self, other: Holder) -> bool:
        """True when ``other`` is the same master, asking again."""
        secrets = (self.secret.encode("utf-8", "replace"), other.secret.encode("utf-8", "replace"))
        return self.run == other.run and compare_digest(*secrets)

    def __str__(self) -> str:
        return f"run {self.run} on {self.host} (pid {self.pid}) since {self.since}"


class Claims:
    """The present holder and its last request."""

    def __init__(self) -> None:
        self._holder: Holder | None = None
        self._epoch = 0
        self._sequence = 0
        self._reply = b""

    @property
    def holder(self) -> Holder | None:
        """Master that holds the slave, or None."""
        return self._holder

    @property
    def epoch(self) -> int:
        """The present epoch: drawn anew for each claim; 0 before the first."""
        return self._epoch

    def claim(self, holder: Holder) -> int:
        """Give the slave to ``holder``; the same master asking again gets the same epoch.

        Raises:
            SlaveBusyError: another master holds it.
        """
        if self._holder is not None:
            if self._holder.is_again(holder):
                return self._epoch
            raise SlaveBusyError(
                f"busy: held by {self._holder}",
                remedy="wait for that run to end, or start another slave under another name",
            )
        self._holder = holder
        self._epoch = 1 + randbelow(_EPOCHS)
        self._sequence = 0
        self._reply = b""
        return self._epoch

    def check(self, epoch: int) -> None:
        """Refuse whoever is not the present holder.

        Raises:
            SequenceError: ``epoch`` is not the present one, or the slave is not held.
        """
        if self._holder is None or epoch != self._epoch:
            held = f"held by {self._holder}" if self._holder else "not held"
            raise SequenceError(
                f"the request has epoch {epoch}, which is not the present one ({held}): the slave "
                "was given back, as its master was out of reach, or claimed again",
                remedy="start the run again",
            )

    def release(self, epoch: int) -> None:
        """Give the slave back.

        Raises:
            SequenceError: ``epoch`` is not the present one.
        """
        self.check(epoch)
        self._holder = None

    def admit(self, epoch: int, sequence: int) -> bytes | None:
        """Decision on a request: None to execute it, else the reply to give again.

        Raises:
            SequenceError: stale epoch, or neither the last sequence number nor the next.
        """
        self.check(epoch)
        if sequence == self._sequence + 1:
            return None
        if sequence == self._sequence and self._reply:
            return self._reply
        raise SequenceError(
            f"request {sequence} after request {self._sequence}: neither the next nor a repetition"
        )

    def record(self, sequence: int, reply: bytes) -> None:
        """Keep the reply to the request that was just executed."""
        self._sequence = sequence
        self._reply = reply
