"""Who is on the bus, and what each says of itself."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from protocol.administration import MasterStatus, RouterStatus, SlaveStatus
from protocol.bus import Bus, Caller
from protocol.codec import decode_map
from protocol.errors import DeadlineError, DoublestepError, SlaveLostError
from protocol.keys import (
    STATUS,
    MasterKey,
    RouterKey,
    SlaveKey,
    alive_master,
    alive_routers,
    alive_slaves,
)

_TOKEN_TIME = 1.0
_STATUS_TIME = 1.0

Key = SlaveKey | MasterKey | RouterKey
Status = SlaveStatus | MasterStatus | RouterStatus


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
    """All slaves, masters and routers in sight, each once, sorted; all are asked at once."""
    found: dict[Key, Bus] = {}
    for bus in buses:
        for key in _tokens(bus):
            found.setdefault(key, bus)
    asked = []
    for key, bus in sorted(found.items(), key=lambda item: _place(item[0])):
        asked.append((key, bus, _caller(bus, key).send(b"")))
    participants = []
    for key, bus, pending in asked:
        try:
            participants.append(Participant(key, bus, _status(key, pending.result())))
        except DoublestepError as error:
            participants.append(Participant(key, bus, failure=error))
    return participants


@dataclass(frozen=True)
class Timing:
    """Of status queries.

    Attributes:
        round_trips: [s], in order; empty when none was answered.
        clock_difference: how far the other clock is ahead of ours [s], NaN when not known; good to
            half the shortest round trip.
    """

    round_trips: tuple[float, ...]
    clock_difference: float

    @property
    def median(self) -> float:
        """Round-trip time [s], NaN when not known."""
        if not self.round_trips:
            return float("nan")
        return sorted(self.round_trips)[len(self.round_trips) // 2]


def measure(participant: Participant, rounds: int) -> Timing:
    """Ask for the status ``rounds`` times; a query that is not answered is left out."""
    caller = _caller(participant.bus, participant.key)
    times, shortest, difference = [], float("inf"), float("nan")
    for _ in range(rounds):
        sent, begin = time.time(), time.perf_counter()
        try:
            status = _status(participant.key, caller.request(b""))
        except (SlaveLostError, DeadlineError):
            continue
        taken = time.perf_counter() - begin
        times.append(taken)
        if taken < shortest:
            shortest, difference = taken, status.time - (sent + taken / 2)
    return Timing(tuple(times), difference)


def _tokens(bus: Bus) -> list[Key]:
    keys: list[Key] = []
    for pattern, parse in (
        (alive_slaves(), SlaveKey.from_alive),
        (alive_master("*"), MasterKey.from_alive),
        (alive_routers(), RouterKey.from_alive),
    ):
        keys += [key for key in map(parse, bus.alive(pattern, _TOKEN_TIME)) if key is not None]
    return keys


def _place(key: Key) -> tuple[str, ...]:
    if isinstance(key, SlaveKey):
        return ("slave", key.name, key.instance)
    return ("master", key.run) if isinstance(key, MasterKey) else ("router", key.instance)


def _caller(bus: Bus, key: Key) -> Caller:
    return bus.caller(key.verb(STATUS) if isinstance(key, SlaveKey) else key.status, _STATUS_TIME)


def _status(key: Key, data: bytes) -> Status:
    message = decode_map(data)
    if isinstance(key, SlaveKey):
        return SlaveStatus.from_message(message)
    if isinstance(key, MasterKey):
        return MasterStatus.from_message(message)
    return RouterStatus.from_message(message)
