"""Options that several commands of ``slave-node`` have."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from protocol.bus.endpoints import Endpoints, Mode
from protocol.host.logs import LogFormat

Model = Annotated[
    str,
    typer.Argument(
        help="An .fmu file, the folder of an FMU, package.module:Class or path/to/file.py:Class."
    ),
]

Insecure = Annotated[bool, typer.Option("--insecure", help="Allow addresses other than loopback.")]

Tls = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Certificates: encrypt, and accept only peers that have one."),
]

LogStyle = Annotated[LogFormat, typer.Option(help="Format of messages.")]


class BusMode(StrEnum):
    """Mode of a slave or an agent on the bus; a router is a command of its own."""

    PEER = Mode.PEER
    CLIENT = Mode.CLIENT


BusModeOption = Annotated[
    BusMode, typer.Option("--mode", help="peer: reach masters directly; client: through a router.")
]


def shown_places(endpoints: Endpoints) -> str:
    """Addresses at which a process listens and to which it connects, as text."""
    places = [f"at {e}" for e in endpoints.listen] + [f"to {e}" for e in endpoints.connect]
    return ", ".join(places)
