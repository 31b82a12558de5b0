"""Commands ``plot`` and ``compare``: results of runs that have ended."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from master_node.cli.options import ResultDirectory, Results
from protocol.errors import ConfigurationError
from protocol.host.interruption import interruptible
from protocol.host.terminal import say


def plot(
    directory: ResultDirectory,
    variable: Annotated[
        list[str] | None, typer.Option(help="slave.variable to draw; may be repeated.")
    ] = None,
    show: Annotated[bool, typer.Option("--show", help="Open a window.")] = False,
    file: Annotated[
        Path | None, typer.Option(help="Picture to write [default: DIRECTORY/results.png].")
    ] = None,
) -> None:
    """Draw the results in DIRECTORY again."""
    from master_node.results import PLOT_FILE, Result
    from master_node.results.plots import plot_result

    path = file or directory / PLOT_FILE
    try:
        with interruptible():
            result, is_named = Result.load(directory), file is not None
            plot_result(result, path, show=show, variables=variable or None, is_named=is_named)
    except KeyError as error:
        raise ConfigurationError(f"{directory}: {error.args[0]}", phase="plot") from None
    say(path)


def compare(
    a: Results,
    b: Results,
    rtol: Annotated[float, typer.Option(help="Relative tolerance.")] = 1e-3,
    atol: Annotated[float, typer.Option(help="Absolute tolerance.")] = 1e-6,
) -> None:
    """Compare two results, |A - B| <= atol + rtol |B|; exit code 1 when they differ."""
    from master_node.results.compare import compare as compare_results
    from protocol.host.tables import show

    comparison = compare_results(a, b, rtol, atol)
    show(comparison.table())
    if not comparison.within_tolerance:
        raise typer.Exit(1)
