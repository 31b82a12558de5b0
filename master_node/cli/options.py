"""Options that several commands of ``master-node`` have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from protocol.host.logs import LogFormat

TEXT_FORMAT = "%(levelname)s: %(message)s"

Tls = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Certificates: encrypt, and let in only who has one."),
]
Connect = Annotated[
    list[str] | None,
    typer.Option(help="Router, or slave or master that listens, tcp/HOST:PORT; may be repeated."),
]
Listen = Annotated[
    list[str] | None, typer.Option(help="Where slaves connect to while no master runs.")
]
Insecure = Annotated[bool, typer.Option("--insecure", help="Allow addresses other than loopback.")]
MetricsPort = Annotated[
    int | None, typer.Option(min=0, max=65535, help="Serve metrics for Prometheus there.")
]
MetricsHost = Annotated[str, typer.Option(help="Address for that; nobody is asked who he is.")]
PackageBus = Annotated[
    bool, typer.Option("--package-bus", help="Take [bus] from a package, addresses included.")
]
LogStyle = Annotated[LogFormat, typer.Option(help="Of messages on standard error.")]
ResultDirectory = Annotated[Path, typer.Argument(help="A result directory.")]
Results = Annotated[
    Path,
    typer.Argument(help="A result directory, or a single file .csv, .arrow, .parquet or .mat."),
]
