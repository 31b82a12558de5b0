"""A slave on the bus: claimed for a run, then driven by numbered requests."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from contextlib import suppress
from secrets import token_hex

from master_node.slaves.request_bounds import RequestBounds, RequestClock
from protocol.bus.bus import Bus, Caller, PendingReply
from protocol.calls import Call, Reply, Terminate
from protocol.errors import DeadlineError, DoublestepError, SequenceError, SlaveLostError
from protocol.host.clock import SYSTEM_CLOCK, Clock
from protocol.host.processes import PeerProcess
from protocol.variables import StartValue
from protocol.wire.administration import Claim, Claimed, claim_name
from protocol.wire.keys import ABORT, CLAIM, EXECUTE, RELEASE, STATUS, SlaveKey
from protocol.wire.programs import encode_program, encode_request
from protocol.wire.records import decode_map, encode_map
from protocol.wire.replies import decode_reply

_CLAIM_MARGIN = 5.0
_RELEASE_TIME = 5.0
_GOODBYE_TIME = 0.3
_STATUS_TIME = 0.5
_PAUSE = 0.02
_ORPHAN_MARGIN = 5.0
_LOSS_MARGIN = 1.0  # who watches the tokens says it earlier, and of whom


def orphan_time(reconnect_time: float) -> float:
    """Time for which a slave waits for a master that waits ``reconnect_time`` for it [s]."""
    return reconnect_time + _ORPHAN_MARGIN


def slave_status(bus: Bus, key: SlaveKey) -> dict[str, StartValue]:
    """Description that a slave gives of itself."""
    return decode_map(bus.caller(key.verb(STATUS), _STATUS_TIME).request(b""))


class RemoteSlave:
    """Implements `SlaveLink` over a bus.

    A request without a reply is sent again with the same number, so it takes effect once, however
    often the connection is lost.

    Args:
        bus: opened.
        key: of the slave.
        run: id of the run that claims it.
        bounds: on its requests, by what they have it do. A claim may take as long as loading.
        reconnect_time: how long in all a request waits for a slave that is not on the bus [s].
            The slave is told to wait longer than that for its master.
        clock: for its waits.

    Attributes:
        host: of its process.

    Raises:
        SlaveBusyError: another run holds the slave.
        SlaveLostError, DeadlineError: it does not answer.
    """

    def __init__(
        self,
        bus: Bus,
        key: SlaveKey,
        *,
        run: str,
        bounds: RequestBounds,
        reconnect_time: float,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._bus = bus
        self._key = key
        self._load_timeout = bounds.load_timeout
        self._bounds = RequestClock(bounds)
        self._reconnect_time = reconnect_time
        self._clock = clock
        self._changed = clock.condition()
        self._is_present = True
        self._loss: tuple[str, str] | None = None
        self._callers: dict[float, Caller] = {}
        self._calls: Sequence[Call] = ()
        self._bound = self._bounds.bound(())
        self._payload = b""
        self._pending: PendingReply | None = None
        wait = orphan_time(reconnect_time)
        self._claim = Claim(run, socket.gethostname(), os.getpid(), wait, token_hex(16))
        self._take()

    def _take(self) -> None:
        """Claim it: it is reset for that, or its model is loaded again."""
        caller = self._bus.caller(self._key.verb(CLAIM), self._load_timeout + _CLAIM_MARGIN)
        try:
            data = caller.request(encode_map(self._claim.to_message()))
        except DeadlineError as error:
            error.remedy = "if the model is only slow to load, raise load_timeout in [bus]"
            raise
        claimed = Claimed.from_message(decode_map(data))
        self._epoch, self._claim_name = claimed.epoch, claim_name(claimed.epoch)
        self._sequence = 0
        self._process = PeerProcess(claimed.host, claimed.pid)
        self.host = claimed.host

    def _caller(self) -> Caller:
        """The caller for requests with the bound of the present one; it may be cancelled."""
        seconds = self._bound.seconds
        caller = self._callers.get(seconds)
        if caller is None:
            caller = self._new_caller()
            with self._changed:
                self._callers[seconds] = caller  # from here on a loss cancels it
                is_lost = not self.is_present
            if is_lost:
                caller.cancel()
        return caller

    def _new_caller(self) -> Caller:
        return self._bus.caller(self._key.verb(EXECUTE), self._bound.seconds)

    def _cancel(self) -> None:
        """End what waits for a reply."""
        with self._changed:
            callers = list(self._callers.values())
        for caller in callers:
            caller.cancel()

    @property
    def key(self) -> SlaveKey:
        """Its address."""
        return self._key

    @property
    def is_present(self) -> bool:
        """True if its liveliness token is there."""
        return self._is_present and self._loss is None

    @property
    def has_ended(self) -> bool:
        """True when its process was on this host and is no more; False: it may live."""
        return self._process.has_ended

    @property
    def request(self) -> str:
        """See `SlaveLink`."""
        return f"{self._claim_name}:{self._sequence}"

    def start(self, calls: Sequence[Call]) -> None:
        """See `SlaveLink`."""
        self._sequence += 1
        self._calls = calls
        self._bound = self._bounds.bound(calls)
        self._payload = encode_request(self._epoch, self._sequence, encode_program(calls))
        try:
            self._pending = self._caller().send(self._payload)
        except SlaveLostError:
            self._pending = None

    def finish(self) -> Reply:
        """See `SlaveLink`."""
        try:
            data = self._answer()
        except DeadlineError as error:
            error.remedy = self._bound.remedy
            if type(self._calls[0]) is Terminate:
                self.abort()  # nothing follows that would
            raise
        reply = decode_reply(self._calls, data)
        self._bounds.took(reply)
        return reply

    def _answer(self) -> bytes:
        if self._pending is not None:
            with suppress(SlaveLostError):
                return self._pending.result()
        return self._ask_again()

    def _ask_again(self) -> bytes:
        """No reply means a connection that was lost, or one that is just coming back."""
        left = self._reconnect_time + _LOSS_MARGIN
        while True:
            begin = self._clock.monotonic()
            caller = self._caller_when_present(left)
            left -= self._clock.monotonic() - begin + _PAUSE
            try:
                return caller.request(self._payload)
            except SlaveLostError:
                self._clock.sleep(_PAUSE)

    def _caller_when_present(self, timeout: float) -> Caller:
        """Wait until the slave is on the bus; the old caller may have been cancelled."""
        with self._changed:
            came = self._changed.wait_for(lambda: self._is_present or self._loss, max(timeout, 0.0))
        caller = self._new_caller()
        with self._changed:
            self._callers = {self._bound.seconds: caller}  # from here on a loss cancels this one
            if self._loss is not None:
                slave, cause = self._loss
                raise SlaveLostError(cause, slave=slave, remedy=_REMEDY)
        if not came or timeout <= 0.0:
            raise SlaveLostError(
                f"did not answer within the reconnect_time of {self._reconnect_time:g} s",
                remedy=_REMEDY,
            )
        return caller

    def lost(self) -> None:
        """Its liveliness token went away: let pending waits end now."""
        with self._changed:
            self._is_present = False
        self._cancel()

    def returned(self) -> None:
        """Its liveliness token is there again."""
        with self._changed:
            self._is_present = True
            self._changed.notify_all()

    def abandon(self, slave: str, cause: str) -> None:
        """The run ends because of ``slave``: wait no more, neither for that one nor for this."""
        with self._changed:
            self._loss = (slave, cause)
            self._changed.notify_all()
        self._cancel()

    def renew(self) -> None:
        """Have its worker replaced by a new one that holds the model as it was loaded first.

        Raises:
            DoublestepError: the slave is gone, or its model cannot be loaded any more.
        """
        self.abort()
        caller = self._bus.caller(self._key.verb(RELEASE), _RELEASE_TIME)
        with suppress(SequenceError):  # it was given back already, when we were out of reach
            decode_map(caller.request(encode_map({"epoch": self._epoch})))
        self._take()

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


_REMEDY = "see the slave's log for the reason"
