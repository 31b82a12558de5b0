"""The bus: requests to keys, handlers that serve them, and who is alive.

`Bus` is the waist between everything above and the transport below. Implementations:
`InProcessBus` here, `ZenohBus` in ``zenoh.py``. Payloads are bytes; nothing here knows what
they mean.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable

from protocol.bus.room import Room
from protocol.errors import SlaveLostError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Where a master and slaves that were started by hand meet by default."""

Handler = Callable[[bytes], bytes]
"""Serves one request. Called by one thread at a time; must not raise."""

AliveListener = Callable[[str, bool], None]
"""Told the key of a token and whether it appeared (True) or went away (False)."""


class PendingReply(ABC):
    """A request under way."""

    @abstractmethod
    def result(self) -> bytes:
        """Wait for the reply.

        Raises:
            DeadlineError: the timeout passed; the request may still be executed later.
            SlaveLostError: the key is not served, or its server went away before replying.
        """


class Caller(ABC):
    """Sends requests to one key."""

    @abstractmethod
    def send(self, payload: bytes) -> PendingReply:
        """Send a request and go on; the reply is collected from what this returns."""

    @abstractmethod
    def cancel(self) -> None:
        """Let every pending ``result`` raise `SlaveLostError` now: who served the key is gone."""

    def request(self, payload: bytes) -> bytes:
        """Send a request and wait for its reply; raises as `PendingReply.result`."""
        return self.send(payload).result()


class Bus(ABC):
    """One participant's access to the bus. All methods may be called from any thread.

    After ``close``, or when the connection was closed, methods may raise `SlaveLostError`.
    """

    @abstractmethod
    def caller(self, key: str, timeout: float) -> Caller:
        """For requests to ``key``, each answered within ``timeout`` seconds or failed."""

    @abstractmethod
    def serve(self, key: str, handler: Handler, room: Room | None = None) -> None:
        """Let ``handler`` answer the requests to ``key``, on a thread of its own.

        A request for which there is no room is dropped: its sender gets an empty answer,
        and may send it again.

        Args:
            key: of the requests.
            handler: answers them, one at a time.
            room: for those that wait and the one that is being served; None: `SMALL_ROOM` of its
                own. May be shared with other keys.
        """

    @abstractmethod
    def serve_here(
        self, key: str, handler: Handler, ready: Callable[[], None], room: Room | None = None
    ) -> None:
        """Query on the calling thread, for the hot path; returns when the bus is closed.

        ``ready`` is called once requests to ``key`` will be answered.
        """

    @abstractmethod
    def announce(self, key: str) -> None:
        """Put up a liveliness token, until this participant closes or dies."""

    @abstractmethod
    def alive(self, pattern: str, timeout: float) -> list[str]:
        """The keys of the tokens that match ``pattern``, sorted, asked for now."""

    @abstractmethod
    def watch(self, pattern: str, listener: AliveListener) -> None:
        """Tell ``listener`` of tokens there are and of every change, on a thread of the bus."""

    @abstractmethod
    def close(self) -> None:
        """Leave the bus. Idempotent."""


class InProcessBus(Bus):
    """The bus within one process: a request is a call, the bytes are the same as on a wire.

    Several participants share one by using the same object; ``close`` ends it for all.
    """

    def __init__(self) -> None:
        self._handlers: dict[str, tuple[Handler, threading.Lock]] = {}
        self._tokens: set[str] = set()
        self._listeners: list[tuple[str, AliveListener]] = []
        self._closed = threading.Event()

    def caller(self, key: str, timeout: float) -> Caller:  # noqa: ARG002  calls return at once
        """See `Bus`."""
        return _InProcessCaller(self, key)

    def serve(self, key: str, handler: Handler, room: Room | None = None) -> None:  # noqa: ARG002
        """See `Bus`; a request is a call here, and does not wait."""
        self._handlers[key] = (handler, threading.Lock())

    def serve_here(
        self,
        key: str,
        handler: Handler,
        ready: Callable[[], None],
        room: Room | None = None,  # noqa: ARG002  as above
    ) -> None:
        """See `Bus`."""
        self.serve(key, handler)
        ready()
        self._closed.wait()

    def announce(self, key: str) -> None:
        """See `Bus`."""
        self._tokens.add(key)
        self._tell(key, True)

    def withdraw(self, key: str) -> None:
        """Take down a token and all handlers beside it, as a participant's death would."""
        self._tokens.discard(key)
        prefix = key.rsplit("/", 1)[0] + "/"
        for served in [k for k in self._handlers if k.startswith(prefix)]:
            del self._handlers[served]
        self._tell(key, False)

    def alive(self, pattern: str, timeout: float) -> list[str]:  # noqa: ARG002  known at once
        """See `Bus`."""
        return sorted(key for key in self._tokens if matches(pattern, key))

    def watch(self, pattern: str, listener: AliveListener) -> None:
        """See `Bus`."""
        self._listeners.append((pattern, listener))
        for key in self.alive(pattern, 0.0):
            listener(key, True)

    def close(self) -> None:
        """See `Bus`."""
        self._handlers.clear()
        for key in list(self._tokens):
            self._tokens.discard(key)
            self._tell(key, False)
        self._closed.set()

    def _tell(self, key: str, alive: bool) -> None:
        for pattern, listener in self._listeners:
            if matches(pattern, key):
                listener(key, alive)

    def handle(self, key: str, payload: bytes) -> bytes:
        """Let the handler of ``key`` answer; raises `SlaveLostError` if there is none."""
        served = self._handlers.get(key)
        if served is None:
            raise SlaveLostError(f"no participant serves {key}")
        handler, one_at_a_time = served
        with one_at_a_time:
            return handler(payload)


class _InProcessCaller(Caller):
    def __init__(self, bus: InProcessBus, key: str) -> None:
        self._bus = bus
        self._key = key

    def send(self, payload: bytes) -> PendingReply:
        try:
            return _Done(self._bus.handle(self._key, payload))
        except SlaveLostError as error:
            return _Done(error)

    def cancel(self) -> None:
        """Nothing is ever pending."""


class _Done(PendingReply):
    def __init__(self, outcome: bytes | SlaveLostError) -> None:
        self._outcome = outcome

    def result(self) -> bytes:
        if isinstance(self._outcome, SlaveLostError):
            raise self._outcome
        return self._outcome


def matches(pattern: str, key: str) -> bool:
    """True if ``key`` is one of those that ``pattern`` stands for; ``*`` is any one part."""
    chunks, parts = pattern.split("/"), key.split("/")
    return len(chunks) == len(parts) and all(
        chunk in ("*", part) for chunk, part in zip(chunks, parts, strict=True)
    )
