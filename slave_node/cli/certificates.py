"""Command ``certificates``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protocol.bus.credentials import Role
from protocol.host.interruption import interruptible
from protocol.host.terminal import say


def certificates(
    directory: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Directory of the authority, made if it is not there."),
    ],
    host: Annotated[
        list[str],
        typer.Option(
            metavar="NAME[=ADDRESS,...]",
            help="Host by the name under which it is called, and further names or addresses.",
        ),
    ],
    role: Annotated[
        list[Role] | None, typer.Option(help="Role that the hosts may have [default: slave].")
    ] = None,
    days: Annotated[
        int, typer.Option(min=1, max=3650, help="Validity of host certificates.")
    ] = 825,
) -> None:
    """Make certificates for --tls: an authority in DIR, and what host NAME needs in DIR/NAME."""
    from slave_node.certificates import Host, make_certificates

    hosts = [Host.parse(text) for text in host]
    with interruptible():
        for path in make_certificates(directory, hosts, role or [Role.SLAVE], days):
            say(path)
