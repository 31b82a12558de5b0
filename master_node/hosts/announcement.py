"""Announcement of a run on the bus."""

from __future__ import annotations

import os
import socket
import time

from master_node.system.system import System
from protocol.bus.bus import Bus
from protocol.text.limits import cut
from protocol.wire.administration import MasterStatus
from protocol.wire.keys import MasterKey
from protocol.wire.records import encode_map


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
