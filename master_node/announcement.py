"""What a master says of its run on the bus."""

from __future__ import annotations

import os
import socket
import time

from master_node.configuration import System
from protocol.administration import MasterStatus
from protocol.bus import Bus
from protocol.codec import encode_map
from protocol.keys import MasterKey
from protocol.text_limits import cut


def announce_run(bus: Bus, run: str, system: System) -> None:
    """Put up the token of this run, and answer who asks what it is."""
    key = MasterKey(run)
    since = time.time()

    def status(_: bytes) -> bytes:
        now = MasterStatus(
            run,
            socket.gethostname(),
            os.getpid(),
            cut(system.source),
            cut(", ".join(system.slaves)),
            since,
            time.time(),
        )
        return encode_map(now.to_message())

    bus.serve(key.status, status)
    bus.announce(key.alive)
