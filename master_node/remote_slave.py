"""A slave on the bus: claimed for a run, then driven by numbered requests."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence

from protocol.bus import Bus, Caller, PendingReply
from protocol.calls import Call, Reply
from protocol.codec import (
    decode_map,
    decode_reply,
    encode_map,
    encode_program,
    encode_request,
)
from protocol.errors import DoublestepError, SlaveLostError
from protocol.keys import ABORT, CLAIM, EXECUTE, RELEASE, STATUS, SlaveKey
from protocol.slave import StartValue

_CLAIM_TIME = 90.0  # a slave whose worker died loads its model again first
_GOODBYE_TIME = 0.3
_LIVELINESS_TIME = 0.5
_ATTEMPTS = 3


def slave_status(bus: Bus, key: SlaveKey) -> dict[str, StartValue]:
    """What a slave says of itself."""
    return decode_map(bus.caller(key.verb(STATUS), _LIVELINESS_TIME).request(b""))


class RemoteSlave:
    """Implements `SlaveLink` over a bus.

    Args:
        bus: opened.
        key: of the slave.
        run: id of the run that claims it.
        step_timeout: bound on one request [s].

    Raises:
        SlaveBusyError: another run holds the slave.
        SlaveLostError, DeadlineError: it does not answer.
    """

    def __init__(self, bus: Bus, key: SlaveKey, run: str, step_timeout: float) -> None:
        self._bus = bus
        self._key = key
        self._step_timeout = step_timeout
        self._execute = self._caller()
        self._sequence = 0
        self._calls: Sequence[Call] = ()
        self._payload = b""
        self._pending: PendingReply | None = None
        self._gone = ""
        claim: dict[str, StartValue] = {
            "run": run,
            "host": socket.gethostname(),
            "pid": os.getpid(),
        }
        answer = bus.caller(key.verb(CLAIM), _CLAIM_TIME).request(encode_map(claim))
        self._epoch = int(decode_map(answer)["epoch"])

    def _caller(self) -> Caller:
        return self._bus.caller(self._key.verb(EXECUTE), self._step_timeout)

    @property
    def key(self) -> SlaveKey:
        """Its address."""
        return self._key

    def start(self, calls: Sequence[Call]) -> None:
        """See `SlaveLink`."""
        self._sequence += 1
        self._calls = calls
        self._payload = encode_request(self._epoch, self._sequence, encode_program(calls))
        try:
            self._pending = self._execute.send(self._payload)
        except SlaveLostError:
            self._pending = None

    def finish(self) -> Reply:
        """See `SlaveLink`."""
        try:
            data = self._pending.result() if self._pending else None
        except SlaveLostError:
            data = None
        if data is None:
            data = self._ask_again()
        return decode_reply(self._calls, data)

    def _ask_again(self) -> bytes:
        """No reply can mean a connection that is just coming back: while the slave is alive the
        same number is sent again, which takes effect once at most.
        """
        for attempt in range(_ATTEMPTS):
            if not self._bus.alive(self._key.alive, _LIVELINESS_TIME):
                break
            self._execute = self._caller()  # the old one may have been cancelled
            if self._gone:
                break
            try:
                return self._execute.request(self._payload)
            except SlaveLostError:
                if attempt == _ATTEMPTS - 1:
                    raise
        raise SlaveLostError(
            "its process died or the connection to it was lost",
            slave=self._gone,
            remedy="see the slave's log for the reason",
        )

    def lost(self) -> None:
        """Its liveliness token went away: let pending waits end now."""
        self._execute.cancel()

    def abandon(self, gone: str) -> None:
        """Slave ``gone`` does not come back, and ends the run: wait for this one no more."""
        self._gone = gone
        self._execute.cancel()

    def release(self) -> None:
        """Give the slave back, in a bounded short time; errors do not matter any more."""
        self._goodbye(RELEASE)

    def abort(self) -> None:
        """Have it end a step that is under way."""
        self._goodbye(ABORT)

    def _goodbye(self, verb: str) -> None:
        try:
            caller = self._bus.caller(self._key.verb(verb), _GOODBYE_TIME)
            caller.request(encode_map({"epoch": self._epoch}))
        except DoublestepError:
            pass
