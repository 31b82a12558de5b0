"""The ``master-node`` command."""

from __future__ import annotations

import importlib.util
import logging
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.bus.credentials import Credentials, Role
from protocol.bus.endpoints import LOOPBACK
from protocol.errors import ConfigurationError, DoublestepError, InterruptedRunError
from protocol.host.interruption import interruptible
from protocol.host.logs import LogFormat, about, configure_logs, logs_json
from protocol.host.standard_error import forgive_standard_error
from protocol.host.standard_output import guarded_standard_output, output_of_others
from protocol.host.terminal import say, say_error, say_json
from protocol.host.threads import start_thread
from protocol.host.toml_text import assigned_values

if TYPE_CHECKING:  # each command imports what it needs
    from master_node.observing.observers import Observer
    from master_node.study.directory import StudyDirectory
    from master_node.study.runner import Runner
    from master_node.survey.windows import Window

app = typer.Typer(
    help="Co-simulation master with error-controlled communication step sizes.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

log = logging.getLogger("master_node")

_END_TIME = 5.0
_TEXT_FORMAT = "%(levelname)s: %(message)s"

Tls = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Certificates: encrypt, and let in only who has one."),
]
Connect = Annotated[
    list[str] | None,
    typer.Option(help="Router, or slave or master that listens, tcp/HOST:PORT; may be repeated."),
]
Listen = Annotated[
    list[str] | None, typer.Option(help="Where slaves connect to while no master runs.")
]
Insecure = Annotated[bool, typer.Option("--insecure", help="Allow addresses other than loopback.")]
MetricsPort = Annotated[
    int | None, typer.Option(min=0, max=65535, help="Serve metrics for Prometheus there.")
]
MetricsHost = Annotated[str, typer.Option(help="Address for that; nobody is asked who he is.")]
PackageBus = Annotated[
    bool, typer.Option("--package-bus", help="Take [bus] from a package, addresses included.")
]
LogStyle = Annotated[LogFormat, typer.Option(help="Of messages on standard error.")]
ResultDirectory = Annotated[Path, typer.Argument(help="A result directory.")]
Results = Annotated[
    Path,
    typer.Argument(help="A result directory, or a single file .csv, .arrow, .parquet or .mat."),
]


@app.command()
def run(  # noqa: PLR0917  options of the command line
    system_file: Annotated[
        Path,
        typer.Argument(
            metavar="SYSTEM", help="A .toml, .ssp or .ssd file, or PACKAGE.ssp#VARIANT.ssd."
        ),
    ],
    output: Annotated[Path, typer.Option(help="Directory for the results.")] = Path("results"),
    preset: Annotated[
        str | None, typer.Option(help="paper: the method as Schierz, Arnold and Clauß have it.")
    ] = None,
    order: Annotated[
        str | None, typer.Option(help="Degree k of the input polynomials, 0 to 3, or auto.")
    ] = None,
    derivative_points: Annotated[
        int | None,
        typer.Option(min=0, max=2, help="Points at which input polynomials meet derivatives."),
    ] = None,
    estimator: Annotated[
        str | None, typer.Option(help="rich, mod, or none for a fixed step.")
    ] = None,
    relative_tolerance: Annotated[float | None, typer.Option(help="RTOL of all outputs.")] = None,
    absolute_tolerance: Annotated[float | None, typer.Option(help="ATOL of all outputs.")] = None,
    start_time: Annotated[float | None, typer.Option(help="[s]")] = None,
    stop_time: Annotated[float | None, typer.Option(help="[s]")] = None,
    controller: Annotated[
        str | None, typer.Option(help="Of the step size: pi or elementary.")
    ] = None,
    sequence: Annotated[
        str | None, typer.Option(help="jacobi: all slaves at once; gauss-seidel: one by one.")
    ] = None,
    coupling: Annotated[
        str | None,
        typer.Option(help="explicit; implicit: iterate each double step; auto: where it is stiff."),
    ] = None,
    output_interval: Annotated[
        float | None, typer.Option(help="Write results at multiples of this [s].")
    ] = None,
    output_variables: Annotated[
        list[str] | None,
        typer.Option(help="Pattern for slave.variable; !PATTERN leaves out; may be repeated."),
    ] = None,
    output_locals: Annotated[
        list[str] | None,
        typer.Option(help="The same for variables that are no outputs; may be repeated."),
    ] = None,
    output_every: Annotated[
        int | None, typer.Option(help="Keep each N-th result point, the first and the last.")
    ] = None,
    output_format: Annotated[
        list[str] | None, typer.Option(help="csv, arrow, parquet or mat; may be repeated.")
    ] = None,
    step_size: Annotated[
        float | None, typer.Option(help="Initial communication step size, or the fixed one [s].")
    ] = None,
    case: Annotated[
        Path | None, typer.Option(help="Parameters of a run of a study, its case.toml.")
    ] = None,
    parameter: Annotated[
        list[str] | None, typer.Option(help="Start value, slave.variable=value; may be repeated.")
    ] = None,
    state: Annotated[
        str | None,
        typer.Option(help="How all slaves save their states: native, fork, replay or none."),
    ] = None,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Run the slaves in this process, without a bus.")
    ] = False,
    no_launch: Annotated[
        bool, typer.Option("--no-launch", help="Start no slaves: find all of them on the bus.")
    ] = False,
    connect: Annotated[
        list[str] | None, typer.Option(help="Slave to connect to, tcp/HOST:PORT.")
    ] = None,
    listen: Annotated[
        list[str] | None, typer.Option(help="Where slaves can connect, tcp/HOST:PORT.")
    ] = None,
    insecure: Insecure = False,
    tls: Tls = None,
    mode: Annotated[
        str | None, typer.Option(help="peer: reach slaves directly; client: through a router.")
    ] = None,
    package_bus: PackageBus = False,
    timeout: Annotated[
        float | None, typer.Option(help="How long to wait for slaves to appear [s].")
    ] = None,
    pin: Annotated[
        bool, typer.Option("--pin", help="Keep each launched slave on one processor.")
    ] = False,
    no_examine: Annotated[
        bool, typer.Option("--no-examine", help="Let the slaves take no trial steps first.")
    ] = False,
    trace: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Trace of all requests, for Perfetto.")
    ] = None,
    metrics_port: MetricsPort = None,
    metrics_host: MetricsHost = LOOPBACK,
    log_format: LogStyle = LogFormat.TEXT,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no summary.")] = False,
    no_plot: Annotated[bool, typer.Option("--no-plot", help="Draw no results.png.")] = False,
    stay_with_parent: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Run SYSTEM and write results, by default results.csv, steps, summary and a picture."""
    configure_logs(log_format, _TEXT_FORMAT)
    with interruptible(), ExitStack() as stack:
        if stay_with_parent:
            _end_with_parent()
        if in_process:
            _refuse_beside_in_process(
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
        from master_node.cli.upload_bar import UploadBar  # noqa: PLC0415  each command imports what it needs
        from master_node.observing.progress import ProgressBar  # noqa: PLC0415  each command imports what it needs
        from master_node.simulation import run as run_system  # noqa: PLC0415
        from master_node.study.case import apply_case, read_case  # noqa: PLC0415
        from master_node.system.files import open_system  # noqa: PLC0415

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
            .with_slaves(state=state)
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
        with output_of_others():
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


def _refuse_beside_in_process(options: Mapping[str, object]) -> None:
    given = [name for name, value in options.items() if value]
    if given:
        raise ConfigurationError(
            f"{given[0]} is for slaves on the bus, and with --in-process there is none",
            remedy=f"leave out {given[0]} or --in-process",
        )


def _show(directory: Path, *, quiet: bool, no_plot: bool) -> None:
    """What came out: a picture and the summary."""
    from master_node.observing.progress import summary_table  # noqa: PLC0415
    from master_node.results import PLOT_FILE, Result  # noqa: PLC0415
    from protocol.host.tables import show  # noqa: PLC0415

    result = Result.load(directory)
    if not no_plot:
        from master_node.results.plots import plot_result  # noqa: PLC0415  a second for matplotlib

        plot_result(result, directory / PLOT_FILE, show=False, variables=None, is_named=False)
    if not quiet:
        show(summary_table(result.summary))
        say(f"results in {directory}")


@app.command()
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
    with interruptible():
        from master_node.observing.progress import ProgressBar  # noqa: PLC0415
        from master_node.simulation import resume as resume_run  # noqa: PLC0415

        with output_of_others():
            resume_run(directory, observers=(ProgressBar(quiet=quiet),), trust=trust)
        _show(directory, quiet=quiet, no_plot=no_plot)


@app.command()
def sweep(  # noqa: PLR0917  as above
    study_file: Annotated[
        Path, typer.Argument(metavar="STUDY.toml", help="What to vary, and how.")
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
        bool, typer.Option("--replace", help="Lose runs of another study in the directory.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> None:
    """Run a system once for each case of a study; go on where an earlier sweep ended."""
    with interruptible():
        from master_node.study.configuration import load_study  # noqa: PLC0415
        from master_node.study.directory import TABLE_FILE  # noqa: PLC0415
        from master_node.study.execution import run_study  # noqa: PLC0415
        from master_node.study.progress import StudyProgress  # noqa: PLC0415
        from master_node.study.runner import LocalRunner  # noqa: PLC0415

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


@app.command()
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
    from master_node.results import PLOT_FILE, Result  # noqa: PLC0415
    from master_node.results.plots import plot_result  # noqa: PLC0415

    path = file or directory / PLOT_FILE
    try:
        with interruptible():
            result, is_named = Result.load(directory), file is not None
            plot_result(result, path, show=show, variables=variable or None, is_named=is_named)
    except KeyError as error:
        raise ConfigurationError(f"{directory}: {error.args[0]}", phase="plot") from None
    say(path)


@app.command()
def compare(
    a: Results,
    b: Results,
    rtol: Annotated[float, typer.Option(help="Relative tolerance.")] = 1e-3,
    atol: Annotated[float, typer.Option(help="Absolute tolerance.")] = 1e-6,
) -> None:
    """Compare two results, |A - B| <= atol + rtol |B|; exit code 1 when they differ."""
    from master_node.results.compare import compare as compare_results  # noqa: PLC0415
    from protocol.host.tables import show  # noqa: PLC0415

    comparison = compare_results(a, b, rtol, atol)
    show(comparison.table())
    if not comparison.within_tolerance:
        raise typer.Exit(1)


@app.command("import")
def import_(
    package: Annotated[
        Path,
        typer.Argument(
            metavar="SYSTEM.ssp", help="A package, PACKAGE.ssp#VARIANT.ssd, or an .ssd file."
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="System file [default: SYSTEM.toml].")
    ] = None,
    package_bus: PackageBus = False,
) -> None:
    """Write an SSP as SYSTEM.toml, with its FMUs in a folder SYSTEM_models beside it."""
    from master_node.system.files import import_system  # noqa: PLC0415

    path = output or package.with_name(f"{package.stem.replace('.ssp#', '_')}.toml")
    with interruptible():
        for note in import_system(package, path, package_bus=package_bus):
            log.warning("%s", note)
    say(path)


@app.command()
def export(
    system_file: Annotated[
        Path, typer.Argument(metavar="SYSTEM.toml", help="A system whose slaves are FMUs.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Package [default: SYSTEM.ssp].")
    ] = None,
) -> None:
    """Write a system and its FMUs as an SSP package."""
    from master_node.system.files import export_system  # noqa: PLC0415

    path = output or system_file.with_suffix(".ssp")
    with interruptible():
        export_system(system_file, path)
    say(path)


def _dask_runner(
    address: str, directory: StudyDirectory, needs: tuple[str, ...], licence_limit: int | None
) -> Runner:
    if importlib.util.find_spec("distributed") is None:
        raise ConfigurationError(
            "--dask needs the package distributed", remedy="pip install 'doublestep[dask]'"
        )
    from master_node.study.dask_runner import DaskRunner  # noqa: PLC0415  an extra

    return DaskRunner(address, directory, needs, licence_limit)


def _processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@app.command("list")
def list_(
    connect: Connect = None,
    listen: Listen = None,
    insecure: Insecure = False,
    tls: Tls = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show the slaves, agents, runs and routers on the bus."""
    from master_node.survey.listing import listing_data, listing_tables  # noqa: PLC0415
    from master_node.survey.participants import survey  # noqa: PLC0415
    from protocol.host.tables import show  # noqa: PLC0415

    with _windows(connect, listen, insecure=insecure, tls=tls) as opened:
        for window in opened:
            if window.failure is not None:
                log.warning("%s", window.failure)
        participants = survey([window.bus for window in opened if window.bus is not None])
    if as_json:
        say_json(listing_data(participants))
        return
    show(*listing_tables(participants))
    if not participants:
        log.warning("nobody is on the bus; `master-node doctor` says what to look at")


@app.command()
def doctor(
    connect: Connect = None,
    listen: Listen = None,
    insecure: Insecure = False,
    tls: Tls = None,
) -> None:
    """Look for what would keep a run from working; exit code 1 when there is something."""
    from master_node.survey.doctor import diagnose  # noqa: PLC0415
    from protocol.host.tables import show  # noqa: PLC0415

    with _windows(connect, listen, insecure=insecure, tls=tls) as opened:
        diagnosis = diagnose(opened)
    show(*diagnosis.tables())
    for problem in diagnosis.problems:
        say(f"{problem.where}: {problem.cause}; {problem.remedy}")
    if diagnosis.problems:
        raise typer.Exit(1)
    say("no problem found")


@contextmanager
def _windows(
    connect: Sequence[str] | None, listen: Sequence[str] | None, *, insecure: bool, tls: Path | None
) -> Iterator[list[Window]]:
    """Views of the bus at these addresses, see `master_node.survey.windows.windows`."""
    from master_node.survey.windows import windows  # noqa: PLC0415

    credentials = _credentials(tls)
    with (
        interruptible(),
        windows(connect or (), listen or (), insecure=insecure, credentials=credentials) as opened,
    ):
        yield opened


def _credentials(directory: Path | None) -> Credentials | None:
    return None if directory is None else Credentials(directory.absolute(), Role.MASTER)


def _served_metrics(stack: ExitStack, port: int, host: str) -> Observer:
    """An observer whose numbers are served while ``stack`` lasts."""
    from master_node.observing.metrics import RunMetrics  # noqa: PLC0415  only when asked for
    from protocol.host.metrics import metrics_served  # noqa: PLC0415

    metrics = RunMetrics()
    log.info("metrics at %s", stack.enter_context(metrics_served(port, host, metrics.read)))
    return metrics


def _order(text: str | None) -> int | str | None:
    """A number where it is one; whether it may be is for the system to say."""
    return int(text) if text is not None and text.isdecimal() else text


def _end_with_parent() -> None:
    """Our standard input is the parent's end of a pipe: it closes when the parent is gone."""

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(_END_TIME)
        os._exit(InterruptedRunError.exit_code)  # a model in this process does not come back

    start_thread(watch, "parent")


def main() -> None:
    """Entry point: errors become one line and an exit code."""
    forgive_standard_error()
    configure_logs(LogFormat.TEXT, _TEXT_FORMAT)
    try:
        with guarded_standard_output():
            app()
    except DoublestepError as error:
        if logs_json():
            log.error("%s", error, extra=about(error))
        else:
            say_error("master-node", error)
        sys.exit(error.exit_code)
