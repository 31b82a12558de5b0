"""Commands ``router`` and ``check``."""

from __future__ import annotations

import logging
import threading
from secrets import token_hex
from typing import Annotated

import typer

from protocol.bus.bus import DEFAULT_ENDPOINT
from protocol.bus.credentials import Credentials, Role
from protocol.bus.endpoints import Endpoints, Mode
from protocol.host.interruption import interruptible
from protocol.host.logs import LogFormat, configure_logs
from protocol.wire.administration import STATUS_BYTES
from protocol.wire.keys import RouterKey, check_name
from slave_node.cli.options import Insecure, LogStyle, Tls, shown_places
from slave_node.cli.shutdown import end_on_signals

log = logging.getLogger("slave_node")


def router(
    listen: Annotated[
        list[str] | None,
        typer.Option(help=f"Address for masters and slaves [default: {DEFAULT_ENDPOINT}]."),
    ] = None,
    connect: Annotated[list[str] | None, typer.Option(help="Another router.")] = None,
    insecure: Insecure = False,
    tls: Tls = None,
    log_format: LogStyle = LogFormat.TEXT,
) -> None:
    """Connect masters and slaves in mode client with each other, until SIGTERM or Ctrl-C."""
    from protocol.bus.opening import open_bus
    from slave_node.serving.router import serve_router

    configure_logs(log_format, "%(asctime)s router: %(message)s")
    endpoints = Endpoints(
        listen=tuple(listen or (DEFAULT_ENDPOINT,)),
        connect=tuple(connect or ()),
        insecure=insecure,
        mode=Mode.ROUTER,
        credentials=None if tls is None else Credentials(tls.absolute(), Role.ROUTER),
    )
    ending = threading.Event()

    def end(reason: str) -> None:
        log.info("ending: %s", reason)
        ending.set()

    end_on_signals(end)
    bus = open_bus(endpoints)
    try:
        log.info("on the bus %s", shown_places(endpoints))
        serve_router(bus, RouterKey(token_hex(4)), shown_places(endpoints), ending)
    finally:
        bus.close()
    log.info("ended")


def check(  # noqa: PLR0917  options of the command line
    name: Annotated[str, typer.Argument(help="Slave to look for [default: a router].")] = "",
    agent: Annotated[bool, typer.Option("--agent", help="NAME is an agent.")] = False,
    connect: Annotated[
        str, typer.Option(help="Router, or the slave or agent itself where it listens.")
    ] = DEFAULT_ENDPOINT,
    insecure: Insecure = False,
    tls: Tls = None,
    timeout: Annotated[
        float, typer.Option(min=0.1, help="Bound on the wait for the connection [s].")
    ] = 3.0,
) -> None:
    """Exit code 0 if NAME serves, 3 if not: for health checks of service managers."""
    from protocol.bus.opening import open_bus
    from slave_node.serving.health import check_alive

    role = Role.SLAVE if name else Role.ROUTER
    endpoints = Endpoints(
        connect=(connect,),
        insecure=insecure,
        mode=Mode.CLIENT,
        credentials=None if tls is None else Credentials(tls.absolute(), role),
    )
    if name:
        check_name(name)
    with interruptible():
        bus = open_bus(endpoints, timeout=timeout, largest=STATUS_BYTES)
        try:
            check_alive(bus, name, agent=agent)
        finally:
            bus.close()
