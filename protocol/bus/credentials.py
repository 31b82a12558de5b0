"""Credentials of a participant: a certificate for its role, of the laboratory's own authority.

A directory holds ``ca.pem``, and ``ROLE.pem`` with ``ROLE-key.pem`` for each role that this host
may take. The common name of a certificate is its role: what the others allow depends on it
(``protocol/bus/access.py``). ``slave-node certificates`` makes such directories.
"""

from __future__ import annotations

import os
import ssl
import stat
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from protocol.errors import ConfigurationError

AUTHORITY = "ca.pem"


class Role(StrEnum):
    """Role of a participant on the bus, and the common name of its certificate."""

    MASTER = "master"
    SLAVE = "slave"
    ROUTER = "router"


@dataclass(frozen=True, slots=True)
class Credentials:
    """The files of one role in a directory.

    Raises:
        ConfigurationError: a file is missing or cannot be used, the key can be read by others, or
            the certificate is not valid now, of another authority or of another role.
    """

    directory: Path
    role: Role

    def __post_init__(self) -> None:
        for path in (self.authority, self.certificate, self.key):
            if not path.is_file():
                raise ConfigurationError(
                    f"{path} is not there",
                    remedy="make it with `slave-node certificates "
                    f"AUTHORITY --host NAME --role {self.role}`, and name the host's directory",
                )
        if os.name == "posix" and self.key.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise ConfigurationError(
                f"{self.key} can be read or written by others", remedy=f"chmod 600 {self.key}"
            )
        self._check_certificate()

    @property
    def authority(self) -> Path:
        """The certificate of the authority."""
        return self.directory / AUTHORITY

    @property
    def certificate(self) -> Path:
        """Path of the certificate of this role."""
        return self.directory / f"{self.role}.pem"

    @property
    def key(self) -> Path:
        """The private key of this role."""
        return self.directory / f"{self.role}-key.pem"

    def context(self, *, server: bool) -> ssl.SSLContext:
        """For one end of a connection on which both sides show their certificates."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
        context.verify_mode = ssl.CERT_REQUIRED
        try:
            context.load_verify_locations(self.authority)
            context.load_cert_chain(self.certificate, self.key)
        except (ssl.SSLError, OSError) as error:
            raise ConfigurationError(
                f"{self.directory}: the certificates of role {self.role} cannot be read: {error}"
            ) from error
        return context

    def _check_certificate(self) -> None:
        """Shake hands with ourselves, as the others will."""
        to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
        server = self.context(server=True).wrap_bio(to_server, to_client, server_side=True)
        context = self.context(server=False)
        context.check_hostname = False  # the name depends on who connects
        client = context.wrap_bio(to_client, to_server)
        try:
            for end in (client, server, client, server):
                try:
                    end.do_handshake()
                except ssl.SSLWantReadError:
                    continue
        except ssl.SSLError as error:
            raise ConfigurationError(
                f"{self.certificate} is not valid here: {reason(error)}",
                remedy=f"it must be signed by {self.authority}, and the clock must be right",
            ) from error
        name = _common_name(client)
        if name != self.role:
            raise ConfigurationError(
                f"{self.certificate} has the common name {name!r:.80}, not {str(self.role)!r}"
            )


def _common_name(connection: ssl.SSLObject) -> str:
    certificate = connection.getpeercert() or {}
    names = [
        str(pair[1])
        for part in certificate.get("subject", ())
        for pair in part
        if isinstance(pair, tuple) and pair[0] == "commonName"
    ]
    return names[0] if names else ""


def reason(error: ssl.SSLError) -> str:
    """The words of a TLS error without the places in its source."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return error.verify_message.rstrip(".")
    return str(error.reason or error).removeprefix("TLSV1_").removeprefix("TLSV13_").lower()
