"""Command ``check``: a system before its first step."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from master_node.cli.options import (
    InProcess,
    Insecure,
    NoExamine,
    NoLaunch,
    PackageBus,
    Parameter,
    RunConnect,
    RunListen,
    RunMode,
    State,
    SystemFile,
    Timeout,
    Tls,
    refuse_beside_in_process,
)
from protocol.host.interruption import interruptible
from protocol.host.standard_output import output_of_others
from protocol.host.terminal import say, say_json
from protocol.host.toml_text import assigned_values


def check(  # noqa: PLR0917  options of the command line
    system_file: SystemFile,
    graph: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the topology, too: .mmd (Mermaid), .dot or .svg (Graphviz)."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
    parameter: Parameter = None,
    stop_time: Annotated[float | None, typer.Option(help="Last time of the run [s].")] = None,
    state: State = None,
    no_examine: NoExamine = False,
    in_process: InProcess = False,
    no_launch: NoLaunch = False,
    connect: RunConnect = None,
    listen: RunListen = None,
    insecure: Insecure = False,
    tls: Tls = None,
    mode: RunMode = None,
    package_bus: PackageBus = False,
    timeout: Timeout = None,
) -> None:
    """Start and initialize the slaves of SYSTEM, take no step, and say what a run will meet.

    Exit code 0 if a run could begin; else that of the error that it would end with.
    """
    with interruptible():
        if in_process:
            refuse_beside_in_process(
                {
                    "--no-launch": no_launch,
                    "--connect": connect,
                    "--listen": listen,
                    "--insecure": insecure,
                    "--tls": tls,
                    "--mode": mode,
                    "--timeout": timeout is not None,
                }
            )
        from master_node.checking.checking import check_system
        from master_node.checking.graph import check_graph_path, write_graph
        from master_node.checking.tables import report_tables
        from master_node.cli.upload_bar import UploadBar
        from master_node.system.files import open_system
        from protocol.host.tables import show

        if graph is not None:
            check_graph_path(graph)
        with open_system(system_file, package_bus=package_bus) as opened:
            system = (
                opened.with_parameters(assigned_values("--parameter", parameter or ()))
                .with_simulation(stop_time=stop_time, examine=False if no_examine else None)
                .with_slaves(state=state)
                .with_bus(
                    connect=tuple(connect or ()),
                    listen=tuple(listen or ()),
                    insecure=insecure,
                    tls=None if tls is None else str(tls.absolute()),
                    mode=mode,
                    discovery_timeout=timeout,
                )
            )
            with UploadBar(quiet=as_json) as uploading, output_of_others():
                report = check_system(
                    system, in_process=in_process, launch=not no_launch, uploading=uploading
                )
    if graph is not None:
        write_graph(report, graph)
    if as_json:
        say_json(report.as_plain_data())
        return
    show(*report_tables(report))
    if graph is not None:
        say(f"graph in {graph}")
