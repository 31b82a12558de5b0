"""Opening of buses, the one place that chooses a transport."""

from __future__ import annotations

import threading

from protocol.bus.bus import Bus
from protocol.bus.endpoints import Endpoints
from protocol.wire.packing import MAX_MESSAGE_BYTES


def open_bus(
    endpoints: Endpoints,
    timeout: float | None = None,
    stop: threading.Event | None = None,
    largest: int = MAX_MESSAGE_BYTES,
) -> Bus:
    """Bus at these endpoints; ``tcp/`` and ``tls/`` are sessions of Zenoh, see `ZenohBus`.

    Args:
        endpoints: addresses to listen on and to connect to.
        timeout: bound on the wait of a client for its router [s]; None: none.
        stop: when it is set, a client waits no more.
        largest: length of the largest message that is received [bytes].

    Raises:
        ConfigurationError: an address cannot be listened on, or our certificate is not accepted.
        SlaveLostError: a client found no router in time.
    """
    from protocol.bus.zenoh import ZenohBus  # noqa: PLC0415  other transports need no Zenoh

    return ZenohBus(endpoints, timeout, stop, largest)
