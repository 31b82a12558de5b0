"""The ``master-node`` command."""

from __future__ import annotations

import logging
import sys

import typer

from master_node.cli.bus import doctor, list_
from master_node.cli.options import TEXT_FORMAT
from master_node.cli.packages import export, import_
from master_node.cli.results import compare, plot
from master_node.cli.run import resume, run
from master_node.cli.sweep import sweep
from protocol.errors import DoublestepError
from protocol.host.logs import LogFormat, about, configure_logs, logs_json
from protocol.host.standard_error import forgive_standard_error
from protocol.host.standard_output import guarded_standard_output
from protocol.host.terminal import say_error

app = typer.Typer(
    help="Co-simulation master with error-controlled communication step sizes.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

for command in (run, resume, sweep, plot, compare):
    app.command()(command)
app.command("import")(import_)
app.command()(export)
app.command("list")(list_)
app.command()(doctor)

log = logging.getLogger("master_node")


def main() -> None:
    """Entry point: errors become one line and an exit code."""
    forgive_standard_error()
    configure_logs(LogFormat.TEXT, TEXT_FORMAT)
    try:
        with guarded_standard_output():
            app()
    except DoublestepError as error:
        if logs_json():
            log.error("%s", error, extra=about(error))
        else:
            say_error("master-node", error)
        sys.exit(error.exit_code)
