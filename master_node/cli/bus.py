"""Commands ``list`` and ``doctor``: a look at the bus."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from master_node.cli.options import Connect, Insecure, Listen, Tls
from protocol.bus.credentials import Credentials, Role
from protocol.host.interruption import interruptible
from protocol.host.terminal import say, say_json

if TYPE_CHECKING:  # each command imports what it needs
    from master_node.survey.windows import Window

log = logging.getLogger("master_node")


def list_(
    connect: Connect = None,
    listen: Listen = None,
    insecure: Insecure = False,
    tls: Tls = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show the slaves, agents, runs and routers on the bus."""
    from master_node.survey.listing import listing_data, listing_tables
    from master_node.survey.participants import survey
    from protocol.host.tables import show

    with _windows(connect, listen, insecure=insecure, tls=tls) as opened:
        for window in opened:
            if window.failure is not None:
                log.warning("%s", window.failure)
        participants = survey([window.bus for window in opened if window.bus is not None])
    if as_json:
        say_json(listing_data(participants))
        return
    show(*listing_tables(participants))
    if not participants:
        log.warning("the bus is empty; `master-node doctor` says what to look at")


def doctor(
    connect: Connect = None,
    listen: Listen = None,
    insecure: Insecure = False,
    tls: Tls = None,
) -> None:
    """Look for what would keep a run from working; exit code 1 when there is something."""
    from master_node.survey.doctor import diagnose
    from protocol.host.tables import show

    with _windows(connect, listen, insecure=insecure, tls=tls) as opened:
        diagnosis = diagnose(opened)
    show(*diagnosis.tables())
    for problem in diagnosis.problems:
        say(f"{problem.where}: {problem.cause}; {problem.remedy}")
    if diagnosis.problems:
        raise typer.Exit(1)
    say("no problem found")


@contextmanager
def _windows(
    connect: Sequence[str] | None, listen: Sequence[str] | None, *, insecure: bool, tls: Path | None
) -> Iterator[list[Window]]:
    """Views of the bus at these addresses, see `master_node.survey.windows.windows`."""
    from master_node.survey.windows import windows

    credentials = _credentials(tls)
    with (
        interruptible(),
        windows(connect or (), listen or (), insecure=insecure, credentials=credentials) as opened,
    ):
        yield opened


def _credentials(directory: Path | None) -> Credentials | None:
    return None if directory is None else Credentials(directory.absolute(), Role.MASTER)
