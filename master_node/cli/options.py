"""Options that several commands of ``master-node`` have."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from protocol.errors import ConfigurationError
from protocol.host.logs import LogFormat

METHOD, TIME, RESULTS = "Method", "Time and steps", "Results"
MODELS, SLAVES, BUS, OBSERVATION = "Parameters", "Slaves", "Bus", "Observation"
"""Sections of the help of commands that run systems."""

TEXT_FORMAT = "%(levelname)s: %(message)s"

Tls = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Certificates: encrypt, and accept only peers that have one.",
        rich_help_panel=BUS,
    ),
]
Connect = Annotated[
    list[str] | None,
    typer.Option(help="Router, or slave or master that listens, tcp/HOST:PORT; may be repeated."),
]
Listen = Annotated[
    list[str] | None, typer.Option(help="Address to which slaves connect while no master runs.")
]
Insecure = Annotated[
    bool,
    typer.Option("--insecure", help="Allow addresses other than loopback.", rich_help_panel=BUS),
]
MetricsPort = Annotated[
    int | None,
    typer.Option(
        min=0, max=65535, help="Port of metrics for Prometheus.", rich_help_panel=OBSERVATION
    ),
]
MetricsHost = Annotated[
    str,
    typer.Option(help="Address for metrics, without authentication.", rich_help_panel=OBSERVATION),
]
PackageBus = Annotated[
    bool,
    typer.Option(
        "--package-bus", help="Take [bus] from a package, addresses included.", rich_help_panel=BUS
    ),
]
SystemFile = Annotated[
    Path,
    typer.Argument(
        metavar="SYSTEM",
        help="A .toml, .ssp or .ssd file, or PACKAGE.ssp#VARIANT.ssd; or one model: an .fmu file, "
        "package.module:Class or path/to/file.py:Class.",
    ),
]
Parameter = Annotated[
    list[str] | None,
    typer.Option(
        help="Start value, slave.variable=value; may be repeated.", rich_help_panel=MODELS
    ),
]
State = Annotated[
    str | None,
    typer.Option(
        help="How all slaves save their states: native, fork, replay or none.",
        rich_help_panel=SLAVES,
    ),
]
InProcess = Annotated[
    bool,
    typer.Option(
        "--in-process",
        help="Run the slaves in this process, without a bus.",
        rich_help_panel=SLAVES,
    ),
]
NoLaunch = Annotated[
    bool,
    typer.Option(
        "--no-launch", help="Start no slaves: find all of them on the bus.", rich_help_panel=SLAVES
    ),
]
NoExamine = Annotated[
    bool,
    typer.Option(
        "--no-examine", help="Let the slaves take no trial steps first.", rich_help_panel=SLAVES
    ),
]
RunConnect = Annotated[
    list[str] | None,
    typer.Option("--connect", help="Slave to connect to, tcp/HOST:PORT.", rich_help_panel=BUS),
]
RunListen = Annotated[
    list[str] | None,
    typer.Option(
        "--listen", help="Address to which slaves can connect, tcp/HOST:PORT.", rich_help_panel=BUS
    ),
]
RunMode = Annotated[
    str | None,
    typer.Option(
        "--mode", help="peer: reach slaves directly; client: through a router.", rich_help_panel=BUS
    ),
]
Timeout = Annotated[
    float | None,
    typer.Option(help="Bound on the wait for slaves to appear [s].", rich_help_panel=BUS),
]
LogStyle = Annotated[
    LogFormat,
    typer.Option(help="Format of messages on standard error.", rich_help_panel=OBSERVATION),
]
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
