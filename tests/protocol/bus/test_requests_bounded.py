"""Bounds in bytes on all that others send: requests that wait, replies, messages, tokens."""

from __future__ import annotations

import json
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest
import zenoh

from protocol.bus.endpoints import Endpoints
from protocol.bus.request_line import Line
from protocol.bus.room import Room
from protocol.bus.zenoh import ZenohBus
from protocol.errors import DeadlineError, MalformedMessageError, SlaveLostError
from protocol.wire.packing import MAX_MESSAGE_BYTES
from tests.support.waiting import BOUND, wait_until

MIB = 2**20

# ---- Room and line, without a bus ---------------------------------------------------------------


def test_a_room_holds_bytes_and_requests_up_to_its_size() -> None:
    """Law: taken is never more than there is, in bytes and in number; what is given is there."""
    room = Room(10, requests=3)
    assert room.take(10)
    assert not room.take(1)
    assert room.take(0)
    assert room.take(0)
    assert not room.take(0)
    room.give(10)
    assert not room.take(11)
    assert room.take(10)


class Queue:
    """A source of numbers, as Zenoh's channel is one."""

    def __init__(self) -> None:
        self._items: deque[int] = deque()
        self._there = threading.Semaphore(0)

    def put(self, item: int) -> None:
        """One more."""
        self._items.append(item)
        self._there.release()

    def recv(self) -> int:
        """Wait for it."""
        assert self._there.acquire(timeout=BOUND)
        return self._items.popleft()

    def try_recv(self) -> int | None:
        """Or not."""
        return self._items.popleft() if self._there.acquire(blocking=False) else None


def test_requests_wait_in_their_order_and_within_their_room() -> None:
    """While one is served for long: what finds no room is dropped, the rest comes in turn."""
    source, dropped = Queue(), list[int]()
    line = Line(source, Room(10), lambda item: item, dropped.append)
    for item in (4, 3, 9, 3, 1):
        source.put(item)
    assert line.next() == 4
    assert not line.attend(BOUND)  # not for long yet
    assert line.attend(0.0)
    assert dropped == [9, 1]
    source.put(2)
    assert [line.next(), line.next()] == [3, 3]
    assert line.next() == 2
    assert line.attend(0.0)
    source.put(11)
    source.put(10)
    assert line.next() == 10  # larger than all the room: dropped by who serves, too
    assert dropped == [9, 1, 11]


@pytest.mark.parametrize("seed", range(3))
def test_no_request_is_lost_or_overtaken_between_two_threads(seed: int) -> None:
    """Law: with room for all, each comes once and in order, whoever took it from the source."""
    source = Queue()
    line = Line(source, Room(10**9, requests=10**6), lambda _: 1, lambda _: pytest.fail("dropped"))
    ending = threading.Event()

    def attend() -> None:
        while not ending.is_set():
            line.attend(0.0)

    helper = threading.Thread(target=attend)
    helper.start()
    count, draw, got = 3000, random.Random(seed), list[int]()
    feeder = threading.Thread(target=lambda: [source.put(i) for i in range(count)])
    feeder.start()
    try:
        while len(got) < count:
            got.append(line.next())
            if draw.random() < 0.1:
                time.sleep(0.0)
    finally:
        ending.set()
        helper.join(BOUND)
        feeder.join(BOUND)
    assert got == list(range(count))


# ---- Over Zenoh ---------------------------------------------------------------------------------

Open = Callable[..., ZenohBus]


@pytest.fixture
def server(endpoint: str) -> Iterator[ZenohBus]:
    """A bus that listens."""
    bus = ZenohBus(Endpoints(listen=(endpoint,)))
    yield bus
    bus.close()


@pytest.fixture
def client(server: ZenohBus, endpoint: str) -> Iterator[ZenohBus]:
    """A bus that is connected to it."""
    bus = ZenohBus(Endpoints(connect=(endpoint,)))
    server.announce("a/server")
    wait_until(lambda: bool(bus.alive("a/server", BOUND)))
    yield bus
    bus.close()


@pytest.fixture
def stranger(server: ZenohBus, endpoint: str) -> Iterator[zenoh.Session]:
    """Somebody who keeps to none of our rules."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session


def test_a_long_request_keeps_few_bytes_waiting(server: ZenohBus, client: ZenohBus) -> None:
    """Two of ten that come meanwhile find room; the others get an empty answer at once."""
    begun, go_on, sizes = threading.Event(), threading.Event(), list[int]()

    def handle(data: bytes) -> bytes:
        sizes.append(len(data))
        begun.set()
        assert go_on.wait(BOUND)
        return b"done"

    server.serve("a/long", handle, Room(3 * MIB))
    server.serve("a/short", lambda data: data)
    callers = [client.caller("a/long", BOUND) for _ in range(11)]
    first = callers[0].send(bytes(MIB))
    assert begun.wait(BOUND)
    pending = [caller.send(bytes(MIB)) for caller in callers[1:]]
    outcomes = list[object]()
    for reply in pending[2:]:
        with pytest.raises(SlaveLostError):
            outcomes.append(reply.result())
    assert client.caller("a/short", BOUND).request(b"x") == b"x"
    go_on.set()
    assert [reply.result() for reply in (first, *pending[:2])] == [b"done"] * 3
    assert sizes == [MIB] * 3
    assert client.caller("a/long", BOUND).request(b"") == b"done"


def test_a_message_that_is_too_long_is_not_sent(server: ZenohBus, client: ZenohBus) -> None:
    """The sender is told the limit, instead of waiting for an answer."""
    server.serve("a/echo", lambda data: data)
    with pytest.raises(MalformedMessageError, match=f"of {MAX_MESSAGE_BYTES + 1} bytes; the limit"):
        client.caller("a/echo", BOUND).send(bytes(MAX_MESSAGE_BYTES + 1))


def test_a_message_that_is_too_long_is_dropped_unread(
    server: ZenohBus, client: ZenohBus, stranger: zenoh.Session
) -> None:
    """From who sends it all the same; the connection and others do not suffer."""
    sizes = list[int]()
    server.serve("a/count", lambda data: str(sizes.append(len(data))).encode())
    bus = ZenohBus(Endpoints(listen=(), connect=()), largest=MIB)
    bus.close()
    pending = stranger.get("a/count", payload=bytes(MAX_MESSAGE_BYTES + MIB), timeout=0.5)
    assert not [reply.ok for reply in pending if reply.ok is not None]
    assert client.caller("a/count", BOUND).request(bytes(7))
    replies = [reply.ok for reply in stranger.get("a/count", payload=bytes(8), timeout=BOUND)]
    assert len(replies) == 1
    assert sizes == [7, 8]


def test_who_wants_short_messages_gets_no_long_ones(endpoint: str) -> None:
    """A smaller limit for a participant: what is beyond it is dropped unread."""
    server = ZenohBus(Endpoints(listen=(endpoint,)), largest=MIB)
    client = ZenohBus(Endpoints(connect=(endpoint,)))
    try:
        server.serve("a/size", lambda data: str(len(data)).encode())
        server.announce("a/server")
        wait_until(lambda: bool(client.alive("a/server", BOUND)))
        assert client.caller("a/size", BOUND).request(bytes(MIB)) == b"1048576"
        with pytest.raises((SlaveLostError, DeadlineError)):
            client.caller("a/size", 0.5).request(bytes(2 * MIB))
        assert client.caller("a/size", BOUND).request(b"") == b"0"
    finally:
        client.close()
        server.close()


def test_replies_without_number_are_not_kept(server: ZenohBus, stranger: zenoh.Session) -> None:
    """One reply is expected and one is kept; others are answered meanwhile."""
    flooded = threading.Event()

    def flood(query: zenoh.Query) -> None:
        with query:
            for number in range(200):
                query.reply(query.key_expr, str(number).encode() + bytes(MIB // 8))
        flooded.set()

    handler = zenoh.handlers.Callback(flood)
    stranger.declare_queryable("b/flood", handler)
    stranger.declare_queryable(
        "b/echo", zenoh.handlers.Callback(lambda query: query.reply(query.key_expr, query.payload))
    )
    caller = server.caller("b/flood", BOUND)
    wait_until(lambda: bool(_answer(server, "b/echo")))
    pending = caller.send(b"")
    assert flooded.wait(BOUND)
    assert _answer(server, "b/echo") == b"x"
    assert pending.result().startswith(b"199\0")


def test_errors_without_number_hold_up_no_other_reply(
    server: ZenohBus, stranger: zenoh.Session
) -> None:
    """Law: a slave that answers one request with a thousand errors delays others by little.

    Its own request fails; before and after it was read the others are answered.
    """
    flooded = threading.Event()

    def flood(query: zenoh.Query) -> None:
        with query:
            for number in range(1000):
                query.reply_err(str(number).encode() + bytes(MIB // 16))
        flooded.set()

    stranger.declare_queryable("b/flood", zenoh.handlers.Callback(flood))
    stranger.declare_queryable(
        "b/echo", zenoh.handlers.Callback(lambda query: query.reply(query.key_expr, query.payload))
    )
    caller = server.caller("b/flood", BOUND)
    wait_until(lambda: bool(_answer(server, "b/echo")))
    for is_read in (False, True):
        flooded.clear()
        pending = caller.send(b"")
        if is_read:
            with pytest.raises(SlaveLostError, match=r"b/flood answered b'0"):
                pending.result()
        assert _answer(server, "b/echo") == b"x"
        assert flooded.wait(BOUND)
        if not is_read:
            with pytest.raises(SlaveLostError, match=r"b/flood answered b'0"):
                pending.result()


def _answer(bus: ZenohBus, key: str) -> bytes:
    with suppress(SlaveLostError):
        return bus.caller(key, BOUND).request(b"x")
    return b""


def test_thousands_of_tokens_are_no_wait_without_an_end(
    server: ZenohBus, stranger: zenoh.Session
) -> None:
    """The first 4096 are there, and a single name is found among thousands."""
    tokens = [stranger.liveliness().declare_token(f"c/many/{i}/alive") for i in range(4200)]
    last = stranger.liveliness().declare_token("c/last/0/alive")
    wait_until(lambda: bool(server.alive("c/last/*/alive", BOUND)))
    assert len(server.alive("c/*/*/alive", BOUND)) == 4096
    assert len(tokens) == 4200
    assert last is not None
