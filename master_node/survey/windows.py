"""Looking at the bus from outside a run, through one session for each address.

A session in mode client sees what is behind a router, and also a slave or master that listens.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from protocol.bus.bus import DEFAULT_ENDPOINT, Bus
from protocol.bus.credentials import Credentials
from protocol.bus.endpoints import Endpoints, Mode
from protocol.bus.opening import open_bus
from protocol.bus.reachability import Reach, probe
from protocol.errors import DoublestepError
from protocol.wire.administration import STATUS_BYTES

_CONNECT_TIME = 0.5
_ARRIVAL_TIME = 0.6  # who waits for a master tries again every 0.2 s
_AT_ONCE = 32


@dataclass(frozen=True)
class Window:
    """A view of the bus.

    Attributes:
        endpoint: where it was looked.
        listens: others come to us there, instead of us to them.
        bus: opened; None: no participant was reached.
        failure: why not.
    """

    endpoint: str
    listens: bool
    bus: Bus | None
    failure: DoublestepError | None = None


@contextmanager
def windows(
    connect: Sequence[str],
    listen: Sequence[str],
    *,
    insecure: bool = False,
    credentials: Credentials | None = None,
) -> Iterator[list[Window]]:
    """Open a session to each address, and one at those to which slaves come.

    Args:
        connect: addresses of routers, and of masters and slaves that listen.
        listen: addresses to which slaves connect while no master runs. Without any address the
            default one is used, whichever way works.
        insecure: allow other addresses than loopback without TLS.
        credentials: for TLS.

    Raises:
        ConfigurationError: an address is not valid, or cannot be listened on.
    """
    if not connect and not listen:
        there = probe(DEFAULT_ENDPOINT, None, _CONNECT_TIME).reach is Reach.REACHED
        connect, listen = ((DEFAULT_ENDPOINT,), ()) if there else ((), (DEFAULT_ENDPOINT,))
    doors = [Endpoints((), (e,), insecure, Mode.CLIENT, credentials) for e in connect]
    with ExitStack() as stack:
        made = []
        if listen:
            endpoints = Endpoints(tuple(listen), (), insecure, Mode.PEER, credentials)
            bus = open_bus(endpoints, largest=STATUS_BYTES)
            stack.callback(bus.close)
            made.append(Window(", ".join(listen), True, bus))
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            opened = list(pool.map(_open, doors))
        for window in opened:
            if window.bus is not None:
                stack.callback(window.bus.close)
        if listen:
            time.sleep(_ARRIVAL_TIME)
        yield [*made, *opened]


def _open(endpoints: Endpoints) -> Window:
    (where,) = endpoints.connect
    try:
        bus = open_bus(endpoints, timeout=_CONNECT_TIME, largest=STATUS_BYTES)
    except DoublestepError as error:
        return Window(where, False, None, error)
    return Window(where, False, bus)
