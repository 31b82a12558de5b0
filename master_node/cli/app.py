"""The ``master-node`` command."""

from __future__ import annotations

import typer

from master_node.cli.bus import doctor, list_
from master_node.cli.check import check
from master_node.cli.options import TEXT_FORMAT
from master_node.cli.packages import export, import_
from master_node.cli.results import compare, plot
from master_node.cli.run import resume, run
from master_node.cli.sweep import sweep
from protocol.host.command_errors import told_errors
from protocol.host.logs import LogFormat, configure_logs
from protocol.host.standard_error import forgive_standard_error

app = typer.Typer(
    help="Co-simulation master with error-controlled communication step sizes.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

for command in (run, check, resume, sweep, plot, compare):
    app.command()(command)
app.command("import")(import_)
app.command()(export)
app.command("list")(list_)
app.command()(doctor)


def main() -> None:
    """Entry point: errors become one line and an exit code."""
    forgive_standard_error()
    configure_logs(LogFormat.TEXT, TEXT_FORMAT)
    told_errors("master-node", app)
