"""Messages between a slave and the processes that hold its model: a kind and bytes, on a socket."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable
from enum import IntEnum
from struct import Struct

PROCESS = Struct("<q")
"""A process id, with which a holder says that it is there."""

DURATION = Struct("<d")
"""Seconds that the model took: stands before the answers of `Message.STEP` and `Message.PROGRAM`
that are ``DONE``."""

_HEADER = Struct("<BQ")
_CHUNK = 2**20


class Message(IntEnum):
    """Subject of a message. Each one that asks is answered by ``DONE`` or ``REFUSED``.

    ``LOAD``: load the model that a map tells. ``STEP``: take a step, see ``step_message.py``.
    ``PROGRAM``: execute any other calls. ``FORK``: make a copy that serves the socket that
    follows; it is answered on that socket, by the copy. ``CLOSE``: free the model.
    """

    LOAD = 0
    STEP = 1
    PROGRAM = 2
    FORK = 3
    CLOSE = 4
    DONE = 5
    REFUSED = 6


_MESSAGES = tuple(Message)


class Channel:
    """One end of a connected pair of Unix sockets.

    Args:
        connection: the end; it is closed with the channel.
        idle: called whenever a wait has lasted ``idle_time``; it may raise, which ends the wait.
        idle_time: seconds; None: waits are bounded by the life of the other end alone.
    """

    def __init__(
        self,
        connection: socket.socket,
        idle: Callable[[], None] = lambda: None,
        idle_time: float | None = None,
    ) -> None:
        connection.settimeout(idle_time)
        self._socket = connection
        self._idle = idle

    def fileno(self) -> int:
        """The descriptor."""
        return self._socket.fileno()

    def send(self, kind: Message, payload: bytes = b"") -> None:
        """Send one message.

        Raises:
            OSError: the other end is gone.
        """
        rest = memoryview(_HEADER.pack(kind, len(payload)) + payload)
        while rest:
            try:
                rest = rest[self._socket.send(rest) :]
            except TimeoutError:  # it computes, or was stopped: that is no death
                self._idle()

    def receive(self) -> tuple[Message, bytes]:
        """Wait for one message.

        Raises:
            EOFError, OSError: the other end is gone.
        """
        kind, size = _HEADER.unpack(self._exactly(_HEADER.size))
        return _MESSAGES[kind], self._exactly(size)

    def wait(self, timeout: float) -> bool:
        """True if a message, or the end, comes within ``timeout`` seconds."""
        poll = select.poll()
        poll.register(self._socket, select.POLLIN)
        return bool(poll.poll(timeout * 1e3))

    def send_socket(self, connection: socket.socket) -> None:
        """Hand over a socket; the sender closes its own afterwards.

        Raises:
            OSError: the other end is gone.
        """
        while True:
            try:
                socket.send_fds(self._socket, [b"\0"], [connection.fileno()])
            except TimeoutError:
                self._idle()
            else:
                return

    def receive_socket(self) -> socket.socket:
        """The socket that is handed over.

        Raises:
            EOFError, OSError: the other end is gone.
        """
        while True:
            try:
                data, descriptors, _, _ = socket.recv_fds(self._socket, 1, 1)
            except TimeoutError:
                self._idle()
                continue
            if not data or not descriptors:
                raise EOFError
            return socket.socket(fileno=descriptors[0])

    def close(self) -> None:
        """Close this end. Idempotent."""
        self._socket.close()

    def _exactly(self, size: int) -> bytes:
        data = self._some(size)
        if len(data) == size:
            return data
        parts = [data]
        missing = size - len(data)
        while missing:
            parts.append(self._some(missing))
            missing -= len(parts[-1])
        return b"".join(parts)

    def _some(self, size: int) -> bytes:
        """From one byte to ``size``; none if none are asked for."""
        while True:
            try:
                data = self._socket.recv(min(size, _CHUNK))
            except TimeoutError:
                self._idle()
                continue
            if not data and size:
                raise EOFError
            return data
