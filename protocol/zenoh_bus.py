"""The bus over Zenoh. The only file that knows `zenoh`.

Safe by default: no scouting, explicit endpoints (``endpoints.py``), and with certificates only who
has one of a role is heard (``access.py``).
Requests are queries: one querier per key, one reply, collected from the query's own channel, so
that several can be under way at once. Measured reasons for each setting: ``docs/decisions/``.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from protocol.access import access_control
from protocol.bus import AliveListener, Bus, Caller, Handler, PendingReply
from protocol.codec import MAX_MESSAGE_BYTES
from protocol.credentials import Credentials
from protocol.endpoints import Endpoints, Mode
from protocol.errors import ConfigurationError, DeadlineError, HostLimitError, SlaveLostError
from protocol.reachability import Reach, probe_all
from protocol.threads import LIMITS, start_thread

os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(acc: (handover: app), net: (handover: app), tx: (handover: app),"
    " rx: (worker_threads: 1), app: (worker_threads: 1))",
)  # read once by zenoh, before the first session is opened: fewer thread hand-offs per query

import zenoh

log = logging.getLogger("protocol")

_LEASE_MS = 2000
_FIRST_CONNECTION_MS = 100  # `open` waits so long for it, often in full; the default is 500
_TIMEOUT_PAYLOAD = b"Timeout"
_CLIENT_ATTEMPT_MS = 300
_PROBE_TIME = 2.0
_PROBE_PERIOD = 1.0
_DROPPED_BYTES = 4 * MAX_MESSAGE_BYTES  # what is shorter is refused with an answer
_MAX_TOKENS = 4096
_CLOSE_TIME = 1.0
_REQUESTS_A_TOKEN = 512


def _config(endpoints: Endpoints) -> zenoh.Config:
    config = zenoh.Config()
    is_client = endpoints.mode is Mode.CLIENT
    settings: dict[str, object] = {
        "mode": str(endpoints.mode),
        "listen/endpoints": list(endpoints.listen),
        "connect/endpoints": list(endpoints.connect),
        # Opening a client waits for its first connection, and this is asked again and again.
        "connect/timeout_ms": _CLIENT_ATTEMPT_MS if is_client else -1,
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
        "transport/link/rx/max_message_size": _DROPPED_BYTES,
        "transport/shared_memory/enabled": False,
    }
    if endpoints.credentials is not None:
        settings |= _tls(endpoints.credentials)
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _tls(credentials: Credentials) -> dict[str, object]:
    tls = "transport/link/tls"
    return {
        f"{tls}/root_ca_certificate": str(credentials.authority),
        f"{tls}/listen_certificate": str(credentials.certificate),
        f"{tls}/listen_private_key": str(credentials.key),
        f"{tls}/connect_certificate": str(credentials.certificate),
        f"{tls}/connect_private_key": str(credentials.key),
        f"{tls}/enable_mtls": True,
        f"{tls}/verify_name_on_connect": True,
        "access_control": access_control(),
    }


def _secured(endpoints: Endpoints) -> tuple[str, ...]:
    """What to connect to with a certificate."""
    return endpoints.connect if endpoints.credentials is not None else ()


def _session(endpoints: Endpoints) -> zenoh.Session:
    try:
        return zenoh.open(_config(endpoints))
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # it has no other name, and no module
            raise
        raise HostLimitError(f"the bus cannot be opened: {error}", remedy=LIMITS) from error


def _open(endpoints: Endpoints) -> zenoh.Session:
    try:
        return _session(endpoints)
    except zenoh.ZError as error:
        raise ConfigurationError(
            f"cannot open the bus at {', '.join(endpoints.listen)}: {_first_line(error)}",
            remedy="another process may use the port: end it or choose another with --listen",
        ) from error


def _open_client(
    endpoints: Endpoints, timeout: float | None, stop: threading.Event
) -> zenoh.Session:
    """Try until a router is there; a short time each, as an attempt cannot be interrupted."""
    where = ", ".join(endpoints.connect)
    end = None if timeout is None else time.monotonic() + timeout
    told = False
    while not stop.is_set():
        begin = time.monotonic()
        try:
            return _session(endpoints)
        except zenoh.ZError:
            if not told:
                log.info("waiting for a router at %s", where)
                told = True
            attempts = probe_all(_secured(endpoints), endpoints.credentials, _PROBE_TIME)
            for attempt in attempts:
                attempt.check()
        if end is not None and time.monotonic() > end:
            raise SlaveLostError(
                f"no connection to {where} within {timeout:g} s",
                phase="connect",
                remedy="start the router with `slave-node router --listen ...`, or check --connect",
            )
        stop.wait(max(0.0, begin + _CLIENT_ATTEMPT_MS / 1000 - time.monotonic()))
    raise SlaveLostError(f"ended while waiting for a router at {where}")


class ZenohBus(Bus):
    """One Zenoh session. Never fork a process that holds one.

    Args:
        endpoints: where to listen and to connect.
        timeout: how long a client waits for its router [s]; None: for ever.
        stop: when it is set, a client waits no more.

    Raises:
        ConfigurationError: an address cannot be listened on, or who is there does not accept our
            certificate.
        SlaveLostError: a client found no router in time.
    """

    def __init__(
        self,
        endpoints: Endpoints,
        timeout: float | None = None,
        stop: threading.Event | None = None,
    ) -> None:
        zenoh.init_log_from_env_or("off")
        probes = probe_all(_secured(endpoints), endpoints.credentials, _PROBE_TIME)
        for attempt in probes:
            attempt.check()
        self._closing = threading.Event()
        self._close_lock = threading.RLock()
        self._threads: list[threading.Thread] = []
        self._kept: list[object] = []
        if endpoints.mode is Mode.CLIENT:
            self._session = _open_client(endpoints, timeout, stop or self._closing)
        else:
            self._session = _open(endpoints)
            left = [a.endpoint for a in probes if a.reach is not Reach.REACHED]
            if left and endpoints.credentials is not None:
                self._explain_later(left, endpoints.credentials)

    def _explain_later(self, endpoints: list[str], credentials: Credentials) -> None:
        """Who was not there yet may turn out not to accept us, of which Zenoh tells nothing."""

        def look() -> None:
            left = endpoints
            while left and not self._closing.wait(_PROBE_PERIOD):
                attempts = probe_all(left, credentials, _PROBE_TIME)
                for attempt in attempts:
                    try:
                        attempt.check()
                    except ConfigurationError as error:
                        log.error("%s", error)
                left = [a.endpoint for a in attempts if a.reach is Reach.NOT_REACHED]

        start_thread(look, "reachability")

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
        self._threads.append(start_thread(lambda: self._answer(queryable, handler), f"serve {key}"))

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
