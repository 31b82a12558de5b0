"""The ``slave-node`` command."""

from __future__ import annotations

import typer

from protocol.host.command_errors import told_errors
from protocol.host.standard_error import forgive_standard_error
from slave_node.cli.agent import agent
from slave_node.cli.bus import check, router
from slave_node.cli.certificates import certificates
from slave_node.cli.models import inspect, validate
from slave_node.cli.serve import serve

app = typer.Typer(
    help="Serve an FMU or a Python model as a co-simulation slave.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
for command in (serve, router, check, agent, certificates, inspect, validate):
    app.command()(command)


def main() -> None:
    """Entry point: errors become one line and an exit code."""
    forgive_standard_error()
    told_errors("slave-node", app)
