"""Promises of both buses, and what only a real network can show."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue

import pytest

from protocol.bus.bus import Bus, InProcessBus
from protocol.bus.endpoints import Endpoints, host_and_port
from protocol.bus.zenoh import ZenohBus
from protocol.errors import ConfigurationError, DeadlineError, DoublestepError, SlaveLostError
from tests.support.waiting import BOUND, is_quick


@dataclass
class Network:
    """A bus with two participants: who serves and who asks. In process they are one object."""

    server: Bus
    client: Bus
    withdraw: Callable[[str], None]
    gates: list[threading.Event] = field(default_factory=list)

    def gate(self) -> threading.Event:
        """Something for a handler to wait for; opened at the latest when the test ends."""
        self.gates.append(threading.Event())
        return self.gates[-1]

    def serve(self, key: str, handler: Callable[[bytes], bytes]) -> None:
        """Serve, and wait until the client can reach it."""
        self.server.serve(key, handler)
        self.server.announce(f"{key}/alive")
        seen = threading.Event()
        self.client.watch(f"{key}/alive", lambda _, alive: seen.set() if alive else None)
        assert seen.wait(BOUND)


@pytest.fixture(params=["in process", "zenoh"])
def network(request: pytest.FixtureRequest, endpoint: str) -> Iterator[Network]:
    """Both implementations of `Bus`."""
    if request.param == "in process":
        bus = InProcessBus()
        made = Network(bus, bus, bus.withdraw)
    else:
        client = ZenohBus(Endpoints(listen=(endpoint,)))
        server = ZenohBus(Endpoints(connect=(endpoint,)))
        made = Network(server, client, lambda _: server.close())
    yield made
    for gate in made.gates:
        gate.set()
    made.server.close()
    made.client.close()


@pytest.fixture
def zenoh_network(endpoint: str) -> Iterator[Network]:
    """Two sessions over loopback, for what needs a wire."""
    client = ZenohBus(Endpoints(listen=(endpoint,)))
    server = ZenohBus(Endpoints(connect=(endpoint,)))
    made = Network(server, client, lambda _: server.close())
    yield made
    for gate in made.gates:
        gate.set()
    server.close()
    client.close()


# ---- Requests ----------------------------------------------------------------------------------


@pytest.mark.parametrize("payload", [b"", b"\0", bytes(range(256)), b"x" * 3_000_000], ids=len)
def test_a_request_gets_its_reply(network: Network, payload: bytes) -> None:
    """Any bytes, also none and many, get there and back."""
    network.serve("a/echo", lambda data: data[::-1])
    assert network.client.caller("a/echo", BOUND).request(payload) == payload[::-1]


def test_requests_are_handled_in_order_one_at_a_time(network: Network) -> None:
    """A handler never runs twice at once, whoever asks, and keeps the order of one caller."""
    heard: list[bytes] = []
    inside = threading.Semaphore(1)

    def handle(data: bytes) -> bytes:
        assert inside.acquire(blocking=False)
        heard.append(data)
        inside.release()
        return data

    network.serve("a/ordered", handle)

    def ask(who: str) -> None:
        caller = network.client.caller("a/ordered", BOUND)
        pending = [caller.send(f"{who}{i}".encode()) for i in range(50)]
        assert [p.result() for p in pending] == [f"{who}{i}".encode() for i in range(50)]

    threads = [threading.Thread(target=ask, args=(who,)) for who in "abc"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(BOUND)
    assert len(heard) == 150
    for who in "abc":
        mine = [data for data in heard if data.startswith(who.encode())]
        assert mine == [f"{who}{i}".encode() for i in range(50)]


def test_several_requests_are_under_way_at_once(network: Network) -> None:
    """Requests to two slaves are sent before either is answered, and collected in any order."""
    for name in "bc":
        network.serve(f"a/{name}", lambda data, name=name: name.encode() + data)
    callers = {name: network.client.caller(f"a/{name}", BOUND) for name in "bc"}
    pending = [callers[name].send(data) for name, data in (("b", b"1"), ("c", b"2"), ("b", b"3"))]
    assert [p.result() for p in reversed(pending)] == [b"b3", b"c2", b"b1"]


def test_two_slow_handlers_work_at_the_same_time(zenoh_network: Network) -> None:
    """Two keys are served beside each other: each waits here until the other was asked too."""
    both = threading.Barrier(2)

    def handle(_: bytes) -> bytes:
        both.wait(BOUND)
        return b"done"

    for name in "bc":
        zenoh_network.serve(f"a/{name}", handle)
    pending = [zenoh_network.client.caller(f"a/{n}", BOUND).send(b"") for n in "bc"]
    assert [p.result() for p in pending] == [b"done", b"done"]


def test_serving_here_lasts_until_the_bus_is_closed(network: Network) -> None:
    """``ready`` comes when requests are answered; ``close`` lets the serving thread go on."""
    ready = threading.Event()
    thread = threading.Thread(
        target=network.server.serve_here, args=("a/here", lambda data: data, ready.set)
    )
    thread.start()
    assert ready.wait(BOUND)
    network.serve("a/known", lambda data: data)
    assert network.client.caller("a/here", BOUND).request(b"x") == b"x"
    network.server.close()
    thread.join(BOUND)
    assert not thread.is_alive()


def test_nobody_serves(network: Network) -> None:
    """It is known at once, by `result` and not by `send`: no timeout runs."""
    begin = time.perf_counter()
    pending = network.client.caller("a/nobody", BOUND).send(b"")
    with pytest.raises(SlaveLostError):
        pending.result()
    assert is_quick(time.perf_counter() - begin, 1.0)


def test_a_server_that_left_is_nobody(network: Network) -> None:
    """After its token went away, requests are refused at once."""
    network.serve("a/short", lambda data: data)
    gone = threading.Event()
    network.client.watch("a/short/alive", lambda _, alive: None if alive else gone.set())
    network.withdraw("a/short/alive")
    assert gone.wait(BOUND)
    if isinstance(network.client, InProcessBus):
        network.client.close()
    with pytest.raises(SlaveLostError):
        network.client.caller("a/short", BOUND).request(b"")


def test_a_late_reply_is_a_deadline(zenoh_network: Network) -> None:
    """The timeout ends the wait, not the work, and the next request is answered again."""
    gate = zenoh_network.gate()
    worked = threading.Event()

    def handle(data: bytes) -> bytes:
        if data == b"slow":
            gate.wait(BOUND)
            worked.set()
        return data

    zenoh_network.serve("a/slow", handle)
    begin = time.perf_counter()
    with pytest.raises(DeadlineError, match=r"no reply within 0\.2 s"):
        zenoh_network.client.caller("a/slow", 0.2).request(b"slow")
    taken = time.perf_counter() - begin
    assert taken > 0.15
    assert is_quick(taken, 1.0)
    assert not worked.is_set()
    gate.set()
    assert worked.wait(BOUND)
    assert zenoh_network.client.caller("a/slow", BOUND).request(b"quick") == b"quick"


def test_a_reply_of_the_word_timeout_is_a_reply(zenoh_network: Network) -> None:
    """Zenoh says ``Timeout`` in an error; a handler may say so too."""
    zenoh_network.serve("a/word", lambda _: b"Timeout")
    assert zenoh_network.client.caller("a/word", BOUND).request(b"") == b"Timeout"


def test_cancel_ends_every_wait(zenoh_network: Network) -> None:
    """Pending results and later requests of the caller fail at once; other callers go on."""
    gate, asked = zenoh_network.gate(), threading.Event()

    def handle(data: bytes) -> bytes:
        asked.set()
        gate.wait(BOUND)
        return data

    zenoh_network.serve("a/stuck", handle)
    caller, other = (zenoh_network.client.caller("a/stuck", BOUND) for _ in range(2))
    pending = [caller.send(b"1"), caller.send(b"2")]
    spared = other.send(b"3")
    assert asked.wait(BOUND)
    canceller = threading.Timer(0.05, caller.cancel)
    canceller.start()
    begin = time.perf_counter()
    for reply in pending:
        with pytest.raises(SlaveLostError):
            reply.result()
    canceller.join(BOUND)
    with pytest.raises(SlaveLostError):
        caller.request(b"4")
    assert is_quick(time.perf_counter() - begin, 1.0)
    gate.set()
    assert spared.result() == b"3"


def test_an_asker_that_leaves_does_not_end_the_serving(
    zenoh_network: Network, endpoint: str
) -> None:
    """A master that dies while a slave works leaves a slave that answers the next one."""
    gate, asked = zenoh_network.gate(), threading.Event()

    def handle(data: bytes) -> bytes:
        asked.set()
        gate.wait(BOUND)
        return data

    zenoh_network.serve("a/stuck", handle)
    pending = zenoh_network.client.caller("a/stuck", BOUND).send(b"1")
    assert asked.wait(BOUND)
    zenoh_network.client.close()
    with pytest.raises(SlaveLostError):
        pending.result()
    gate.set()
    following = ZenohBus(Endpoints(listen=(endpoint,)))
    try:
        seen = threading.Event()
        following.watch("a/stuck/alive", lambda *_: seen.set())
        assert seen.wait(BOUND)
        assert following.caller("a/stuck", BOUND).request(b"2") == b"2"
    finally:
        following.close()


# ---- Liveliness --------------------------------------------------------------------------------


def next_change(changes: SimpleQueue[tuple[str, bool]]) -> tuple[str, bool]:
    """The next token that appeared or went away."""
    return changes.get(timeout=BOUND)


def test_tokens_are_seen_to_come_and_go(network: Network) -> None:
    """A watcher hears of what matches its pattern, of earlier and later tokens, exactly once."""
    changes: SimpleQueue[tuple[str, bool]] = SimpleQueue()
    network.server.announce("a/early/1/alive")
    network.client.watch("a/*/*/alive", lambda key, alive: changes.put((key, alive)))
    assert next_change(changes) == ("a/early/1/alive", True)
    network.server.announce("b/other/1/alive")
    network.server.announce("a/one/too/many/alive")
    network.server.announce("a/late/1/alive")
    assert next_change(changes) == ("a/late/1/alive", True)
    assert network.client.alive("a/*/*/alive", BOUND) == ["a/early/1/alive", "a/late/1/alive"]
    assert network.client.alive("a/late/*/alive", BOUND) == ["a/late/1/alive"]
    assert network.client.alive("a/none/*/alive", BOUND) == []

    network.withdraw("a/late/1/alive")
    gone = {next_change(changes)}
    if not isinstance(network.server, InProcessBus):  # there a participant dies as a whole
        gone.add(next_change(changes))
        assert gone == {("a/early/1/alive", False), ("a/late/1/alive", False)}
    assert ("a/late/1/alive", False) in gone
    assert "a/late/1/alive" not in network.client.alive("a/*/*/alive", BOUND)
    with pytest.raises(Empty):
        changes.get_nowait()


def test_many_tokens_are_listed(zenoh_network: Network) -> None:
    """More than Zenoh's default channel holds: 300 slaves are found, and nothing hangs."""
    for i in range(300):
        zenoh_network.server.announce(f"a/many/{i}/alive")
    zenoh_network.serve("a/last", lambda data: data)
    assert len(zenoh_network.client.alive("a/many/*/alive", BOUND)) == 300


def test_who_came_first_does_not_matter(endpoint: str) -> None:
    """A slave that was started before its master is found as soon as the master listens."""
    server = ZenohBus(Endpoints(connect=(endpoint,)))
    server.serve("a/early", lambda data: data)
    server.announce("a/early/alive")
    client = ZenohBus(Endpoints(listen=(endpoint,)))
    try:
        seen = threading.Event()
        begin = time.perf_counter()
        client.watch("a/*/alive", lambda *_: seen.set())
        assert seen.wait(BOUND)
        assert is_quick(time.perf_counter() - begin, 2.0)
        assert client.caller("a/early", BOUND).request(b"x") == b"x"
    finally:
        server.close()
        client.close()


def test_a_slave_can_be_the_one_that_listens(endpoint: str) -> None:
    """The side that listens does not matter, either."""
    server = ZenohBus(Endpoints(listen=(endpoint,)))
    client = ZenohBus(Endpoints(connect=(endpoint,)))
    try:
        Network(server, client, lambda _: None).serve("a/echo", lambda data: data)
        assert client.caller("a/echo", BOUND).request(b"x") == b"x"
    finally:
        client.close()
        server.close()


# ---- Closing -----------------------------------------------------------------------------------


def test_closing_twice_is_closing(network: Network) -> None:
    """``close`` is idempotent, from several threads too, and quick."""
    network.serve("a/echo", lambda data: data)
    begin = time.perf_counter()
    threads = [threading.Thread(target=network.server.close) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(BOUND)
    network.server.close()
    network.client.close()
    assert is_quick(time.perf_counter() - begin, 2.0)


def test_a_closed_bus_raises_errors_of_ours(network: Network) -> None:
    """Whoever comes too late gets a `SlaveLostError`, never an exception of the transport."""
    network.serve("a/echo", lambda data: data)
    caller = network.client.caller("a/echo", 1.0)
    network.client.close()
    network.client.close()
    with pytest.raises(SlaveLostError):
        caller.request(b"")
    bus = network.client
    for late in (
        lambda: bus.caller("a/echo", 1.0).request(b""),
        lambda: bus.serve("a/late", bytes),
        lambda: bus.serve_here("a/late", bytes, lambda: None),
        lambda: bus.announce("a/late/alive"),
        lambda: bus.alive("a/*", 0.1),
        lambda: bus.watch("a/*", lambda *_: None),
    ):
        try:
            late()
        except DoublestepError as error:
            assert type(error) is SlaveLostError  # noqa: PT017  in process, late is harmless


# ---- Endpoints ---------------------------------------------------------------------------------


def test_a_port_in_use_is_named(endpoint: str) -> None:
    """Two masters cannot listen at one address; the second learns which and what to do."""
    first = ZenohBus(Endpoints(listen=(endpoint,)))
    try:
        with pytest.raises(ConfigurationError) as caught:
            ZenohBus(Endpoints(listen=(endpoint,)))
        text = str(caught.value)
        assert endpoint in text
        assert "in use" in text
        assert "--listen" in text
        assert "cargo" not in text
        assert ".rs" not in text
    finally:
        first.close()


@pytest.mark.parametrize(
    "address", ["0.0.0.0:7447", "192.0.2.1:7447", "[::]:7447", "example.org:1", "127.0.0.1.nip:1"]
)
def test_other_hosts_need_to_be_asked_for(address: str) -> None:
    """Unencrypted traffic beyond this host only when somebody says so aloud."""
    for where in ({"listen": (f"tcp/{address}",)}, {"connect": (f"tcp/{address}",)}):
        with pytest.raises(ConfigurationError, match=r"not a loopback address.*--insecure"):
            Endpoints(**where)
        Endpoints(**where, insecure=True)


@pytest.mark.parametrize(
    ("endpoint", "host"),
    [
        ("tcp/127.0.0.1:7447", "127.0.0.1"),
        ("tcp/127.8.9.10:0", "127.8.9.10"),
        ("tcp/[::1]:7447", "::1"),
        ("tcp/localhost:65535", "localhost"),
    ],
)
def test_loopback_is_allowed(endpoint: str, host: str) -> None:
    """All addresses of this host alone, in both versions of IP and by name."""
    Endpoints(listen=(endpoint,), connect=(endpoint,))
    assert host_and_port(endpoint)[0] == host


def test_tls_needs_certificates() -> None:
    """An address alone does not make a connection secure."""
    with pytest.raises(ConfigurationError, match=r"needs certificates; name their .* with --tls"):
        Endpoints(connect=("tls/127.0.0.1:7447",), insecure=True)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "127.0.0.1:7447",
        "tcp/",
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:",
        "tcp/:7447",
        "tcp/127.0.0.1:http",
        "tcp/127.0.0.1:-1",
        "tcp/127.0.0.1:65536",
        "udp/127.0.0.1:7447",
        "tls/127.0.0.1",
        "tcp/127.0.0.1:7447#iface=eth0",
        "tcp/127.0.0.1:7447?prio=1",
        "tcp//127.0.0.1:7447 ",
    ],
)
def test_a_malformed_endpoint_is_refused_with_the_form(text: str) -> None:
    """Nothing but ``tcp/HOST:PORT``, even where insecure addresses are allowed."""
    with pytest.raises(ConfigurationError, match=r"is not an endpoint; write tcp/HOST:PORT"):
        Endpoints(connect=(text,), insecure=True)


FORKED = """
import os, signal
from protocol.bus.endpoints import Endpoints
from protocol.errors import ConfigurationError
from protocol.bus.zenoh import ZenohBus

def opens() -> bool:
    try:
        ZenohBus(Endpoints()).close()
    except ConfigurationError as error:
        assert "forked" in error.cause and "spawn" in error.remedy
        return False
    return True

def opens_in_a_fork() -> bool:
    child = os.fork()
    if child == 0:
        os._exit(0 if opens() else 1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0

assert opens_in_a_fork(), "nothing of the bus was there to inherit"
assert opens() and opens()
assert not opens_in_a_fork(), "the threads of the bus are those of the other process"
"""


@pytest.mark.skipif(os.name != "posix", reason="forks")
def test_a_fork_of_a_process_that_has_used_the_bus_is_refused_one() -> None:
    """A fork, as `multiprocessing` makes it: told with the remedy, where Zenoh would hang."""
    subprocess.run([sys.executable, "-c", FORKED], check=True, timeout=BOUND)
