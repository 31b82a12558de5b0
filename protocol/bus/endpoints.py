"""Where a participant listens and to what it connects, and what is refused by default."""

from __future__ import annotations

import ipaddress
import socket
from dataclasses import dataclass
from enum import StrEnum

from protocol.bus.credentials import Credentials
from protocol.errors import ConfigurationError

LOOPBACK = "127.0.0.1"
"""Reached from this host only."""


class Mode(StrEnum):
    """Mode of a participant on the bus.

    Peers need a connection to each other. Clients need one to a router, which connects them all.
    """

    PEER = "peer"
    CLIENT = "client"
    ROUTER = "router"


@dataclass(frozen=True, slots=True)
class Endpoints:
    """Addresses ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.

    Attributes:
        listen: addresses to listen on; a client has none.
        connect: addresses to connect to, tried again for ever in the background.
        insecure: allow addresses that are not loopback without TLS; the traffic is then neither
            encrypted nor authenticated.
        mode: peer, client or router.
        credentials: for TLS; all addresses are ``tls/`` ones then, however they were written.

    Raises:
        ConfigurationError: an address has another form or is not allowed, or the mode does not
            go with the addresses.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    insecure: bool = False
    mode: Mode = Mode.PEER
    credentials: Credentials | None = None

    def __post_init__(self) -> None:
        for endpoint in (*self.listen, *self.connect):
            self._check(endpoint)
        if self.mode is Mode.CLIENT and (self.listen or not self.connect):
            raise ConfigurationError(
                "a client connects to a router and does not listen",
                remedy="name the router with --connect, and leave out --listen",
            )
        if self.credentials is not None:
            for name in ("listen", "connect"):
                given = getattr(self, name)
                object.__setattr__(self, name, tuple(f"tls/{e.partition('/')[2]}" for e in given))

    def _check(self, endpoint: str) -> None:
        host, _ = host_and_port(endpoint)
        if self.credentials is not None:
            return
        if endpoint.startswith("tls/"):
            raise ConfigurationError(
                f"{endpoint} needs certificates", remedy="name their directory with --tls"
            )
        if not self.insecure and not _is_loopback(host):
            raise ConfigurationError(
                f"{endpoint} is not a loopback address, and the traffic would be neither "
                "encrypted nor authenticated",
                remedy="name certificates with --tls, or say --insecure if the network is trusted",
            )


def host_and_port(endpoint: str) -> tuple[str, int]:
    """The parts of ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.

    Raises:
        ConfigurationError: the endpoint has another form.
    """
    protocol, _, address = endpoint.partition("/")
    host, colon, port = address.rpartition(":")
    if (
        protocol not in ("tcp", "tls")
        or not colon
        or not host
        or not port.isdecimal()
        or int(port) > 65535
    ):
        raise ConfigurationError(
            f"{endpoint!r} is not an endpoint", remedy="write tcp/HOST:PORT, as tcp/127.0.0.1:7447"
        )
    return host.strip("[]"), int(port)


def free_endpoint() -> str:
    """A loopback endpoint with a port that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
