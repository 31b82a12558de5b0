"""The ``slave-node`` command."""

from __future__ import annotations

from typing import Annotated

import typer

from protocol.host.command_errors import told_errors
from protocol.host.help import SectionedCommand, SectionedGroup, version_option
from protocol.host.standard_error import forgive_standard_error
from slave_node.cli.agent import agent
from slave_node.cli.bus import check, router
from slave_node.cli.certificates import certificates
from slave_node.cli.models import inspect, validate
from slave_node.cli.serve import serve

app = typer.Typer(
    cls=SectionedGroup,
    help="Serve an FMU or a Python model as a co-simulation slave.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

_MODELS, _BUS = "Models", "The bus"

for name, command, section, summary in (
    ("inspect", inspect, _MODELS, "Show variables, units and capabilities of a model."),
    ("validate", validate, _MODELS, "Try what a model can do, and say what is done about it."),
    ("serve", serve, _BUS, "Serve a model to masters."),
    ("agent", agent, _BUS, "Start slaves on this host when masters ask for them."),
    ("router", router, _BUS, "Connect masters and slaves with each other."),
    ("check", check, _BUS, "Tell by the exit code if a slave serves."),
    ("certificates", certificates, _BUS, "Make certificates for encrypted connections."),
):
    app.command(name, cls=SectionedCommand, rich_help_panel=section, short_help=summary)(command)


@app.callback()
def options(
    version: Annotated[bool, version_option("slave-node")] = False,
) -> None:
    """Options of the command itself."""


def main() -> None:
    """Entry point: errors become one line and an exit code."""
    forgive_standard_error()
    told_errors("slave-node", app)
