"""The bus over Zenoh. The only file that knows `zenoh`.

Safe by default: no scouting, explicit endpoints (``endpoints.py``), and with certificates only who
has one of a role is heard (``access.py``).
Requests are queries: one querier per key, one reply, collected from the query's own channel, so
that several can be under way at once. Measured reasons for each setting: ``docs/decisions/``.

What others send is bounded in bytes: a message (Zenoh drops longer ones unread), the requests that
wait (``request_line.py``), the replies to a request (`_Pending`), the tokens that are looked at.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from weakref import WeakSet

from protocol.bus.access import access_control
from protocol.bus.bus import AliveListener, Bus, Caller, Handler, PendingReply
from protocol.bus.credentials import Credentials
from protocol.bus.endpoints import Endpoints, Mode
from protocol.bus.reachability import Probe, Reach, probe_all, probe_without_tls
from protocol.bus.request_line import Line
from protocol.bus.room import SMALL_ROOM, Room
from protocol.errors import ConfigurationError, DeadlineError, HostLimitError, SlaveLostError
from protocol.host.threads import LIMITS, start_thread
from protocol.wire.packing import MAX_MESSAGE_BYTES, check_length

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
_ENVELOPE_BYTES = 2**16  # what Zenoh puts around a payload
_MAX_TOKENS = 4096
_MAX_WAITING = 32  # requests that Zenoh holds for a key; more wait on the network
_MAX_REPLIES = 2  # one, and what Zenoh itself says at the timeout
_MOST_AT_ONCE = 1000
_PATIENCE = 0.1
_ATTENTION = 0.01
_CLOSE_TIME = 1.0
_REQUESTS_A_TOKEN = 512


def _config(endpoints: Endpoints, largest: int) -> zenoh.Config:
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
        "transport/link/rx/max_message_size": largest + _ENVELOPE_BYTES,
        "transport/unicast/qos/enabled": False,  # else each link holds eight unfinished messages
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
    """Endpoint to connect to with a certificate."""
    return endpoints.connect if endpoints.credentials is not None else ()


def _probes(endpoints: Sequence[str], credentials: Credentials | None) -> list[Probe]:
    """Why connections do not come about, of which Zenoh tells nothing."""
    if credentials is None:
        return [probe_without_tls(endpoint, _PROBE_TIME) for endpoint in endpoints]
    return probe_all(endpoints, credentials, _PROBE_TIME)


_processes: set[int] = set()
"""In which Zenoh runs its threads: this one, or one from which it was forked."""


def _check_not_forked() -> None:
    if _processes and os.getpid() not in _processes:
        raise ConfigurationError(
            "this process was forked from one that has used the bus, which does not work here",
            remedy="start it afresh, as by multiprocessing.get_context('spawn'), or run in process",
        )


def _session(endpoints: Endpoints, largest: int) -> zenoh.Session:
    try:
        return zenoh.open(_config(endpoints, largest))
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # it has no other name, and no module
            raise
        raise HostLimitError(f"the bus cannot be opened: {error}", remedy=LIMITS) from error


def _open(endpoints: Endpoints, largest: int) -> zenoh.Session:
    try:
        return _session(endpoints, largest)
    except zenoh.ZError as error:
        raise ConfigurationError(
            f"cannot open the bus at {', '.join(endpoints.listen)}: {_first_line(error)}",
            remedy="another process may use the port: end it or choose another with --listen",
        ) from error


def _open_client(
    endpoints: Endpoints, largest: int, timeout: float | None, stop: threading.Event
) -> zenoh.Session:
    """Try until a router is there; a short time each, as an attempt cannot be interrupted."""
    where = ", ".join(endpoints.connect)
    end = None if timeout is None else time.monotonic() + timeout
    told = False
    while not stop.is_set():
        begin = time.monotonic()
        try:
            return _session(endpoints, largest)
        except zenoh.ZError:
            if not told:
                log.info("waiting for a router at %s", where)
                told = True
            for attempt in _probes(endpoints.connect, endpoints.credentials):
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
        largest: length of the largest message that is received [bytes]; Zenoh drops longer ones.

    Raises:
        ConfigurationError: an address cannot be listened on, who is there does not accept our
            certificate, or this process was forked from one that has used the bus.
        SlaveLostError: a client found no router in time.
    """

    def __init__(
        self,
        endpoints: Endpoints,
        timeout: float | None = None,
        stop: threading.Event | None = None,
        largest: int = MAX_MESSAGE_BYTES,
    ) -> None:
        _check_not_forked()
        _processes.add(os.getpid())
        zenoh.init_log_from_env_or("off")
        probes = probe_all(_secured(endpoints), endpoints.credentials, _PROBE_TIME)
        for attempt in probes:
            attempt.check()
        self._closing = threading.Event()
        self._close_lock = threading.RLock()
        self._threads: list[threading.Thread] = []
        self._lines: list[Line[zenoh.Query]] = []
        self._pending = _Pending()
        self._kept: list[object] = []
        self._attends = False
        if endpoints.mode is Mode.CLIENT:
            self._session = _open_client(endpoints, largest, timeout, stop or self._closing)
        else:
            self._session = _open(endpoints, largest)
            left = [e for e in endpoints.connect if Probe(e, Reach.REACHED) not in probes]
            if left:
                self._explain_later(left, endpoints)

    def _explain_later(self, left: list[str], endpoints: Endpoints) -> None:
        """Probe again whoever was not there yet: a connection to them may never come about."""

        def look() -> None:
            remaining = left
            while remaining and not self._closing.wait(_PROBE_PERIOD):
                if endpoints.credentials is None and self._is_connected(len(endpoints.connect)):
                    return
                attempts = _probes(remaining, endpoints.credentials)
                for attempt in attempts:
                    try:
                        attempt.check()
                    except ConfigurationError as error:
                        log.error("%s", error)
                remaining = [a.endpoint for a in attempts if a.reach is Reach.NOT_REACHED]

        start_thread(look, "reachability")

    def _is_connected(self, number: int) -> bool:
        """True when there are as many connections, or the session is closed."""
        with suppress(zenoh.ZError):
            info = self._session.info
            return len(info.peers_zid()) + len(info.routers_zid()) >= number
        return True  # closed

    def caller(self, key: str, timeout: float) -> Caller:
        """See `Bus`. Of replies without number only the last is kept, until all are there."""
        with _closed_is_lost():
            querier = self._session.declare_querier(
                key, consolidation=zenoh.ConsolidationMode.LATEST, timeout=timeout
            )
        self._begin_to_attend()
        return _ZenohCaller(querier, key, timeout, self._pending)

    def serve(self, key: str, handler: Handler, room: Room | None = None) -> None:
        """See `Bus`."""
        line = self._line(key, room)
        self._threads.append(start_thread(lambda: self._answer(line, handler), f"serve {key}"))

    def serve_here(
        self, key: str, handler: Handler, ready: Callable[[], None], room: Room | None = None
    ) -> None:
        """See `Bus`."""
        line = self._line(key, room)
        ready()
        self._answer(line, handler)

    def _line(self, key: str, room: Room | None) -> Line[zenoh.Query]:
        with _closed_is_lost():
            queryable = self._session.declare_queryable(
                key, zenoh.handlers.FifoChannel(_MAX_WAITING)
            )
        line = Line(queryable, room or Room(SMALL_ROOM), _size, _drop)
        self._lines.append(line)
        self._begin_to_attend()
        return line

    def _begin_to_attend(self) -> None:
        with self._close_lock:
            if not self._attends and not self._closing.is_set():
                self._threads.append(start_thread(self._attend, "attention"))
                self._attends = True

    def _attend(self) -> None:
        """Look after requests and replies that wait for long: Zenoh stands still behind them."""
        period = _PATIENCE
        while not self._closing.wait(period):
            busy = self._pending.attend()
            with suppress(zenoh.ZError):  # a queryable of a session that was closed
                busy |= sum(line.attend(_PATIENCE) for line in list(self._lines)) > 0
            period = _ATTENTION if busy else _PATIENCE

    def _answer(self, line: Line[zenoh.Query], handler: Handler) -> None:
        try:
            while not self._closing.is_set():
                query = line.next()
                with query:
                    payload = query.payload
                    query.reply(query.key_expr, handler(b"" if payload is None else bytes(payload)))
                del query, payload  # else held until the next one comes
        except zenoh.ZError:
            if not self._closing.is_set():
                raise

    def announce(self, key: str) -> None:
        """See `Bus`."""
        with _closed_is_lost():
            self._kept.append(self._session.liveliness().declare_token(key))

    def alive(self, pattern: str, timeout: float) -> list[str]:
        """See `Bus`. Of more than 4096 tokens the first that are heard of are there."""
        keys: set[str] = set()
        done = threading.Event()

        def hear(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(keys) < _MAX_TOKENS:
                keys.add(str(reply.ok.key_expr))

        # Not a channel: where it is full Zenoh waits within the call, for who would empty it.
        handler = zenoh.handlers.Callback(hear, done.set, indirect=False)
        with _closed_is_lost():
            self._session.liveliness().get(pattern, handler, timeout=timeout)
        done.wait(timeout + _CLOSE_TIME)
        return sorted(keys)

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


class _Pending:
    """Replies that are still to be read; from any thread.

    A slave can answer one request with any number of errors. Zenoh waits for room for them, and all
    other replies with it, so they are taken from channels that are not being read.
    """

    def __init__(self) -> None:
        self._replies: WeakSet[_ZenohReply] = WeakSet()
        self._lock = threading.Lock()

    def add(self, reply: _ZenohReply) -> None:
        """One more, until it is dropped."""
        with self._lock:
            self._replies.add(reply)

    def attend(self) -> bool:
        """Take in what came; True if there was something."""
        with self._lock:
            replies = list(self._replies)
        return sum(reply.take_in() for reply in replies) > 0


class _ZenohCaller(Caller):
    def __init__(self, querier: zenoh.Querier, key: str, timeout: float, pending: _Pending) -> None:
        self._querier = querier
        self._pending = pending
        self.key = key
        self.timeout = timeout
        self._lock = threading.Lock()
        self._cancelled = False
        self._tokens = [zenoh.CancellationToken()]
        self._left = _REQUESTS_A_TOKEN

    def send(self, payload: bytes) -> PendingReply:
        check_length(payload, "a request")
        self._left -= 1
        if self._left == 0:
            self._renew_token()
        try:
            channel = self._querier.get(
                zenoh.handlers.FifoChannel(_MAX_REPLIES),
                payload=payload,
                cancellation_token=self._tokens[-1],
            )
        except zenoh.ZError as error:
            raise SlaveLostError(f"cannot ask {self.key}: {_first_line(error)}") from error
        reply = _ZenohReply(channel, self)
        self._pending.add(reply)
        return reply

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
        self._lock = threading.Lock()
        self._first: zenoh.Reply | None = None
        self._is_read = False

    def take_in(self) -> bool:
        """Keep the first reply and drop others, unless they are being read; True if one came."""
        count = 0
        with self._lock, suppress(zenoh.ZError):  # there are no more
            while not self._is_read and count < _MOST_AT_ONCE:
                reply = self._channel.try_recv()
                if reply is None:
                    break
                self._first = self._first or reply
                count += 1
        return count > 0

    def result(self) -> bytes:
        with self._lock:
            self._is_read = True
        try:
            reply = self._first = self._first or self._channel.recv()
        except zenoh.ZError as error:
            raise SlaveLostError("no reply: it is not there, or went away") from error
        finally:
            self._is_read = False
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
        payload = b"" if reply.err is None else reply.err.payload.to_bytes()
        if payload == _TIMEOUT_PAYLOAD:
            raise DeadlineError(f"no reply within {self._caller.timeout:g} s")
        raise SlaveLostError(f"{self._caller.key} answered {payload[:200]!r}")


def _size(query: zenoh.Query) -> int:
    """Bytes that a request holds."""
    payload, attachment, parameters = query.payload, query.attachment, query.parameters
    size = 0 if payload is None else len(payload)
    size += 0 if attachment is None else len(attachment)
    return size if parameters.is_empty() else size + len(str(parameters))


def _drop(query: zenoh.Query) -> None:
    """Answer nothing."""
    with query:
        pass


@contextmanager
def _closed_is_lost() -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise SlaveLostError(f"the bus cannot be used: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    """The words of a Zenoh error without the places in its source."""
    return str(error).partition(" at /")[0].partition("\n")[0]
