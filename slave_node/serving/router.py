"""A router: connects masters and slaves that cannot, or shall not, reach each other directly."""

from __future__ import annotations

import logging
import os
import socket
import threading
import time

from protocol.bus.bus import Bus
from protocol.wire.administration import RouterStatus
from protocol.wire.keys import RouterKey
from protocol.wire.records import encode_map
from slave_node.shutdown import wait_for_end

log = logging.getLogger("slave_node")


def serve_router(bus: Bus, key: RouterKey, endpoints: str, ending: threading.Event) -> None:
    """Say on the bus that this router is there, until ``ending`` is set.

    Args:
        bus: opened as a router; the caller closes it.
        key: address of this router.
        endpoints: where it listens and to what it connects, for people.
        ending: ends it.
    """
    since = time.time()

    def status(_: bytes) -> bytes:
        now = RouterStatus(
            key.instance, socket.gethostname(), os.getpid(), endpoints, since, time.time()
        )
        return encode_map(now.to_message())

    bus.serve(key.status, status)
    bus.announce(key.alive)
    log.info("ready: router, instance %s", key.instance)
    wait_for_end(ending)
