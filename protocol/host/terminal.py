"""Output of the commands: with ``tables.py`` the only place that prints, all of it printable."""

from __future__ import annotations

import json
from typing import Any

import typer

from protocol.errors import DoublestepError
from protocol.text.plain_text import printable


def say(text: object) -> None:
    """Print a text on one line."""
    typer.echo(printable(str(text)))


def say_json(data: Any) -> None:
    """Print data as JSON, whose texts are escaped."""
    typer.echo(json.dumps(data, indent=2))


def say_error(command: str, error: DoublestepError) -> None:
    """Print why a command ended, on standard error."""
    typer.echo(f"{command}: {error}", err=True)
