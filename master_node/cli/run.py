"""Commands ``run`` and ``resume``."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from master_node.cli.interruption import end_with_parent
from master_node.cli.options import (
    METHOD,
    MODELS,
    OBSERVATION,
    RESULTS,
    SLAVES,
    TEXT_FORMAT,
    TIME,
    InProcess,
    Insecure,
    LogStyle,
    MetricsHost,
    MetricsPort,
    NoExamine,
    NoLaunch,
    PackageBus,
    Parameter,
    ResultDirectory,
    RunConnect,
    RunListen,
    RunMode,
    State,
    SystemFile,
    Timeout,
    Tls,
    refuse_beside_in_process,
)
from protocol.bus.endpoints import LOOPBACK
from protocol.errors import InterruptedRunError, ResultsError
from protocol.host.interruption import Interruption, interruptible
from protocol.host.logs import LogFormat, configure_logs
from protocol.host.standard_output import output_of_others
from protocol.host.terminal import say
from protocol.host.toml_text import assigned_values

if TYPE_CHECKING:  # each command imports what it needs
    from master_node.observing.observers import Observer
    from master_node.results import Result

log = logging.getLogger("master_node")


def run(  # noqa: PLR0917  options of the command line
    system_file: SystemFile,
    output: Annotated[
        Path, typer.Option(help="Directory for the results.", rich_help_panel=RESULTS)
    ] = Path("results"),
    preset: Annotated[
        str | None,
        typer.Option(
            help="paper: the method as Schierz, Arnold and Clauß have it.", rich_help_panel=METHOD
        ),
    ] = None,
    order: Annotated[
        str | None,
        typer.Option(
            help="Degree k of the input polynomials, 0 to 3, or auto.", rich_help_panel=METHOD
        ),
    ] = None,
    derivative_points: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=2,
            help="Points at which input polynomials meet derivatives.",
            rich_help_panel=METHOD,
        ),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(help="rich, mod, or none for a fixed step.", rich_help_panel=METHOD),
    ] = None,
    relative_tolerance: Annotated[
        float | None, typer.Option(help="RTOL of all outputs.", rich_help_panel=METHOD)
    ] = None,
    absolute_tolerance: Annotated[
        float | None, typer.Option(help="ATOL of all outputs.", rich_help_panel=METHOD)
    ] = None,
    start_time: Annotated[
        float | None, typer.Option(help="First time of the run [s].", rich_help_panel=TIME)
    ] = None,
    stop_time: Annotated[
        float | None, typer.Option(help="Last time of the run [s].", rich_help_panel=TIME)
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(help="Controller of the step size: pi or elementary.", rich_help_panel=METHOD),
    ] = None,
    sequence: Annotated[
        str | None,
        typer.Option(
            help="jacobi: all slaves at once; gauss-seidel: one by one.", rich_help_panel=METHOD
        ),
    ] = None,
    coupling: Annotated[
        str | None,
        typer.Option(
            help="explicit; implicit: iterate each double step; auto: where it is stiff.",
            rich_help_panel=METHOD,
        ),
    ] = None,
    output_interval: Annotated[
        float | None,
        typer.Option(help="Write results at multiples of this [s].", rich_help_panel=RESULTS),
    ] = None,
    output_variables: Annotated[
        list[str] | None,
        typer.Option(
            help="Pattern for slave.variable; !PATTERN leaves out; may be repeated.",
            rich_help_panel=RESULTS,
        ),
    ] = None,
    output_locals: Annotated[
        list[str] | None,
        typer.Option(
            help="Pattern for variables that are no outputs; may be repeated.",
            rich_help_panel=RESULTS,
        ),
    ] = None,
    output_every: Annotated[
        int | None,
        typer.Option(
            help="Keep each N-th result point, the first and the last.", rich_help_panel=RESULTS
        ),
    ] = None,
    output_format: Annotated[
        list[str] | None,
        typer.Option(help="csv, arrow, parquet or mat; may be repeated.", rich_help_panel=RESULTS),
    ] = None,
    step_size: Annotated[
        float | None,
        typer.Option(
            help="Initial communication step size, or the fixed one [s].", rich_help_panel=TIME
        ),
    ] = None,
    case: Annotated[
        Path | None,
        typer.Option(help="Parameters of a run of a study, its case.toml.", rich_help_panel=MODELS),
    ] = None,
    parameter: Parameter = None,
    state: State = None,
    in_process: InProcess = False,
    no_launch: NoLaunch = False,
    connect: RunConnect = None,
    listen: RunListen = None,
    insecure: Insecure = False,
    tls: Tls = None,
    mode: RunMode = None,
    package_bus: PackageBus = False,
    timeout: Timeout = None,
    pin: Annotated[
        bool,
        typer.Option(
            "--pin", help="Keep each launched slave on one processor.", rich_help_panel=SLAVES
        ),
    ] = False,
    no_examine: NoExamine = False,
    fmi_logging: Annotated[
        bool,
        typer.Option(
            "--fmi-logging",
            help="Let all FMUs log all their categories.",
            rich_help_panel=OBSERVATION,
        ),
    ] = False,
    trace: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Trace of all requests, for Perfetto.", rich_help_panel=OBSERVATION
        ),
    ] = None,
    metrics_port: MetricsPort = None,
    metrics_host: MetricsHost = LOOPBACK,
    log_format: LogStyle = LogFormat.TEXT,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="No progress, no summary.", rich_help_panel=OBSERVATION)
    ] = False,
    no_plot: Annotated[
        bool, typer.Option("--no-plot", help="Draw no results.png.", rich_help_panel=RESULTS)
    ] = False,
    stay_with_parent: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Run SYSTEM and write results, by default results.csv, steps, summary and a picture."""
    configure_logs(log_format, TEXT_FORMAT)
    with interruptible() as interruption, ExitStack() as stack:
        if stay_with_parent:
            end_with_parent()
        if in_process:
            refuse_beside_in_process(
                {
                    "--no-launch": no_launch,
                    "--connect": connect,
                    "--listen": listen,
                    "--insecure": insecure,
                    "--tls": tls,
                    "--mode": mode,
                    "--timeout": timeout is not None,
                    "--pin": pin,
                }
            )
        from master_node.cli.upload_bar import UploadBar
        from master_node.observing.progress import ProgressBar
        from master_node.simulation import run as run_system
        from master_node.study.case import apply_case, read_case
        from master_node.system.files import open_system

        opened = stack.enter_context(open_system(system_file, package_bus=package_bus))
        system = (
            (opened if case is None else apply_case(opened, read_case(case)))
            .with_parameters(assigned_values("--parameter", parameter or ()))
            .with_simulation(
                preset=preset,
                order=_order(order),
                derivative_points=derivative_points,
                controller=controller,
                sequence=sequence,
                coupling=coupling,
                output_interval=output_interval,
                estimator=estimator,
                relative_tolerance=relative_tolerance,
                absolute_tolerance=absolute_tolerance,
                start_time=start_time,
                stop_time=stop_time,
                initial_step_size=step_size,
                examine=False if no_examine else None,
            )
            .with_slaves(state=state, fmi_logging=("*",) if fmi_logging else None)
            .with_bus(
                connect=tuple(connect or ()),
                listen=tuple(listen or ()),
                insecure=insecure,
                tls=None if tls is None else str(tls.absolute()),
                mode=mode,
                discovery_timeout=timeout,
                pin=pin,
            )
            .with_results(
                variables=tuple(output_variables or ()),
                locals=tuple(output_locals or ()),
                every=output_every,
                formats=tuple(output_format or ()),
            )
        )
        observers: list[Observer] = [ProgressBar(quiet=quiet or log_format is LogFormat.JSON)]
        if metrics_port is not None:
            observers.append(_served_metrics(stack, metrics_port, metrics_host))
        uploading = stack.enter_context(UploadBar(quiet=quiet))
        draws = not (no_plot or stay_with_parent)
        with _drawn_when_interrupted(output, interruption, observers, draws=draws):
            run_system(
                system,
                output,
                in_process=in_process,
                launch=not no_launch,
                observers=observers,
                uploading=uploading,
                trace=trace,
            )
        _show(output, quiet=quiet, no_plot=no_plot)


class _Beginning:
    """An observer that knows if a run has begun, so that results are its own."""

    def __init__(self) -> None:
        self.is_over = False

    def started(self, _: object) -> None:
        """It has."""
        self.is_over = True

    def attempted(self, _: object) -> None:
        """Nothing."""

    def ended(self, _: object) -> None:
        """Nothing."""


@contextmanager
def _drawn_when_interrupted(
    directory: Path, interruption: Interruption, observers: list[Observer], *, draws: bool
) -> Iterator[None]:
    """Draw the results of a run that Ctrl-C breaks off; another Ctrl-C leaves the picture out."""
    beginning = _Beginning()
    observers.append(beginning)
    try:
        with output_of_others():
            yield
    except InterruptedRunError:
        if draws and beginning.is_over and interruption.is_ctrl_c:
            try:
                from master_node.results import Result

                _draw(Result.load(directory), directory)
            except ResultsError as error:
                log.warning("%s", error)
        raise


def _show(directory: Path, *, quiet: bool, no_plot: bool) -> None:
    """Picture and summary of a run that has ended."""
    from master_node.observing.progress import summary_table
    from master_node.results import Result
    from protocol.host.tables import show

    result = Result.load(directory)
    if not no_plot:
        try:
            _draw(result, directory)
        except KeyboardInterrupt:
            raise InterruptedRunError(
                "interrupted while the picture was drawn; the results are complete",
                remedy=f"`master-node plot {directory}` draws it",
            ) from None
    if not quiet:
        show(summary_table(result.summary))
        say(f"results in {directory}")


def _draw(result: Result, directory: Path) -> None:
    from master_node.results import PLOT_FILE
    from master_node.results.plots import plot_result

    plot_result(result, directory / PLOT_FILE, show=False, variables=None, is_named=False)


def resume(
    directory: ResultDirectory,
    trust: Annotated[
        bool, typer.Option("--trust", help="Run what a checkpoint names that is not your own.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no summary.")] = False,
    no_plot: Annotated[bool, typer.Option("--no-plot", help="Draw no results.png.")] = False,
) -> None:
    """Go on with the run in DIRECTORY that was interrupted or killed, with the settings it had.

    It runs the models and functions that the checkpoint in DIRECTORY names.
    """
    with interruptible() as interruption:
        from master_node.observing.progress import ProgressBar
        from master_node.simulation import resume as resume_run

        observers: list[Observer] = [ProgressBar(quiet=quiet)]
        with _drawn_when_interrupted(directory, interruption, observers, draws=not no_plot):
            resume_run(directory, observers=observers, trust=trust)
        _show(directory, quiet=quiet, no_plot=no_plot)


def _served_metrics(stack: ExitStack, port: int, host: str) -> Observer:
    """An observer whose numbers are served while ``stack`` lasts."""
    from master_node.observing.metrics import RunMetrics
    from protocol.host.metrics import metrics_served

    metrics = RunMetrics()
    log.info("metrics at %s", stack.enter_context(metrics_served(port, host, metrics.read)))
    return metrics


def _order(text: str | None) -> int | str | None:
    """A number where it is one; whether it may be is for the system to say."""
    return int(text) if text is not None and text.isdecimal() else text
