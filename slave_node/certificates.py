"""Certificates for a small laboratory: one authority, and one certificate for each host and role.

The authority's key stays where it was made. A host gets its own directory, which holds what
``--tls`` needs (`protocol.bus.credentials.Credentials`).
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from secrets import token_hex
from typing import Self

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from protocol.bus.credentials import AUTHORITY, Role
from protocol.errors import ConfigurationError
from protocol.wire.keys import check_name

_AUTHORITY_KEY = "ca-key.pem"
_AUTHORITY_DAYS = 3650
_CLOCKS_DIFFER = timedelta(days=1)
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True, slots=True)
class Host:
    """A host that gets certificates.

    Attributes:
        name: of its directory.
        addresses: names and IP addresses under which others call it.
    """

    name: str
    addresses: tuple[str, ...]

    @classmethod
    def parse(cls, text: str) -> Self:
        """From ``NAME`` or ``NAME=ADDRESS,...``; the name is an address too.

        Raises:
            ConfigurationError: it has another form.
        """
        name, equals, rest = text.partition("=")
        addresses = tuple(address for address in rest.split(",") if equals)
        check_name(name, "host name")
        if not all(addresses):
            raise ConfigurationError(
                f"--host {text}: an address is empty", remedy="write NAME or NAME=ADDRESS,ADDRESS"
            )
        for address in (name, *addresses):
            _general_name(address)
        return cls(name, (name, *addresses))


def make_certificates(
    directory: Path, hosts: Iterable[Host], roles: Sequence[Role], days: int
) -> list[Path]:
    """Make an authority if there is none, and a certificate for each host and role.

    Args:
        directory: of the authority; ``directory/HOST`` is for that host.
        hosts: that get certificates.
        roles: that each of them may take.
        days: how long they are valid.

    Returns:
        The directories of the hosts.

    Raises:
        ConfigurationError: a file is there already, or cannot be read or written.
    """
    hosts = tuple(hosts)
    for host in hosts:
        for role in roles:
            for name in (f"{role}.pem", f"{role}-key.pem"):
                if (directory / host.name / name).exists():
                    raise ConfigurationError(
                        f"{directory / host.name / name} is there already",
                        remedy="remove it first if it is to be made anew",
                    )
    try:
        authority = _Authority.at(directory)
        for host in hosts:
            _make_host(authority, directory / host.name, host, roles, days)
    except OSError as error:
        raise ConfigurationError(f"{error.filename}: {error.strerror}") from error
    return [directory / host.name for host in hosts]


class _Authority:
    """Signs certificates."""

    def __init__(self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        self.certificate = certificate
        self._key = key

    @classmethod
    def at(cls, directory: Path) -> Self:
        """The one that is there, or a new one."""
        directory.mkdir(parents=True, exist_ok=True)
        certificate, key = directory / AUTHORITY, directory / _AUTHORITY_KEY
        if certificate.exists() or key.exists():
            return cls._load(certificate, key)
        made = cls._make()
        _write(key, _key_pem(made._key), secret=True)
        _write(certificate, made.pem)
        return made

    @classmethod
    def _load(cls, certificate: Path, key: Path) -> Self:
        try:
            loaded = serialization.load_pem_private_key(key.read_bytes(), None)
            authority = x509.load_pem_x509_certificate(certificate.read_bytes())
        except (ValueError, TypeError, UnsupportedAlgorithm) as error:
            raise ConfigurationError(f"{key.parent}: not an authority of ours: {error}") from error
        if (
            not isinstance(loaded, ec.EllipticCurvePrivateKey)
            or loaded.public_key() != authority.public_key()
        ):
            raise ConfigurationError(f"{key} is not the key of {certificate}")
        return cls(authority, loaded)

    @classmethod
    def _make(cls) -> Self:
        key = ec.generate_private_key(ec.SECP256R1())
        text = f"Doublestep authority {token_hex(4)}"  # two of one name confuse TLS
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])
        builder = _builder(name, name, key.public_key(), _AUTHORITY_DAYS)
        builder = builder.add_extension(
            x509.BasicConstraints(ca=True, path_length=0), critical=True
        )
        builder = builder.add_extension(_key_usage(signs_certificates=True), critical=True)
        builder = builder.add_extension(
            x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False
        )
        return cls(builder.sign(key, hashes.SHA256()), key)

    @property
    def pem(self) -> bytes:
        """The certificate of the authority."""
        return self.certificate.public_bytes(serialization.Encoding.PEM)

    def sign(self, role: Role, host: Host, key: ec.EllipticCurvePublicKey, days: int) -> bytes:
        """A certificate for one role of a host."""
        subject = x509.Name(
            [
                x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, host.name[:64]),
                x509.NameAttribute(NameOID.COMMON_NAME, role),
            ]
        )
        builder = _builder(self.certificate.subject, subject, key, days)
        addresses = dict.fromkeys((*host.addresses, *_LOOPBACK))
        usages = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        for extension, critical in (
            (x509.BasicConstraints(ca=False, path_length=None), True),
            (_key_usage(signs_certificates=False), True),
            (x509.ExtendedKeyUsage(usages), False),
            (x509.SubjectAlternativeName([_general_name(a) for a in addresses]), False),
            (x509.SubjectKeyIdentifier.from_public_key(key), False),
            (x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), False),
        ):
            builder = builder.add_extension(extension, critical=critical)
        certificate = builder.sign(self._key, hashes.SHA256())
        return certificate.public_bytes(serialization.Encoding.PEM)


def _make_host(
    authority: _Authority, directory: Path, host: Host, roles: Sequence[Role], days: int
) -> None:
    directory.mkdir(mode=0o700, exist_ok=True)
    copy = directory / AUTHORITY
    if not copy.exists():
        _write(copy, authority.pem)
    elif copy.read_bytes() != authority.pem:
        raise ConfigurationError(
            f"{copy} is of another authority", remedy="remove that directory and make it anew"
        )
    for role in roles:
        key = ec.generate_private_key(ec.SECP256R1())
        _write(directory / f"{role}-key.pem", _key_pem(key), secret=True)
        _write(directory / f"{role}.pem", authority.sign(role, host, key.public_key(), days))


def _builder(
    issuer: x509.Name, subject: x509.Name, key: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return x509.CertificateBuilder(
        issuer_name=issuer,
        subject_name=subject,
        public_key=key,
        serial_number=x509.random_serial_number(),
        not_valid_before=now - _CLOCKS_DIFFER,
        not_valid_after=now + timedelta(days=days),
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        pass
    try:
        return x509.DNSName(address)
    except ValueError as error:
        raise ConfigurationError(f"{address!r} is no name of a host: {error}") from error


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _write(path: Path, data: bytes, *, secret: bool = False) -> None:
    """A new file; never over an old one."""
    mode = 0o600 if secret else 0o644
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
