"""A peer that may speak to slaves and means no good: requests by the thousand, during a run.

It knows all that can be seen on the bus: keys, status, the id of the run. It makes no use of what a
master may do to any slave: an ``abort`` without an epoch is not among its requests.
"""

from __future__ import annotations

import json
import threading
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from random import Random

import msgpack
import zenoh

from protocol.calls import CALLS
from protocol.errors import DoublestepError
from protocol.wire.administration import Claim, SlaveStatus
from protocol.wire.keys import ABORT, CLAIM, EXECUTE, RELEASE, STATUS, SlaveKey, alive_slaves
from protocol.wire.packing import PROTOCOL_VERSION
from protocol.wire.programs import encode_program, encode_request
from protocol.wire.records import decode_map, encode_map
from tests.faults.fuzz.messages import PROGRAMS, Mutator

_VERBS = (EXECUTE, CLAIM, RELEASE, ABORT, STATUS, *(call.verb for call in CALLS))
_UNDER_WAY = 64
_TIME = 30.0


@dataclass
class Heard:
    """Outcomes of the requests.

    Attributes:
        sent: how many there were.
        answers: of them by kind: ``answered``, ``refused``, ``dropped``.
        largest: length of the largest answer [bytes].
    """

    sent: int = 0
    answers: Counter[str] = field(default_factory=Counter)
    largest: int = 0


class HostilePeer:
    """One session without our software around it.

    Args:
        endpoints: of the slaves, or of who is connected to them.
        seed: of all that it sends.
    """

    def __init__(self, endpoints: Sequence[str], seed: int) -> None:
        config = zenoh.Config()
        for key, value in {
            "mode": "peer",
            "listen/endpoints": [],
            "connect/endpoints": list(endpoints),
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        self._session = zenoh.open(config)
        self._random = Random(seed)
        self._mutator = Mutator(seed)
        self._callers: dict[str, zenoh.Querier] = {}

    def slaves(self) -> list[SlaveKey]:
        """Those in sight."""
        replies = self._session.liveliness().get(alive_slaves(), timeout=_TIME)
        keys = (SlaveKey.from_alive(str(r.ok.key_expr)) for r in replies if r.ok is not None)
        return sorted(key for key in keys if key is not None)

    def flood(self, slaves: Sequence[SlaveKey], count: int, ending: threading.Event) -> Heard:
        """Send ``count`` requests, or fewer if ``ending`` is set meanwhile."""
        heard = Heard()
        pending: deque[zenoh.handlers.Handler[zenoh.Reply]] = deque()
        for number in range(count):
            if ending.is_set():
                break
            key, payload = self._request(slaves, number)
            pending.append(self._caller(key).get(payload=payload))
            heard.sent += 1
            if len(pending) >= _UNDER_WAY:
                self._hear(pending.popleft(), heard)
        while pending:
            self._hear(pending.popleft(), heard)
        return heard

    def _caller(self, key: str) -> zenoh.Querier:
        if key not in self._callers:
            self._callers[key] = self._session.declare_querier(key, timeout=_TIME)
        return self._callers[key]

    def _request(self, slaves: Sequence[SlaveKey], number: int) -> tuple[str, bytes]:
        slave = self._random.choice(slaves)
        if number % 3:
            _, data = self._mutator.message(number)
            verb = self._random.choice(_VERBS)
            return slave.verb(verb), data if data or verb != ABORT else b"\x80"
        verb, data = self._random.choice(list(self._known_forms(slave)))
        return slave.verb(verb), data

    def _known_forms(self, slave: SlaveKey) -> Iterator[tuple[str, bytes]]:
        """Well-formed requests in the name of the run, replays and guesses."""
        run = self._run_of(slave)
        guess = self._random.choice((0, 1, 2, self._random.getrandbits(62)))
        program = encode_program(self._random.choice(PROGRAMS))
        yield CLAIM, encode_map(Claim(run, "here", 1, 0.0).to_message())
        yield CLAIM, encode_map(Claim("another", "here", 1, 0.0, "secret").to_message())
        yield EXECUTE, encode_request(guess, self._random.randrange(5), program)
        yield EXECUTE, msgpack.packb([PROTOCOL_VERSION + 1, guess, 1, program])
        yield RELEASE, encode_map({"epoch": guess})
        yield ABORT, encode_map({"epoch": guess})
        yield STATUS, b""

    def _run_of(self, slave: SlaveKey) -> str:
        for reply in self._session.get(slave.verb(STATUS), timeout=_TIME):
            if reply.ok is not None:
                try:
                    status = SlaveStatus.from_message(decode_map(reply.ok.payload.to_bytes()))
                except DoublestepError:
                    break
                return status.run or "none"
        return "none"

    @staticmethod
    def _hear(replies: zenoh.handlers.Handler[zenoh.Reply], heard: Heard) -> None:
        answer = b""
        for reply in replies:
            if reply.ok is not None:
                answer = reply.ok.payload.to_bytes()
        heard.largest = max(heard.largest, len(answer))
        kind = "dropped" if not answer else "refused" if b"error" in answer else "answered"
        heard.answers[kind] += 1

    def close(self) -> None:
        """Leave the bus."""
        self._session.close()  # type: ignore[no-untyped-call]
