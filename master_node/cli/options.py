"""Options that several commands of ``master-node`` have."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from protocol.errors import ConfigurationError
from protocol.host.logs import LogFormat

TEXT_FORMAT = "%(levelname)s: %(message)s"

Tls = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Certificates: encrypt, and accept only peers that have one."),
]
Connect = Annotated[
    list[str] | None,
    typer.Option(help="Router, or slave or master that listens, tcp/HOST:PORT; may be repeated."),
]
Listen = Annotated[
    list[str] | None, typer.Option(help="Address to which slaves connect while no master runs.")
]
Insecure = Annotated[bool, typer.Option("--insecure", help="Allow addresses other than loopback.")]
MetricsPort = Annotated[
    int | None,
    typer.Option(min=0, max=65535, help="Port of metrics for Prometheus."),
]
MetricsHost = Annotated[str, typer.Option(help="Address for metrics, without authentication.")]
PackageBus = Annotated[
    bool, typer.Option("--package-bus", help="Take [bus] from a package, addresses included.")
]
SystemFile = Annotated[
    Path,
    typer.Argument(
        metavar="SYSTEM", help="A .toml, .ssp or .ssd file, or PACKAGE.ssp#VARIANT.ssd."
    ),
]
Parameter = Annotated[
    list[str] | None, typer.Option(help="Start value, slave.variable=value; may be repeated.")
]
State = Annotated[
    str | None,
    typer.Option(help="How all slaves save their states: native, fork, replay or none."),
]
InProcess = Annotated[
    bool, typer.Option("--in-process", help="Run the slaves in this process, without a bus.")
]
NoLaunch = Annotated[
    bool, typer.Option("--no-launch", help="Start no slaves: find all of them on the bus.")
]
NoExamine = Annotated[
    bool, typer.Option("--no-examine", help="Let the slaves take no trial steps first.")
]
RunConnect = Annotated[
    list[str] | None, typer.Option("--connect", help="Slave to connect to, tcp/HOST:PORT.")
]
RunListen = Annotated[
    list[str] | None,
    typer.Option("--listen", help="Address to which slaves can connect, tcp/HOST:PORT."),
]
RunMode = Annotated[
    str | None,
    typer.Option("--mode", help="peer: reach slaves directly; client: through a router."),
]
Timeout = Annotated[float | None, typer.Option(help="Bound on the wait for slaves to appear [s].")]
LogStyle = Annotated[LogFormat, typer.Option(help="Format of messages on standard error.")]
ResultDirectory = Annotated[Path, typer.Argument(help="A result directory.")]
Results = Annotated[
    Path,
    typer.Argument(help="A result directory, or a single file .csv, .arrow, .parquet or .mat."),
]


def refuse_beside_in_process(options: Mapping[str, object]) -> None:
    """Make sure that no option of the bus stands beside ``--in-process``.

    Raises:
        ConfigurationError: one does; names it.
    """
    given = [name for name, value in options.items() if value]
    if given:
        raise ConfigurationError(
            f"{given[0]} is for slaves on the bus, and with --in-process there is none",
            remedy=f"leave out {given[0]} or --in-process",
        )
