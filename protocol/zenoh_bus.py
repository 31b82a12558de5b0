"""The bus over Zenoh. The only file that knows `zenoh`.

Safe by default: no scouting, explicit endpoints, loopback unless the user says otherwise aloud.
Requests are queries: one querier per key, one reply, collected from the query's own channel, so
that several can be under way at once. Measured reasons for each setting: ``docs/decisions/``.
"""

from __future__ import annotations

import ipaddress
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from protocol.bus import AliveListener, Bus, Caller, Handler, PendingReply
from protocol.errors import ConfigurationError, DeadlineError, SlaveLostError

os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(acc: (handover: app), net: (handover: app), tx: (handover: app),"
    " rx: (worker_threads: 1), app: (worker_threads: 1))",
)  # read once by zenoh, before the first session is opened: fewer thread hand-offs per query

import zenoh

_LEASE_MS = 2000
_FIRST_CONNECTION_MS = 100  # `open` waits so long for it, often in full; the default is 500
_TIMEOUT_PAYLOAD = b"Timeout"
_MAX_TOKENS = 4096
_CLOSE_TIME = 1.0
_REQUESTS_A_TOKEN = 512


@dataclass(frozen=True, slots=True)
class Endpoints:
    """Where a participant listens and to what it connects, as ``tcp/HOST:PORT``.

    Attributes:
        listen: addresses to listen on; empty: none, the participant is a client.
        connect: addresses to connect to, tried again for ever in the background.
        insecure: allow addresses that are not loopback; the traffic is neither encrypted nor
            authenticated.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    insecure: bool = False

    def __post_init__(self) -> None:
        for endpoint in (*self.listen, *self.connect):
            host = host_of(endpoint)
            if not self.insecure and not _is_loopback(host):
                raise ConfigurationError(
                    f"{endpoint} is not a loopback address, and the traffic would be neither "
                    "encrypted nor authenticated",
                    remedy="say --insecure if the network is trusted",
                )


def host_of(endpoint: str) -> str:
    """The host in ``tcp/HOST:PORT``.

    Raises:
        ConfigurationError: the endpoint has another form.
    """
    protocol, _, address = endpoint.partition("/")
    host, colon, port = address.rpartition(":")
    if protocol != "tcp" or not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigurationError(
            f"{endpoint!r} is not an endpoint", remedy="write tcp/HOST:PORT, as tcp/127.0.0.1:7447"
        )
    return host.strip("[]")


def free_endpoint() -> str:
    """A loopback endpoint on whose port nobody listens now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _config(endpoints: Endpoints) -> zenoh.Config:
    config = zenoh.Config()
    settings: dict[str, object] = {
        "mode": "peer",
        "listen/endpoints": list(endpoints.listen),
        "connect/endpoints": list(endpoints.connect),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": 50,
            "period_max_ms": 200,
            "period_increase_factor": 2,
        },
        "scouting/delay": _FIRST_CONNECTION_MS,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        "transport/link/tx/queue/size/data": 16,
        "transport/shared_memory/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


class ZenohBus(Bus):
    """One Zenoh session. Never fork a process that holds one.

    Raises:
        ConfigurationError: an address cannot be listened on.
    """

    def __init__(self, endpoints: Endpoints) -> None:
        zenoh.init_log_from_env_or("off")
        try:
            self._session = zenoh.open(_config(endpoints))
        except zenoh.ZError as error:
            raise ConfigurationError(
                f"cannot open the bus at {', '.join(endpoints.listen)}: {_first_line(error)}",
                remedy="another process may use the port: end it or choose another with --listen",
            ) from error
        self._closing = threading.Event()
        self._close_lock = threading.RLock()
        self._threads: list[threading.Thread] = []
        self._kept: list[object] = []

    def caller(self, key: str, timeout: float) -> Caller:
        """See `Bus`."""
        with _closed_is_lost():
            querier = self._session.declare_querier(
                key, consolidation=zenoh.ConsolidationMode.NONE, timeout=timeout
            )
        return _ZenohCaller(querier, key, timeout)

    def serve(self, key: str, handler: Handler) -> None:
        """See `Bus`."""
        with _closed_is_lost():
            queryable = self._session.declare_queryable(key)
        thread = threading.Thread(
            target=self._answer, args=(queryable, handler), name=f"serve {key}", daemon=True
        )
        self._threads.append(thread)
        thread.start()

    def serve_here(self, key: str, handler: Handler, ready: Callable[[], None]) -> None:
        """See `Bus`."""
        with _closed_is_lost():
            queryable = self._session.declare_queryable(key)
        ready()
        self._answer(queryable, handler)

    def _answer(
        self, queryable: zenoh.Queryable[zenoh.handlers.Handler[zenoh.Query]], handler: Handler
    ) -> None:
        try:
            while not self._closing.is_set():
                query = queryable.recv()
                with query:
                    payload = query.payload
                    query.reply(query.key_expr, handler(b"" if payload is None else bytes(payload)))
        except zenoh.ZError:
            if not self._closing.is_set():
                raise

    def announce(self, key: str) -> None:
        """See `Bus`."""
        with _closed_is_lost():
            self._kept.append(self._session.liveliness().declare_token(key))

    def alive(self, pattern: str, timeout: float) -> list[str]:
        """See `Bus`."""
        with _closed_is_lost():
            replies = self._session.liveliness().get(
                pattern, zenoh.handlers.FifoChannel(_MAX_TOKENS), timeout=timeout
            )
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def watch(self, pattern: str, listener: AliveListener) -> None:
        """See `Bus`."""

        def tell(sample: zenoh.Sample) -> None:
            listener(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        with _closed_is_lost():
            self._kept.append(
                self._session.liveliness().declare_subscriber(pattern, tell, history=True)
            )

    def close(self) -> None:
        """See `Bus`. Waits a bounded time for requests that are being served.

        When this returns, whoever called it first, nothing of Zenoh is running any more: a thread
        inside it at the end of the process would abort the process.
        """
        with self._close_lock:
            if not self._closing.is_set():
                self._closing.set()
                with suppress(zenoh.ZError):
                    self._session.close()  # type: ignore[no-untyped-call]  # not in zenoh's stub
        end = time.monotonic() + _CLOSE_TIME
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, end - time.monotonic()))


class _ZenohCaller(Caller):
    def __init__(self, querier: zenoh.Querier, key: str, timeout: float) -> None:
        self._querier = querier
        self.key = key
        self.timeout = timeout
        self._lock = threading.Lock()
        self._cancelled = False
        self._tokens = [zenoh.CancellationToken()]
        self._left = _REQUESTS_A_TOKEN

    def send(self, payload: bytes) -> PendingReply:
        self._left -= 1
        if self._left == 0:
            self._renew_token()
        try:
            channel = self._querier.get(payload=payload, cancellation_token=self._tokens[-1])
        except zenoh.ZError as error:
            raise SlaveLostError(f"cannot ask {self.key}: {_first_line(error)}") from error
        return _ZenohReply(channel, self)

    def _renew_token(self) -> None:
        """A token remembers all queries it was given to; the last two serve what is pending."""
        with self._lock:
            self._left = _REQUESTS_A_TOKEN
            self._tokens = [self._tokens[-1], zenoh.CancellationToken()]
            if self._cancelled:
                self._cancel_tokens()

    def cancel(self) -> None:
        with self._lock:
            self._cancelled = True
            self._cancel_tokens()

    def _cancel_tokens(self) -> None:
        for token in self._tokens:
            token.cancel()  # type: ignore[no-untyped-call]  # missing in zenoh's stub


class _ZenohReply(PendingReply):
    """Holds its caller: a querier that is dropped takes its queries with it."""

    def __init__(self, channel: zenoh.handlers.Handler[zenoh.Reply], caller: _ZenohCaller) -> None:
        self._channel = channel
        self._caller = caller

    def result(self) -> bytes:
        try:
            reply = self._channel.recv()
        except zenoh.ZError as error:
            raise SlaveLostError("no reply: it is not there, or went away") from error
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
        payload = b"" if reply.err is None else reply.err.payload.to_bytes()
        if payload == _TIMEOUT_PAYLOAD:
            raise DeadlineError(f"no reply within {self._caller.timeout:g} s")
        raise SlaveLostError(f"{self._caller.key} answered {payload[:200]!r}")


@contextmanager
def _closed_is_lost() -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise SlaveLostError(f"the bus cannot be used: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    """The words of a Zenoh error without the places in its source."""
    return str(error).partition(" at /")[0].partition("\n")[0]
