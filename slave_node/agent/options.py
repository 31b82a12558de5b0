"""Options of an agent, parsed."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from protocol.bus.bus import DEFAULT_ENDPOINT
from protocol.bus.credentials import Credentials, Role
from protocol.bus.endpoints import Endpoints, Mode, host_and_port
from protocol.errors import ConfigurationError
from protocol.slave_processes import connection_options
from protocol.wire.agents import LICENCE, check_label

_MAX_COUNT = 10_000
_COUNT = re.compile(r"[0-9]{1,5}")
_ANY = {"0.0.0.0": "127.0.0.1", "::": "::1"}


@dataclass(frozen=True)
class Places:
    """Where an agent and its slaves come to the bus.

    Attributes:
        own: of the agent.
        of_slaves: options of ``slave-node serve``.
    """

    own: Endpoints
    of_slaves: Sequence[str]


def places_of(
    connect: Sequence[str],
    listen: Sequence[str],
    mode: Mode,
    *,
    insecure: bool = False,
    tls: Path | None = None,
) -> Places:
    """The slaves connect as their agent does; or to it as its clients, if it listens.

    A peer that listens passes on what its clients and other peers say to each other, so that it
    needs the certificate of a router then.

    Raises:
        ConfigurationError: as `Endpoints` and `Credentials`.
    """
    role = Role.ROUTER if listen else Role.SLAVE
    own = Endpoints(
        listen=tuple(listen),
        connect=tuple(connect or (() if listen else (DEFAULT_ENDPOINT,))),
        insecure=insecure,
        mode=mode,
        credentials=None if tls is None else Credentials(tls.absolute(), role),
    )
    if own.listen:
        here = _here(own.listen[0])
        return Places(own, connection_options(Mode.CLIENT, [here], own))
    return Places(own, connection_options(mode, own.connect, own))


def _here(endpoint: str) -> str:
    """Address at which a process of this host reaches what listens there."""
    host, port = host_and_port(endpoint)
    host = _ANY.get(host, host)
    return f"{endpoint.partition('/')[0]}/{f'[{host}]' if ':' in host else host}:{port}"


def parse_labels(texts: Sequence[str]) -> dict[str, str]:
    """``NAME=VALUE`` each.

    Raises:
        ConfigurationError: another form, or a name twice.
    """
    labels: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigurationError(f"--label {text}: write NAME=VALUE")
        check_label(name, value)
        if name in labels:
            raise ConfigurationError(
                f"--label {text}: {name} is {labels[name]!r} already",
                remedy="count several licences with --licence NAME=COUNT"
                if name == LICENCE
                else "give each label one value",
            )
        labels[name] = value
    return labels


def parse_licences(texts: Sequence[str]) -> dict[str, int]:
    """``NAME=COUNT`` each.

    Raises:
        ConfigurationError: another form, or a name twice.
    """
    licences: dict[str, int] = {}
    for text in texts:
        name, _, count = text.partition("=")
        if not _COUNT.fullmatch(count) or not 0 < int(count) <= _MAX_COUNT:
            raise ConfigurationError(
                f"--licence {text}: write NAME=COUNT, with a COUNT from 1 to {_MAX_COUNT}"
            )
        check_label(LICENCE, name)
        if name in licences:
            raise ConfigurationError(f"--licence {text}: {name} is counted already")
        licences[name] = int(count)
    return licences


def default_cache(name: str) -> Path:
    """Where the agent called ``name`` keeps uploaded models of this user."""
    given = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME", "")
    base = Path(given) if given and Path(given).is_absolute() else Path.home() / ".cache"
    return base / "doublestep" / "agents" / name
