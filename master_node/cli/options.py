"""Options that several commands of ``master-node`` have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
LogStyle = Annotated[LogFormat, typer.Option(help="Format of messages on standard error.")]
ResultDirectory = Annotated[Path, typer.Argument(help="A result directory.")]
Results = Annotated[
    Path,
    typer.Argument(help="A result directory, or a single file .csv, .arrow, .parquet or .mat."),
]
