"""Messages between a node and its worker, one at a time: the program, then its reply.

A message is its length and its bytes. A short one is written by one call of the system and read by
one, into a buffer that is kept: beside a step of some microseconds calls and buffers count.
"""

from __future__ import annotations

import socket
from contextlib import suppress
from multiprocessing.connection import wait
from struct import Struct

_LENGTH = Struct("<I")
_SMALL = 2**14  # bytes; what is longer is not copied for the sake of one call
_KEPT = 2**20  # bytes; memory that is not used yet costs nothing


class Pipe:
    """One end. Only one message is under way at any time, in either direction.

    Args:
        end: of a connected pair of sockets; it is closed with the pipe.
    """

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._buffer = memoryview(bytearray(_KEPT))

    def send(self, message: bytes) -> None:
        """Send a message.

        Raises:
            OSError: the other end is gone.
        """
        length = _LENGTH.pack(len(message))
        if len(message) <= _SMALL:
            self._socket.sendall(length + message)
        else:
            self._socket.sendall(length)
            self._socket.sendall(message)

    def receive(self) -> bytes:
        """Wait for a message, as long as the other end is there.

        Raises:
            EOFError, OSError: the other end is gone.
        """
        buffer = self._buffer
        got = self._read(buffer)
        while got < _LENGTH.size:
            got += self._read(buffer[got:])
        end = _LENGTH.size + _LENGTH.unpack_from(buffer)[0]
        if end > len(buffer):
            buffer = memoryview(bytearray(end))
            buffer[:got] = self._buffer[:got]
        while got < end:
            got += self._read(buffer[got:])
        return bytes(buffer[_LENGTH.size : end])

    def _read(self, place: memoryview) -> int:
        """At least one byte."""
        size = self._socket.recv_into(place)
        if not size:
            raise EOFError
        return size

    def has_message(self, timeout: float) -> bool:
        """True if a message, or the end, comes within ``timeout`` seconds."""
        return bool(wait([self._socket], timeout))

    def hang_up(self) -> None:
        """End a wait for a message that will not come. From any thread."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close this end. Idempotent."""
        self._socket.close()
