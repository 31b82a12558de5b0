"""MessagePack bytes, within limits of length and number. The only module that knows `msgpack`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from struct import Struct
from typing import Any, Final

import msgpack
import numpy as np

from protocol.errors import MalformedMessageError
from protocol.signals import FloatArray

PROTOCOL_VERSION: Final = 1
MAX_MESSAGE_BYTES: Final = 64 * 2**20
MAX_COLUMNS: Final = 200_000
MAX_CONTAINERS: Final = 500_000
SMALL_MESSAGE: Final = 2**10
LITTLE_ENDIAN = np.dtype("<f8")
Part = bytes | memoryview

_ARRAY: Final = 0x90  # of up to 15 items, in MessagePack
_BIN_16: Final = Struct(">BH")
_BIN_32: Final = Struct(">BI")


def check_length(data: bytes, what: str) -> None:
    """Refuse a message beyond the limit; also before it is sent.

    Raises:
        MalformedMessageError: it is too long.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise MalformedMessageError(
            f"{what} of {len(data)} bytes; the limit is {MAX_MESSAGE_BYTES}"
        )


def unpack(data: bytes, what: str) -> Any:
    """MessagePack data as plain objects, within the limits."""
    check_length(data, what)
    size = len(data)
    try:
        hook = None if size <= SMALL_MESSAGE else _counter(data, what)
        return msgpack.unpackb(
            data, raw=False, strict_map_key=True, max_ext_len=0, object_hook=hook, list_hook=hook
        )
    except (ValueError, msgpack.UnpackException) as error:
        raise MalformedMessageError(
            f"{what} is not valid MessagePack: {str(error) or type(error).__name__}"
        ) from error


def _counter(data: bytes, what: str) -> Callable[[Any], Any]:
    """Bound the memory that a large message can ask for; returns what is to see each container.

    Five bytes can announce a million items, and room would be made for them, so go through the
    message once without building anything. Then a byte can still ask for a container: count them
    while they are made.
    """
    walk = msgpack.Unpacker(max_buffer_size=len(data))
    walk.feed(data)
    walk.skip()
    left = MAX_CONTAINERS

    def count(value: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise MalformedMessageError(f"{what} holds more than {MAX_CONTAINERS} containers")
        return value

    return count


def pack(value: Any) -> bytes:
    """Plain objects as MessagePack data."""
    return msgpack.packb(value, use_bin_type=True)  # type: ignore[no-any-return]


def packed_with_block(
    before: tuple[Any, ...], parts: Sequence[Part], after: tuple[Any, ...] = ()
) -> bytes:
    """An array of values with one byte string among them, which is made of ``parts``.

    The same bytes as those of `pack`, which would copy a large byte string several times.
    """
    size = sum(map(len, parts))
    if size <= SMALL_MESSAGE:
        return pack((*before, b"".join(parts), *after))
    head = bytes((_ARRAY | (len(before) + 1 + len(after)),)) + pack(before)[1:]
    long = _BIN_32.pack(0xC6, size) if size >= 2**16 else _BIN_16.pack(0xC5, size)
    return b"".join((head, long, *parts, pack(after)[1:]))


def float_buffer(array: FloatArray) -> Part:
    """The bytes of an array, without a copy where it is large."""
    array = np.ascontiguousarray(array, LITTLE_ENDIAN)
    if array.nbytes <= SMALL_MESSAGE:
        return array.tobytes()
    return array.reshape(-1).view(np.uint8).data
