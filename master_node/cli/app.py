"""The ``master-node`` command."""

from __future__ import annotations

from typing import Annotated

import typer

from master_node.cli.bus import doctor, list_
from master_node.cli.check import check
from master_node.cli.options import TEXT_FORMAT
from master_node.cli.packages import export, import_
from master_node.cli.results import compare, plot
from master_node.cli.run import resume, run
from master_node.cli.sweep import sweep
from protocol.host.command_errors import told_errors
from protocol.host.help import SectionedCommand, SectionedGroup, version_option
from protocol.host.logs import LogFormat, configure_logs
from protocol.host.standard_error import forgive_standard_error

app = typer.Typer(
    cls=SectionedGroup,
    help="Run coupled models with error-controlled communication step sizes.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

_RUNS, _RESULTS, _PACKAGES, _BUS = "Runs", "Results", "SSP packages", "The bus"

for name, command, section, summary in (
    ("run", run, _RUNS, "Run a system, or one model, and write results."),
    ("check", check, _RUNS, "Start and initialize the slaves, take no step, and report."),
    ("resume", resume, _RUNS, "Go on with a run that was interrupted or killed."),
    ("sweep", sweep, _RUNS, "Run a system many times with different parameters."),
    ("plot", plot, _RESULTS, "Draw results again."),
    ("compare", compare, _RESULTS, "Compare two results within a tolerance."),
    ("import", import_, _PACKAGES, "Write a package as a system file."),
    ("export", export, _PACKAGES, "Write a system and its FMUs as a package."),
    ("list", list_, _BUS, "Show slaves, agents, runs and routers."),
    ("doctor", doctor, _BUS, "Look for what would keep a run from working."),
):
    app.command(name, cls=SectionedCommand, rich_help_panel=section, short_help=summary)(command)


@app.callback()
def options(
    version: Annotated[bool, version_option("master-node")] = False,
) -> None:
    """Options of the command itself."""


def main() -> None:
    """Entry point: errors become one line and an exit code."""
    forgive_standard_error()
    configure_logs(LogFormat.TEXT, TEXT_FORMAT)
    told_errors("master-node", app)
