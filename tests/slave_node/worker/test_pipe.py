"""The pipe between node and worker: any length there and back, and an end that is noticed."""

from __future__ import annotations

import random
import socket
import threading
from collections.abc import Iterator

import pytest

from slave_node.worker.pipe import Pipe

LENGTHS = [0, 1, 2**14, 2**14 + 1, 2**20 - 4, 2**20 - 3, 3 * 2**20]
"""Around those where it sends in two parts, and where its buffer ends with and without header."""


@pytest.fixture
def ends() -> Iterator[tuple[Pipe, Pipe]]:
    """Both ends of one pipe."""
    pipes = tuple(map(Pipe, socket.socketpair()))
    yield pipes[0], pipes[1]
    for pipe in pipes:
        pipe.close()


def test_messages_of_any_length(ends: tuple[Pipe, Pipe]) -> None:
    """Messages arrive byte by byte as sent, however they are cut up; nothing is left for
    the next message, nor of the one before.
    """
    left, right = ends
    bytes_of = random.Random(1).randbytes
    for sender, receiver in ((left, right), (right, left)):
        for length in LENGTHS + LENGTHS[::-1]:
            message = bytes_of(length)
            sending = threading.Thread(target=sender.send, args=(message,))
            sending.start()
            assert receiver.receive() == message
            sending.join(10.0)


def test_a_message_in_pieces() -> None:
    """A length that arrives byte by byte, and a message in two halves, are put together."""
    raw, end = socket.socketpair()
    pipe = Pipe(end)
    received: list[bytes] = []
    reading = threading.Thread(target=lambda: received.append(pipe.receive()))
    reading.start()
    for piece in (b"\6", b"\0", b"\0", b"\0", b"abc", b"def"):
        raw.sendall(piece)
        reading.join(0.01)
    reading.join(10.0)
    assert received == [b"abcdef"]
    pipe.close()
    raw.close()


def test_an_end_is_noticed(ends: tuple[Pipe, Pipe]) -> None:
    """Messages before the end are still received; then reading and writing fail at once, and in
    the middle of a message too.
    """
    left, right = ends
    assert not right.has_message(0.0)
    left.send(b"last")
    left.close()
    assert right.has_message(10.0)
    assert right.receive() == b"last"
    assert right.has_message(10.0)
    with pytest.raises(EOFError):
        right.receive()
    with pytest.raises(OSError, match=r"pipe|reset|abort"):
        right.send(b"nobody reads this")

    raw, end = socket.socketpair()
    raw.sendall(b"\5\0\0\0abc")
    raw.close()
    half = Pipe(end)
    with pytest.raises(EOFError):
        half.receive()
    half.close()
