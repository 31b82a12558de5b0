"""The node: what a slave offers on the bus. Holds the bus and no model; always answers status.

Knows no transport: it takes a `Bus` and a `Worker`. Requests are executed one at a time, in the
order in which they came; ``status`` and ``abort`` are answered beside them.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Mapping
from datetime import datetime

from protocol.bus.bus import Bus
from protocol.bus.room import Room
from protocol.calls import CALLS, Call, Reply, Reset
from protocol.description import SlaveDescription
from protocol.errors import (
    ConfigurationError,
    DoublestepError,
    MalformedMessageError,
    SequenceError,
    SlaveBusyError,
    SlaveCrashedError,
)
from protocol.host.clock import SYSTEM_CLOCK, Clock
from protocol.host.processes import PeerProcess
from protocol.variables import StartValue
from protocol.wire.administration import (
    DEFAULT_LOAD_TIMEOUT,
    DEFAULT_ORPHAN_TIME,
    Claim,
    Claimed,
    SlaveStatus,
    claim_name,
)
from protocol.wire.keys import (
    ABORT,
    CLAIM,
    EXECUTE,
    RELEASE,
    STATUS,
    SlaveKey,
    alive_slaves,
)
from protocol.wire.packing import MAX_MESSAGE_BYTES, PROTOCOL_VERSION
from protocol.wire.programs import decode_request, decode_single, encode_program
from protocol.wire.records import decode_map, encode_error_map, encode_map
from protocol.wire.replies import decode_reply, encode_error, encode_single_reply
from slave_node.serving.claims import Claims, Holder
from slave_node.serving.master_watch import Master, MasterWatch
from slave_node.worker.process import Worker

log = logging.getLogger("slave_node")

_PEER_TIME = 1.0
_ROOM = MAX_MESSAGE_BYTES + 2**20
"""For the requests of masters, and for all verbs by hand: one of the largest, or many [bytes]."""


class SlaveNode:
    """One slave on the bus.

    Args:
        bus: opened; the caller closes it.
        worker: started; the caller stops it.
        key: name and instance.
        description: of the slave that ``worker`` holds.
        orphan_time: a slave whose master vanished without release resets itself after this [s],
            unless the master's claim says after how long.
        load_timeout: a reset that takes longer is ended, and the model is loaded anew [s].
        clock: for its waits and locks.
    """

    def __init__(
        self,
        bus: Bus,
        worker: Worker,
        key: SlaveKey,
        description: SlaveDescription,
        orphan_time: float = DEFAULT_ORPHAN_TIME,
        *,
        load_timeout: float = DEFAULT_LOAD_TIMEOUT,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._bus = bus
        self._worker = worker
        self._key = key
        self._description = description
        self._orphan_time = orphan_time
        self._load_timeout = load_timeout
        self._clock = clock
        self._claims = Claims()
        self._masters = MasterWatch(bus, clock, self._free_orphan)
        self._running = clock.lock()
        self._worker_alive = True
        self._since = time.time()

    def serve(self) -> None:
        """Serve until the bus is closed; the token goes up last: alive means serving.

        Raises:
            ConfigurationError: a slave of this name is on the bus already.
        """
        others = [] if self._key.is_of_run else self._others()
        if others:
            raise ConfigurationError(
                f"a slave named {self._key.name!r} is on the bus already: {', '.join(others)}",
                remedy="end it, or serve this one under another --name",
            )
        key = self._key
        self._bus.serve(key.verb(STATUS), self._status)
        self._bus.serve(key.verb(ABORT), self._abort)
        self._bus.serve(key.verb(CLAIM), self._claim)
        self._bus.serve(key.verb(RELEASE), self._release)
        by_hand = Room(_ROOM)
        for call in CALLS:
            self._bus.serve(key.verb(call.verb), self._single(call), by_hand)
        self._masters.start()
        self._bus.serve_here(key.verb(EXECUTE), self._execute, self._announce, Room(_ROOM))

    def _others(self) -> list[str]:
        """The tokens of slaves that are found by the same name."""
        tokens = self._bus.alive(alive_slaves(self._key.name), _PEER_TIME)
        return [t for t in tokens if not ((key := SlaveKey.from_alive(t)) and key.is_of_run)]

    @property
    def busy(self) -> bool:
        """True if a request is being executed now."""
        return self._running.locked()

    def _announce(self) -> None:
        self._bus.announce(self._key.alive)
        log.info("ready: %s, instance %s", self._description.kind, self._key.instance)

    def _execute(self, data: bytes) -> bytes:
        """A request of the holder: the hot path."""
        with self._running:
            try:
                epoch, sequence, program = decode_request(data)
                again = self._claims.admit(epoch, sequence)
                if again is not None:
                    return again
                reply = self._run(program, epoch, sequence)
                self._claims.record(sequence, reply)
            except DoublestepError as error:
                return encode_error(error)
            return reply

    def _run(self, program: bytes, epoch: int = 0, sequence: int = 0) -> bytes:
        """Execute a program, that of a request or, without a number, one of the node's own."""
        try:
            return self._worker.execute(program)
        except SlaveCrashedError as error:
            if self._worker_alive:
                request = f"{claim_name(epoch)}:{sequence}" if sequence else ""
                log.error("%s", error, extra={"request": request, **_about(self._claims.holder)})
            self._worker_alive = False
            return encode_error(error)

    def _single(self, cls: type[Call]) -> Callable[[bytes], bytes]:
        """A verb by hand, while no master holds the slave."""

        def handle(data: bytes) -> bytes:
            with self._running:
                try:
                    holder = self._claims.holder
                    if holder is not None:
                        raise SlaveBusyError(f"busy: held by {holder}", phase=cls.verb)
                    call = decode_single(cls, data)
                    self._revive()
                    reply = decode_reply([call], self._run(encode_program([call])))
                except DoublestepError as error:
                    reply = Reply([], error, 0.0)
                return encode_single_reply(reply)

        return handle

    def _revive(self) -> None:
        """A worker that died is started again, with the model as it was loaded first."""
        if not self._worker_alive:
            self._worker.start()
            self._worker_alive = True

    def _renew(self) -> None:
        """A slave as good as new for the next master: reset, or loaded again if that fails."""
        if self._worker_alive and self._reset() is None:
            return
        self._worker_alive = False
        self._revive()

    def _reset(self) -> DoublestepError | None:
        """Reset the slave; why it could not be. One that takes too long is ended."""
        calls = [Reset()]
        too_late = self._clock.later(
            self._load_timeout,
            lambda: self._end_worker(f"no reset within {self._load_timeout:g} s (load_timeout)"),
        )
        try:
            return decode_reply(calls, self._run(encode_program(calls))).error
        finally:
            too_late.cancel()

    def _claim(self, data: bytes) -> bytes:
        try:
            holder = self._holder(Claim.from_message(decode_map(data)))
            with self._running:
                new = self._claims.holder is None
                if new:
                    self._renew()
                epoch = self._claims.claim(holder)
            if new:
                log.info("claimed by %s", holder, extra=_about(holder))
                process = PeerProcess(holder.host, holder.pid)
                self._masters.follow(epoch, Master(holder.run, process, holder.orphan_time))
        except DoublestepError as error:
            log.warning("claim refused: %s", error)
            return encode_error_map(error.located(slave=self._key.name, phase=CLAIM))
        claimed = Claimed(epoch, socket.gethostname(), os.getpid())
        return encode_map(claimed.to_message())

    def _holder(self, claim: Claim) -> Holder:
        orphan_time = self._orphan_time if claim.orphan_time is None else claim.orphan_time
        return Holder(
            claim.run, claim.host, claim.pid, _now(), orphan_time, time.time(), claim.secret
        )

    def _release(self, data: bytes) -> bytes:
        try:
            epoch = _epoch(decode_map(data))
            with self._running:
                holder = self._claims.holder
                self._claims.release(epoch)
                self._masters.forget(epoch)
                log.info("released by %s", holder, extra=_about(holder))
                self._reset()
        except DoublestepError as error:
            return encode_error_map(error.located(slave=self._key.name, phase=RELEASE))
        return encode_map({})

    def _abort(self, data: bytes) -> bytes:
        """End the worker, even in the middle of a step; the next claim starts another.

        Who says its epoch ends what it began and nothing later; an empty message ends anything.
        """
        try:
            if data:
                self._claims.check(_epoch(decode_map(data)))
        except DoublestepError as error:
            return encode_error_map(error.located(slave=self._key.name, phase=ABORT))
        self._end_worker("aborted")
        return encode_map({})

    def _end_worker(self, reason: str) -> None:
        log.warning("%s: ending the process that holds the model", reason)
        self._worker.kill()
        self._worker_alive = False

    def _status(self, _: bytes) -> bytes:
        holder = self._claims.holder
        status = SlaveStatus(
            name=self._key.name,
            instance=self._key.instance,
            host=socket.gethostname(),
            pid=os.getpid(),
            model=self._description.model,
            kind=self._description.kind,
            sha256=self._description.sha256,
            capabilities=_capabilities(self._description),
            state="free" if holder is None else "held",
            busy=self.busy,
            worker="alive" if self._worker_alive else "dead",
            holder=None if holder is None else str(holder),
            run=None if holder is None else holder.run,
            held_since=None if holder is None else holder.claimed,
            since=self._since,
            time=time.time(),
            protocol_version=PROTOCOL_VERSION,
        )
        return encode_map(status.to_message())

    def _free_orphan(self, epoch: int) -> None:
        """Give a slave back whose master is gone; a step under way has no use any more."""
        holder = self._claims.holder
        try:
            self._claims.check(epoch)
            if self.busy:
                self._end_worker("its master is gone")
            with self._running:
                self._claims.release(epoch)
                log.warning("reset; free for another master", extra=_about(holder))
                self._reset()
        except SequenceError as error:
            log.info("not reset: %s", error)  # released meanwhile


def _capabilities(description: SlaveDescription) -> str:
    """In short what a master asks of a slave."""
    can = description.capabilities
    known = {
        f"saves state ({description.state_kind})": can.can_get_and_set_state,
        "variable steps": can.can_handle_variable_step_size,
        "input derivatives": can.can_interpolate_inputs,
        "output derivatives": can.max_output_derivative_order > 0,
    }
    return ", ".join(name for name, has in known.items() if has)


def _about(holder: Holder | None) -> dict[str, str]:
    """Whose run a message of the log is about."""
    return {} if holder is None else {"run": holder.run}


def _epoch(message: Mapping[str, StartValue]) -> int:
    epoch = message.get("epoch")
    if type(epoch) is not int:
        raise MalformedMessageError("the message must hold an epoch")
    return epoch


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")
