"""Why a connection does not come about: Zenoh tries again and says nothing, so look ourselves."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum

from protocol.bus.credentials import Credentials, reason
from protocol.bus.endpoints import host_and_port
from protocol.errors import ConfigurationError

_AT_ONCE = 32
_ALERT_TIME = 0.3  # a refusal of our certificate comes after the handshake
_HELLO_TIME = 0.5


class Reach(StrEnum):
    """Result of an attempt to connect."""

    REACHED = "reached"
    NOT_REACHED = "not reached"
    REFUSED = "refused"
    IS_TLS = "is TLS"


@dataclass(frozen=True, slots=True)
class Probe:
    """An attempt to connect.

    Attributes:
        endpoint: the address.
        reach: how far it got; ``refused``: the two sides do not trust each other; ``is TLS``: the
            other side wants certificates, and this one has none.
        cause: in words, empty when it was reached.
    """

    endpoint: str
    reach: Reach
    cause: str = ""

    def check(self) -> None:
        """Go on unless the two sides will never come together.

        Raises:
            ConfigurationError: they do not trust each other, or only one of them speaks TLS.
        """
        if self.reach is Reach.IS_TLS:
            raise ConfigurationError(
                f"{self.endpoint}: {self.cause}",
                phase="connect",
                remedy="name your certificates with --tls, or with tls in the [bus] table",
            )
        if self.reach is Reach.REFUSED:
            raise ConfigurationError(
                f"{self.endpoint}: {self.cause}",
                phase="connect",
                remedy="the certificates of both sides must come from one authority, be valid, and "
                "hold the name by which the host is called; see docs/security.md",
            )


def probe(endpoint: str, credentials: Credentials | None, timeout: float) -> Probe:
    """Connect to an endpoint, with TLS if there are credentials, and leave again.

    Args:
        endpoint: ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.
        credentials: ours; None: without TLS.
        timeout: bound on each of connecting and shaking hands [s].
    """
    host, port = host_and_port(endpoint)
    try:
        connection = socket.create_connection((host, port), timeout)
    except OSError as error:
        cause = f"no answer at that address: {error.strerror or error}"
        return Probe(endpoint, Reach.NOT_REACHED, cause)
    with connection:
        if credentials is None:
            return Probe(endpoint, Reach.REACHED)
        return _shake_hands(endpoint, host, connection, credentials)


def probe_all(
    endpoints: Sequence[str], credentials: Credentials | None, timeout: float
) -> list[Probe]:
    """Results for several endpoints at once, in their order."""
    if not endpoints:
        return []
    with ThreadPoolExecutor(min(len(endpoints), _AT_ONCE)) as pool:
        return list(pool.map(lambda endpoint: probe(endpoint, credentials, timeout), endpoints))


def probe_without_tls(endpoint: str, timeout: float) -> Probe:
    """Find out whether who is at an endpoint wants TLS: only then a hello in TLS is answered.

    Nothing is trusted, and nothing is said beyond the hello. Takes half a second where somebody is
    there who does not speak TLS.

    Args:
        endpoint: as for `probe`.
        timeout: bound on connecting [s].
    """
    try:
        connection = socket.create_connection(host_and_port(endpoint), timeout)
    except OSError as error:
        return Probe(endpoint, Reach.NOT_REACHED, str(error.strerror or error))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    with connection:
        connection.settimeout(_HELLO_TIME)
        try:
            context.wrap_socket(connection).close()
        except ssl.SSLError as error:
            if "ALERT" not in str(error.reason):  # an alert is an answer in TLS
                return Probe(endpoint, Reach.REACHED)
        except OSError:  # it waits for more, or has left
            return Probe(endpoint, Reach.REACHED)
    return Probe(endpoint, Reach.IS_TLS, "it speaks TLS, and this side does not")


def _shake_hands(
    endpoint: str, host: str, connection: socket.socket, credentials: Credentials
) -> Probe:
    context = credentials.context(server=False)
    try:
        with context.wrap_socket(connection, server_hostname=host) as secure:
            secure.settimeout(_ALERT_TIME)
            with suppress(TimeoutError):  # it waits for us to speak: we were accepted
                secure.recv(1)
    except ssl.SSLCertVerificationError as error:
        return Probe(endpoint, Reach.REFUSED, f"its certificate is not trusted: {reason(error)}")
    except ssl.SSLError as error:
        return Probe(
            endpoint, Reach.REFUSED, f"it does not accept our certificate: {reason(error)}"
        )
    except TimeoutError:
        return Probe(endpoint, Reach.REFUSED, "it does not speak TLS")
    except OSError as error:
        return Probe(endpoint, Reach.NOT_REACHED, f"the connection broke: {error}")
    return Probe(endpoint, Reach.REACHED)
