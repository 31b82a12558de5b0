"""Participants on the bus, and their status."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, fields

from protocol.bus.bus import Bus, Caller
from protocol.errors import DoublestepError, MalformedMessageError
from protocol.wire.administration import MasterStatus, RouterStatus, SlaveStatus
from protocol.wire.agents import AgentStatus
from protocol.wire.keys import (
    STATUS,
    AgentKey,
    MasterKey,
    RouterKey,
    SlaveKey,
    alive_agents,
    alive_master,
    alive_routers,
    alive_slaves,
)
from protocol.wire.records import decode_map, decode_record

log = logging.getLogger("master_node")

SURVEY_TIME = 10.0
"""Bound on a survey [s]: one participant can put up thousands of tokens. The rest is not asked."""

_AT_ONCE = 64
_TOKEN_TIME = 1.0
_STATUS_TIME = 1.0

Key = SlaveKey | AgentKey | MasterKey | RouterKey
Status = SlaveStatus | AgentStatus | MasterStatus | RouterStatus


@dataclass(frozen=True)
class Participant:
    """Somebody whose liveliness token is on the bus.

    Attributes:
        key: its address.
        bus: through which it was seen.
        status: what it says of itself; None: it did not answer.
        failure: why not.
    """

    key: Key
    bus: Bus
    status: Status | None = None
    failure: DoublestepError | None = None


def survey(buses: Sequence[Bus]) -> list[Participant]:
    """All slaves, agents, masters and routers in sight, each once, sorted; in a bounded time."""
    found: dict[Key, Bus] = {}
    for bus in buses:
        for key in _tokens(bus):
            found.setdefault(key, bus)
    known = sorted(found.items(), key=lambda item: _place(item[0]))
    end = time.monotonic() + SURVEY_TIME
    participants: list[Participant] = []
    while len(participants) < len(known) and time.monotonic() < end:
        participants += _asked(known[len(participants) :][:_AT_ONCE])
    if left := len(known) - len(participants):
        log.warning("%d more participants, which there was no time to ask", left)
    return participants


def _asked(group: Sequence[tuple[Key, Bus]]) -> Iterator[Participant]:
    """Ask some at once: their answers are held until the last one has come."""
    pending = [(key, bus, _caller(bus, key).send(b"")) for key, bus in group]
    for key, bus, reply in pending:
        try:
            yield Participant(key, bus, _status(key, reply.result()))
        except DoublestepError as error:
            yield Participant(key, bus, failure=error)


@dataclass(frozen=True)
class Timing:
    """Times of status queries.

    Attributes:
        asked: how many there were.
        round_trips: [s], in order; empty when none was answered.
        clock_difference: how far the other clock is ahead of ours [s], NaN when not known; good to
            half the shortest round trip.
    """

    asked: int
    round_trips: tuple[float, ...]
    clock_difference: float

    @property
    def median(self) -> float:
        """Round-trip time [s], NaN when not known."""
        if not self.round_trips:
            return float("nan")
        return sorted(self.round_trips)[len(self.round_trips) // 2]


def measure(participant: Participant, rounds: int, timeout: float) -> Timing:
    """Ask for the status ``rounds`` times, and no longer than ``timeout`` seconds."""
    caller = _caller(participant.bus, participant.key)
    times, shortest, difference = [], float("inf"), float("nan")
    end, asked = time.monotonic() + timeout, 0
    while asked < rounds and time.monotonic() < end:
        asked += 1
        sent, begin = time.time(), time.perf_counter()
        try:
            status = _status(participant.key, caller.request(b""))
        except DoublestepError:
            continue
        taken = time.perf_counter() - begin
        times.append(taken)
        if taken < shortest:
            shortest, difference = taken, status.time - (sent + taken / 2)
    return Timing(asked, tuple(times), difference)


def _tokens(bus: Bus) -> list[Key]:
    keys: list[Key] = []
    for pattern, parse in (
        (alive_slaves(), SlaveKey.from_alive),
        (alive_agents(), AgentKey.from_alive),
        (alive_master("*"), MasterKey.from_alive),
        (alive_routers(), RouterKey.from_alive),
    ):
        keys += [key for key in map(parse, bus.alive(pattern, _TOKEN_TIME)) if key is not None]
    return keys


def _place(key: Key) -> tuple[str, ...]:
    if isinstance(key, SlaveKey):
        return ("slave", key.name, key.instance)
    if isinstance(key, AgentKey):
        return ("agent", key.name, key.instance)
    return ("master", key.run) if isinstance(key, MasterKey) else ("router", key.instance)


def _caller(bus: Bus, key: Key) -> Caller:
    return bus.caller(key.verb(STATUS) if isinstance(key, SlaveKey) else key.status, _STATUS_TIME)


def _status(key: Key, data: bytes) -> Status:
    """The status that a participant tells.

    Raises:
        MalformedMessageError: it is no status, or that of another.
        DoublestepError: the error that the participant answers.
    """
    status = _decoded(key, data)
    told = tuple(getattr(status, field.name) for field in fields(key))
    if told != astuple(key):
        raise MalformedMessageError(f"it says that it is {'/'.join(map(str, told))}")
    return status


def _decoded(key: Key, data: bytes) -> Status:
    if isinstance(key, AgentKey):
        return decode_record(AgentStatus, data)
    message = decode_map(data)
    if isinstance(key, SlaveKey):
        return SlaveStatus.from_message(message)
    if isinstance(key, MasterKey):
        return MasterStatus.from_message(message)
    return RouterStatus.from_message(message)
