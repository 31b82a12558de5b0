"""A bus in virtual time on which messages get lost, late, doubled and out of order, all by a seed.

Links between participants are cut and come back, liveliness tokens blink, participants die. As
with Zenoh over TCP, a short cut delays what is under way, and one that is noticed loses it and
ends the requests that wait for it; beyond that single messages are lost, doubled and overtaken
here, which TCP would not do: the guard of the protocol has to stand that too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

from protocol.bus.bus import AliveListener, Bus, Caller, Handler, PendingReply
from protocol.bus.bus import matches as pattern_matches
from protocol.bus.room import Room
from protocol.errors import DeadlineError, SlaveLostError
from tests.support.virtual_clock import VirtualClock, Waiter


@dataclass(frozen=True)
class Faults:
    """Rates of faults. Probabilities are for each message; rates are per second for each link.

    Attributes:
        latency: mean time of a message on its way [s].
        late, lateness: probability that one takes much longer, and how long at most [s].
        lost: probability that a request or a reply is lost.
        doubled: probability that one arrives twice.
        cuts, cut_time: rate at which a link is cut, and mean time until it is back [s].
        blinks, blink_time: the same for liveliness tokens that go and come for no reason.
        deaths: rate at which a participant that serves dies.
    """

    latency: float = 1e-3
    late: float = 0.0
    lateness: float = 0.0
    lost: float = 0.0
    doubled: float = 0.0
    cuts: float = 0.0
    cut_time: float = 0.0
    blinks: float = 0.0
    blink_time: float = 0.0
    deaths: float = 0.0


NO_FAULTS = Faults()
_NOTICE_TIME = 2.0
"""A cut is noticed within this [s], as Zenoh's lease."""
_FOREVER = float("inf")
_MISFORTUNES = 20.0
"""Occasions a second for something to happen to links, tokens and participants."""


@dataclass
class _Cut:
    """A link that is down until ``end``; ``noticed`` is when both sides close it, if ever."""

    end: float
    noticed: float


class Network:
    """The links between all participants.

    Args:
        clock: for everything.
        random: decides.
        faults: how bad it gets; may be changed on the way.
    """

    def __init__(self, clock: VirtualClock, random: Random, faults: Faults) -> None:
        self.clock = clock
        self.random = random
        self.faults = faults
        self.participants: list[FaultyBus] = []
        self._cuts: dict[frozenset[str], _Cut] = {}
        self._connections: dict[frozenset[str], int] = {}

    def join(self, name: str) -> FaultyBus:
        """A new participant; its links to all others are up."""
        self.participants.append(FaultyBus(self, name))
        return self.participants[-1]

    # --- messages

    def delay(self) -> float:
        """Delay of one message [s]."""
        faults, random = self.faults, self.random
        if faults.late and random.random() < faults.late:
            return random.uniform(0.0, faults.lateness)
        return random.expovariate(1.0 / faults.latency)

    def transmit(self, a: FaultyBus, b: FaultyBus, deliver: Callable[[], object]) -> None:
        """Let ``deliver`` happen when a message from ``a`` to ``b`` arrives: once, or not."""
        faults, random = self.faults, self.random
        if faults.lost and random.random() < faults.lost:
            return
        copies = 2 if faults.doubled and random.random() < faults.doubled else 1
        connection = self._connections.get(_link(a, b), 0)
        for _ in range(copies):
            arrival = self.clock.monotonic() + self.delay()
            self.clock.at(arrival, lambda: self._arrive(a, b, connection, deliver))

    def _arrive(
        self, a: FaultyBus, b: FaultyBus, connection: int, deliver: Callable[[], object]
    ) -> None:
        if not b.is_alive or connection != self._connections.get(_link(a, b), 0):
            return  # lost with the connection
        cut = self._cuts.get(_link(a, b))
        if cut is None:
            deliver()
        elif cut.end <= cut.noticed:
            self.clock.at(cut.end, lambda: self._arrive(a, b, connection, deliver))

    # --- links

    def are_connected(self, a: FaultyBus, b: FaultyBus) -> bool:
        """True while both believe that they are connected."""
        cut = self._cuts.get(_link(a, b))
        return a.is_alive and b.is_alive and (cut is None or cut.noticed > self.clock.monotonic())

    def cut(self, a: FaultyBus, b: FaultyBus, time: float) -> None:
        """Cut the link for ``time`` seconds."""
        link, now = _link(a, b), self.clock.monotonic()
        if link in self._cuts:
            return
        cut = _Cut(now + time, now + self.random.uniform(0.0, _NOTICE_TIME))
        self._cuts[link] = cut
        if cut.noticed < cut.end:
            self.clock.at(cut.noticed, lambda: self._close(a, b))
        if cut.end < _FOREVER:
            self.clock.at(cut.end, lambda: self._reopen(a, b, cut))

    def _close(self, a: FaultyBus, b: FaultyBus) -> None:
        link = _link(a, b)
        self._connections[link] = self._connections.get(link, 0) + 1
        for one, other in ((a, b), (b, a)):
            one.disconnected_from(other)

    def _reopen(self, a: FaultyBus, b: FaultyBus, cut: _Cut) -> None:
        del self._cuts[_link(a, b)]
        if cut.noticed < cut.end:
            for one, other in ((a, b), (b, a)):
                one.connected_to(other)

    def heal(self) -> None:
        """No more faults; links that are down come back at their time."""
        self.faults = NO_FAULTS

    def misfortune(self) -> None:
        """A task: cuts links, lets tokens blink, and lets servers die, as `faults` say."""
        faults, random = self.faults, self.random
        while self.faults is faults:
            self.clock.sleep(random.expovariate(_MISFORTUNES))
            for a in self.participants:
                for b in self.participants:
                    if a.name < b.name and random.random() < faults.cuts / _MISFORTUNES:
                        self.cut(a, b, random.expovariate(1.0 / faults.cut_time))
                if random.random() < faults.blinks / _MISFORTUNES:
                    a.blink(random.expovariate(1.0 / faults.blink_time))
                if a.serves and random.random() < faults.deaths / _MISFORTUNES:
                    a.die()


def _link(a: FaultyBus, b: FaultyBus) -> frozenset[str]:
    return frozenset((a.name, b.name))


class FaultyBus(Bus):
    """One participant. Handlers run in tasks of their own, one for each key, as Zenoh's threads.

    Attributes:
        name: of the participant.
        is_alive: False after ``die`` or ``close``.
    """

    def __init__(self, network: Network, name: str) -> None:
        self._network = network
        self._clock = network.clock
        self.name = name
        self.is_alive = True
        self._services: dict[str, _Service] = {}
        self.tokens: set[str] = set()
        self.pending: dict[_Pending, FaultyBus] = {}
        self._watches: list[tuple[str, AliveListener]] = []
        self._news: deque[tuple[str, bool]] = deque()
        self._reader: Waiter | None = None

    @property
    def serves(self) -> bool:
        """True while it answers anything."""
        return bool(self._services) and self.is_alive

    @property
    def network(self) -> Network:
        """Where it takes part."""
        return self._network

    def service(self, key: str) -> _Service | None:
        """Service of this participant for ``key``."""
        return self._services.get(key)

    # --- Bus

    def caller(self, key: str, timeout: float) -> Caller:
        """See `Bus`."""
        return _FaultyCaller(self, key, timeout)

    def serve(self, key: str, handler: Handler, room: Room | None = None) -> None:
        """See `Bus`."""
        service = self._services[key] = _Service(self._clock, handler)
        self._clock.start(service.work)

    def serve_here(
        self, key: str, handler: Handler, ready: Callable[[], None], room: Room | None = None
    ) -> None:
        """See `Bus`."""
        service = self._services[key] = _Service(self._clock, handler)
        ready()
        service.work()

    def announce(self, key: str) -> None:
        """See `Bus`."""
        self.tokens.add(key)
        self._tell_others(key, True)

    def alive(self, pattern: str, timeout: float) -> list[str]:
        """See `Bus`."""
        self._clock.sleep(min(timeout, 2.0 * self._network.delay()))
        return sorted(
            key
            for other in self._network.participants
            if other is self or self._network.are_connected(self, other)
            for key in other.tokens
            if pattern_matches(pattern, key)
        )

    def watch(self, pattern: str, listener: AliveListener) -> None:
        """See `Bus`."""
        if not self._watches:
            self._clock.start(self._read_news)
        self._watches.append((pattern, listener))
        for other in self._network.participants:
            if other is self or self._network.are_connected(self, other):
                for key in sorted(other.tokens):
                    if pattern_matches(pattern, key):
                        listener(key, True)

    def close(self) -> None:
        """See `Bus`."""
        self.die()

    # --- what happens to it

    def die(self) -> None:
        """Leave without a word: TCP tells the others at once."""
        if not self.is_alive:
            return
        for other in self._network.participants:
            if other is not self and self._network.are_connected(self, other):
                other.disconnected_from(self)
        self.is_alive = False

    def blink(self, time: float) -> None:
        """All tokens of this participant go, and are there again after ``time`` seconds."""
        tokens, self.tokens = self.tokens, set()
        for key in sorted(tokens):
            self._tell_others(key, False)
            self._clock.later(time, lambda key=key: self.announce(key))  # type: ignore[misc]

    def disconnected_from(self, other: FaultyBus) -> None:
        """Requests to it end, and its tokens are gone."""
        for pending in [p for p, server in self.pending.items() if server is other]:
            pending.fail(SlaveLostError("the connection was lost"))
        for key in sorted(other.tokens):
            self.tell(key, False)

    def connected_to(self, other: FaultyBus) -> None:
        """Its tokens are there."""
        if other.is_alive:
            for key in sorted(other.tokens):
                self.tell(key, True)

    def _tell_others(self, key: str, is_alive: bool) -> None:
        for other in self._network.participants:
            if other is self or self._network.are_connected(self, other):
                other.tell(key, is_alive)

    def tell(self, key: str, is_alive: bool) -> None:
        """News of a token; listeners hear all news in order, a little later."""
        if self._watches:
            self._news.append((key, is_alive))
        if self._reader is not None:
            self._reader.wake()

    def _read_news(self) -> None:
        while True:
            if not self._news:
                self._reader = Waiter(self._clock)
                self._reader.wait()
            self._clock.sleep(self._network.delay())
            key, is_alive = self._news.popleft()
            for pattern, listener in self._watches:
                if self.is_alive and pattern_matches(pattern, key):
                    listener(key, is_alive)


class _Service:
    """Requests to one key, handled one at a time in the order in which they arrive."""

    def __init__(self, clock: VirtualClock, handler: Handler) -> None:
        self._clock = clock
        self._handler = handler
        self._requests: deque[tuple[bytes, Callable[[bytes], object]]] = deque()
        self._idle: Waiter | None = None

    def put(self, payload: bytes, answer: Callable[[bytes], object]) -> None:
        """A request has arrived."""
        self._requests.append((payload, answer))
        if self._idle is not None:
            self._idle.wake()

    def work(self) -> None:
        """A task that answers."""
        while True:
            if not self._requests:
                self._idle = Waiter(self._clock)
                self._idle.wait()
                self._idle = None
            payload, answer = self._requests.popleft()
            answer(self._handler(payload))


class _FaultyCaller(Caller):
    def __init__(self, bus: FaultyBus, key: str, timeout: float) -> None:
        self._bus = bus
        self._key = key
        self._timeout = timeout
        self._pending: list[_Pending] = []
        self._is_cancelled = False

    def send(self, payload: bytes) -> PendingReply:
        bus, network = self._bus, self._bus.network
        pending = _Pending(bus)
        self._pending = [p for p in self._pending if p.outcome is None] + [pending]
        server = next(
            (
                other
                for other in network.participants
                if other.service(self._key) is not None and network.are_connected(bus, other)
            ),
            None,
        )
        if server is None or self._is_cancelled:
            pending.fail(SlaveLostError(f"no participant serves {self._key}"))
            return pending
        bus.pending[pending] = server
        service = server.service(self._key)
        assert service is not None

        def answer(reply: bytes) -> None:
            network.transmit(server, bus, lambda: pending.end(reply))

        network.transmit(bus, server, lambda: service.put(payload, answer))
        deadline = network.clock.monotonic() + self._timeout
        network.clock.at(
            deadline,
            lambda: pending.fail(DeadlineError(f"no reply within {self._timeout:g} s")),
        )
        return pending

    def cancel(self) -> None:
        self._is_cancelled = True
        for pending in self._pending:
            pending.fail(SlaveLostError("cancelled"))


class _Pending(PendingReply):
    def __init__(self, bus: FaultyBus) -> None:
        self._bus = bus
        self.outcome: bytes | Exception | None = None
        self._waiter: Waiter | None = None

    def end(self, outcome: bytes | Exception) -> None:
        """The first outcome counts."""
        if self.outcome is None:
            self.outcome = outcome
            self._bus.pending.pop(self, None)
            if self._waiter is not None:
                self._waiter.wake()

    def fail(self, error: SlaveLostError | DeadlineError) -> None:
        """There will be no reply."""
        self.end(error)

    def result(self) -> bytes:
        if self.outcome is None:
            self._waiter = Waiter(self._bus.network.clock)
            self._waiter.wait()
        if isinstance(self.outcome, bytes):
            return self.outcome
        assert self.outcome is not None
        raise self.outcome
