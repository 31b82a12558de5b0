"""Commands ``inspect`` and ``validate``: a model by itself, without a bus."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from protocol.host.interruption import interruptible
from protocol.host.standard_output import output_of_others
from protocol.host.terminal import say_json
from slave_node.cli.options import Model


def inspect(
    model: Model,
    as_json: Annotated[bool, typer.Option("--json", help="Print the description as JSON.")] = False,
) -> None:
    """Show MODEL's variables, units, capabilities, feed-through and how its state can be saved."""
    from slave_node.loading import describe_model
    from slave_node.validation.report import description_tables

    with interruptible(), output_of_others():
        description = describe_model(model, Path.cwd())
    if as_json:
        say_json(_plain(asdict(description)))
        return
    from protocol.host.tables import show

    show(*description_tables(description))


def validate(
    model: Model,
    step_size: Annotated[
        float | None,
        typer.Option(help="Size of the trial steps [s] [default: the model's, or 0.01]."),
    ] = None,
    timeout: Annotated[float, typer.Option(help="Bound on each trial [s].", min=0.1)] = 60.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Try what MODEL can do, and say what Doublestep does about the rest."""
    from slave_node.validation.trials import is_usable, unusable
    from slave_node.validation.trials import validate as trials

    findings = []
    if as_json:
        with interruptible(), output_of_others():
            findings = list(trials(model, Path.cwd(), step_size, timeout=timeout))
        say_json([asdict(finding) for finding in findings])
    else:
        from rich.console import Console

        from protocol.host.tables import show
        from slave_node.validation.report import report_table

        with interruptible(), Console(stderr=True).status("trying"), output_of_others():
            findings = list(trials(model, Path.cwd(), step_size, timeout=timeout))
        show(report_table(model, findings))
    if not is_usable(findings):
        raise unusable(model)


def _plain(value: Any) -> Any:
    """Value with texts for what JSON does not have: some numbers, and bytes."""
    match value:
        case dict():
            return {key: _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
        case float() if not math.isfinite(value):
            return str(value)
        case bytes():
            return value.hex()
    return value
