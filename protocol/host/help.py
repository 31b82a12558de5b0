"""Help of commands in sections, and their version: plain text that any terminal shows."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from protocol.host.terminal import say

_PACKAGE = "doublestep"


class SectionedCommand(TyperCommand):
    """Command whose options stand in the sections that their ``rich_help_panel`` names."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, then each section in the order of its first option."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                is_argument = parameter.param_type_name == "argument"
                usual = "Arguments" if is_argument else "Options"
                title = getattr(parameter, "rich_help_panel", None) or usual
                sections.setdefault(title, []).append(record)
        _write(formatter, sections)


class SectionedGroup(TyperGroup):
    """Group whose commands stand in the sections that their ``rich_help_panel`` names."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each section in the order of its first command."""
        names = self.list_commands(ctx)
        limit = formatter.width - 6 - max(map(len, names))
        sections: dict[str, list[tuple[str, str]]] = {}
        for name in names:
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                title = getattr(command, "rich_help_panel", None) or "Commands"
                row = (name, command.get_short_help_str(limit))
                sections.setdefault(title, []).append(row)
        _write(formatter, sections)


def _write(formatter: Any, sections: dict[str, list[tuple[str, str]]]) -> None:
    for title, rows in sections.items():
        with formatter.section(title):
            formatter.write_dl(rows)


def version_option(command: str) -> Any:
    """Option ``--version`` of a command."""

    def show(value: bool) -> None:
        if value:
            say(f"{command} of Doublestep {version(_PACKAGE)}")
            raise typer.Exit

    return typer.Option("--version", callback=show, is_eager=True, help="Show the version.")
