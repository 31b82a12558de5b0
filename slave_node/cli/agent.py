"""Command ``agent``."""

from __future__ import annotations

import logging
import socket
import threading
from contextlib import ExitStack
from pathlib import Path
from secrets import token_hex
from typing import Annotated

import typer

from protocol.bus.bus import DEFAULT_ENDPOINT
from protocol.bus.endpoints import Mode
from protocol.errors import ConfigurationError, DoublestepError
from protocol.host.logs import LogFormat, configure_logs
from protocol.host.scratch import ScratchDirectory
from protocol.wire.keys import AgentKey, check_name
from slave_node.cli.options import BusMode, BusModeOption, Insecure, LogStyle, Tls, shown_places
from slave_node.cli.shutdown import end_on_signals

log = logging.getLogger("slave_node")

_MB = 10**6


def agent(  # noqa: PLR0917  options of the command line
    models: Annotated[
        Path, typer.Option(metavar="DIR", help="Models that masters may start, without subfolders.")
    ],
    name: Annotated[
        str, typer.Option(help="Name on the bus, as `host` in system files [default: the host's].")
    ] = "",
    label: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Property of this host; may be repeated."),
    ] = None,
    licence: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=COUNT", help="Number of slaves that may hold a licence; may be repeated."
        ),
    ] = None,
    allow_upload: Annotated[
        bool, typer.Option("--allow-upload", help="Load FMUs that masters send.")
    ] = False,
    upload_limit: Annotated[
        int, typer.Option(metavar="MB", min=1, help="Largest FMU that masters may send.")
    ] = 500,
    cache: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Directory for FMUs that were sent [default: in the user's cache]."
        ),
    ] = None,
    cache_limit: Annotated[
        int, typer.Option(metavar="MB", min=1, help="Largest size of all sent FMUs together.")
    ] = 5000,
    allow_python: Annotated[
        bool, typer.Option("--allow-python", help="Start Python models that masters name.")
    ] = False,
    logs: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Directory that keeps output of slaves [default: none is kept]."
        ),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(help=f"Master or router to connect to [default: {DEFAULT_ENDPOINT}]."),
    ] = None,
    listen: Annotated[
        list[str] | None, typer.Option(help="Address on which masters reach agent and slaves.")
    ] = None,
    insecure: Insecure = False,
    tls: Tls = None,
    mode: BusModeOption = BusMode.PEER,
    log_format: LogStyle = LogFormat.TEXT,
) -> None:
    """Start slaves on this host when masters ask for them, until SIGTERM or Ctrl-C."""
    from protocol.bus.opening import open_bus
    from protocol.wire.agents import AGENT_MESSAGE_BYTES
    from protocol.wire.packing import MAX_MESSAGE_BYTES
    from slave_node.agent.agent import Agent, Offer, Surroundings
    from slave_node.agent.model_store import ModelStore
    from slave_node.agent.options import (
        default_cache,
        parse_labels,
        parse_licences,
        places_of,
    )
    from slave_node.agent.upload_cache import UploadCache

    key = AgentKey(check_name(name or socket.gethostname(), "agent name"), token_hex(4))
    configure_logs(log_format, f"%(asctime)s agent {key.name}: %(message)s")
    if logs is not None:
        _make_directory(logs)
    places = places_of(connect or (), listen or (), Mode(mode), insecure=insecure, tls=tls)
    offer = Offer(
        labels=parse_labels(label or ()),
        licences=parse_licences(licence or ()),
        store=ModelStore(models, python=allow_python),
        cache=UploadCache(cache or default_cache(key.name), upload_limit * _MB, cache_limit * _MB)
        if allow_upload
        else None,
        python=allow_python,
    )
    ending = threading.Event()

    def end(reason: str) -> None:
        log.info("ending: %s", reason)
        ending.set()

    end_on_signals(end)
    with ExitStack() as stack:
        scratch = stack.enter_context(ScratchDirectory())
        try:
            is_passing_on = bool(places.own.listen)  # what masters and slaves say to each other
            largest = MAX_MESSAGE_BYTES if is_passing_on else AGENT_MESSAGE_BYTES
            bus = open_bus(places.own, stop=ending, largest=largest)
            stack.callback(bus.close)
            log.info("on the bus %s", shown_places(places.own))
            surroundings = Surroundings(places.of_slaves, scratch, logs)
            Agent(bus, key, offer, surroundings).serve(ending)
        except DoublestepError:
            if not ending.is_set():  # else it is what the ending did to what was under way
                raise
    log.info("ended")


def _make_directory(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be made: {error}") from error
