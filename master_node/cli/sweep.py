"""Command ``sweep``."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.errors import ConfigurationError
from protocol.host.interruption import interruptible
from protocol.host.standard_output import output_of_others
from protocol.host.terminal import say

if TYPE_CHECKING:  # each command imports what it needs
    from master_node.study.directory import StudyDirectory
    from master_node.study.runner import Runner


def sweep(  # noqa: PLR0917  as above
    study_file: Annotated[
        Path, typer.Argument(metavar="STUDY.toml", help="A study: parameters to vary, and how.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(help="Directory for runs and table [default: STUDY_results, here]."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Runs at a time [default: one for each processor].")
    ] = None,
    dask: Annotated[
        str | None, typer.Option(help="Scheduler of a Dask cluster to run on, tcp://HOST:PORT.")
    ] = None,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Run those again that have failed.")
    ] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Delete runs of another study in the directory.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Run a system once for each case of a study; go on where an earlier sweep ended."""
    with interruptible():
        from master_node.study.configuration import load_study
        from master_node.study.directory import TABLE_FILE
        from master_node.study.execution import run_study
        from master_node.study.progress import StudyProgress
        from master_node.study.runner import LocalRunner

        if dask is not None and workers is not None:
            raise ConfigurationError("--workers is for this host: with --dask the cluster has them")
        study = load_study(study_file)
        directory = output or Path(f"{study_file.stem}_results")

        def make_runner(held: StudyDirectory) -> Runner:
            needs, limit = study.run.needs, study.licence_limit
            if dask is None:
                return LocalRunner(workers or _processors(), limit)
            return _dask_runner(dask, held, needs, limit)

        with output_of_others():
            outcome = run_study(
                study,
                directory,
                make_runner,
                retry_failed=retry_failed,
                replace=replace,
                progress=StudyProgress(quiet=quiet),
            )
    say(directory / TABLE_FILE)
    if outcome.failed:
        raise typer.Exit(1)


def _dask_runner(
    address: str, directory: StudyDirectory, needs: tuple[str, ...], licence_limit: int | None
) -> Runner:
    if importlib.util.find_spec("distributed") is None:
        raise ConfigurationError(
            "--dask needs the package distributed", remedy="pip install 'doublestep[dask]'"
        )
    from master_node.study.dask_runner import DaskRunner

    return DaskRunner(address, directory, needs, licence_limit)


def _processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
