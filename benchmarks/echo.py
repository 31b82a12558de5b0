"""A process that answers every request on one key with nothing: the floor of a round trip."""

import signal
import sys

from protocol.bus.endpoints import Endpoints
from protocol.bus.zenoh import ZenohBus


def main(endpoint: str, key: str) -> None:
    """Serve ``key`` until SIGTERM."""
    bus = ZenohBus(Endpoints(connect=(endpoint,)))
    signal.signal(signal.SIGTERM, lambda *_: bus.close())
    bus.serve_here(key, lambda _: b"", lambda: bus.announce(f"{key}/alive"))


if __name__ == "__main__":
    main(*sys.argv[1:])
