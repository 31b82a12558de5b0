"""The ``master-node`` command."""

from __future__ import annotations

import json
import logging
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from protocol.credentials import Credentials, Role
from protocol.endpoints import LOOPBACK
from protocol.errors import ConfigurationError, DoublestepError, InterruptedRunError
from protocol.logs import LogFormat, about, configure_logs, logs_json

if TYPE_CHECKING:
    from master_node.observers import Observer

app = typer.Typer(
    help="Co-simulation master with error-controlled communication step sizes.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

log = logging.getLogger("master_node")

_TEXT_FORMAT = "%(levelname)s: %(message)s"
_ENDING = (signal.SIGINT, signal.SIGTERM)

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
LogStyle = Annotated[LogFormat, typer.Option(help="Of messages on standard error.")]
ResultDirectory = Annotated[Path, typer.Argument(help="A result directory.")]


@app.command()
def run(  # noqa: PLR0917  options of the command line
    system_file: Annotated[
        Path, typer.Argument(metavar="SYSTEM", help="What to run: a .toml, .ssp or .ssd file.")
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
    output_interval: Annotated[
        float | None, typer.Option(help="Write results at multiples of this [s].")
    ] = None,
    output_variables: Annotated[
        list[str] | None,
        typer.Option(help="Pattern for slave.variable; !PATTERN leaves out; may be repeated."),
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
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Allow addresses other than loopback.")
    ] = False,
    tls: Tls = None,
    mode: Annotated[
        str | None, typer.Option(help="peer: reach slaves directly; client: through a router.")
    ] = None,
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
) -> None:
    """Run SYSTEM and write results, by default results.csv, steps, summary and a picture."""
    configure_logs(log_format, _TEXT_FORMAT)
    with _interruptible(), ExitStack() as stack:
        from rich.console import Console  # noqa: PLC0415  each command imports what it needs

        from master_node.plots import plot_result  # noqa: PLC0415
        from master_node.progress import ProgressBar, summary_table  # noqa: PLC0415
        from master_node.results import PLOT_FILE, Result  # noqa: PLC0415
        from master_node.simulation import run as run_system  # noqa: PLC0415
        from master_node.system_files import open_system  # noqa: PLC0415

        system = (
            stack.enter_context(open_system(system_file))
            .with_simulation(
                preset=preset,
                order=_order(order),
                derivative_points=derivative_points,
                controller=controller,
                sequence=sequence,
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
                every=output_every,
                formats=tuple(output_format or ()),
            )
        )
        observers: list[Observer] = [ProgressBar(quiet=quiet or log_format is LogFormat.JSON)]
        if metrics_port is not None:
            observers.append(_served_metrics(stack, metrics_port, metrics_host))
        try:
            run_system(
                system,
                output,
                in_process=in_process,
                launch=not no_launch,
                observers=observers,
                trace=trace,
            )
        except KeyboardInterrupt:
            raise InterruptedRunError("interrupted before the first step") from None
        result = Result.load(output)
        if not no_plot:
            plot_result(result, output / PLOT_FILE, show=False, variables=None)
        if not quiet:
            console = Console()
            console.print(summary_table(result.summary))
            console.print(f"results in {output}", highlight=False)


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
    from master_node.plots import plot_result  # noqa: PLC0415
    from master_node.results import PLOT_FILE, Result  # noqa: PLC0415

    path = file or directory / PLOT_FILE
    try:
        plot_result(Result.load(directory), path, show=show, variables=variable or None)
    except KeyError as error:
        raise ConfigurationError(f"{directory}: {error.args[0]}", phase="plot") from None
    typer.echo(path)


@app.command()
def compare(
    a: ResultDirectory,
    b: ResultDirectory,
    rtol: Annotated[float, typer.Option(help="Relative tolerance.")] = 1e-3,
    atol: Annotated[float, typer.Option(help="Absolute tolerance.")] = 1e-6,
) -> None:
    """Compare two result directories, |A - B| <= atol + rtol |B|; exit code 1 when they differ."""
    from rich.console import Console  # noqa: PLC0415

    from master_node.compare import compare as compare_results  # noqa: PLC0415

    comparison = compare_results(a, b, rtol, atol)
    Console().print(comparison.table())
    if not comparison.within_tolerance:
        raise typer.Exit(1)


@app.command("import")
def import_(
    package: Annotated[
        Path, typer.Argument(metavar="SYSTEM.ssp", help="A package, or an .ssd file.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="System file [default: SYSTEM.toml].")
    ] = None,
) -> None:
    """Write an SSP as SYSTEM.toml, with its FMUs in a folder SYSTEM_models beside it."""
    from master_node.system_files import import_system  # noqa: PLC0415

    path = output or package.with_suffix(".toml")
    for note in import_system(package, path):
        log.warning("%s", note)
    typer.echo(path)


@app.command()
def export(
    system_file: Annotated[
        Path, typer.Argument(metavar="SYSTEM.toml", help="A system whose slaves are FMUs.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Package [default: SYSTEM.ssp].")
    ] = None,
) -> None:
    """Write a system and its FMUs as an SSP 1.0 package."""
    from master_node.system_files import export_system  # noqa: PLC0415

    path = output or system_file.with_suffix(".ssp")
    export_system(system_file, path)
    typer.echo(path)


@app.command("list")
def list_(
    connect: Connect = None,
    listen: Listen = None,
    insecure: Insecure = False,
    tls: Tls = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show the slaves, co-simulations and routers on the bus."""
    from rich.console import Console  # noqa: PLC0415

    from master_node.listing import listing_data, listing_tables  # noqa: PLC0415
    from master_node.survey import survey  # noqa: PLC0415
    from master_node.windows import windows  # noqa: PLC0415

    with (
        _interruptible(),
        windows(
            connect or (), listen or (), insecure=insecure, credentials=_credentials(tls)
        ) as opened,
    ):
        for window in opened:
            if window.failure is not None:
                log.warning("%s", window.failure)
        participants = survey([window.bus for window in opened if window.bus is not None])
    if as_json:
        typer.echo(json.dumps(listing_data(participants), indent=2))
        return
    for table in listing_tables(participants):
        Console().print(table)
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
    from rich.console import Console  # noqa: PLC0415

    from master_node.doctor import diagnose  # noqa: PLC0415
    from master_node.plain_text import plain  # noqa: PLC0415
    from master_node.windows import windows  # noqa: PLC0415

    with (
        _interruptible(),
        windows(
            connect or (), listen or (), insecure=insecure, credentials=_credentials(tls)
        ) as opened,
    ):
        diagnosis = diagnose(opened)
    for table in diagnosis.tables():
        Console().print(table)
    for problem in diagnosis.problems:
        typer.echo(plain(f"{problem.where}: {problem.cause}; {problem.remedy}"))
    if diagnosis.problems:
        raise typer.Exit(1)
    typer.echo("no problem found")


def _credentials(directory: Path | None) -> Credentials | None:
    return None if directory is None else Credentials(directory.absolute(), Role.MASTER)


def _served_metrics(stack: ExitStack, port: int, host: str) -> Observer:
    """An observer whose numbers are served while ``stack`` lasts."""
    from master_node.run_metrics import RunMetrics  # noqa: PLC0415  only when asked for
    from protocol.metrics import metrics_served  # noqa: PLC0415

    metrics = RunMetrics()
    log.info("metrics at %s", stack.enter_context(metrics_served(port, host, metrics.read)))
    return metrics


def _order(text: str | None) -> int | str | None:
    """A number where it is one; whether it may be is for the system to say."""
    return int(text) if text is not None and text.isdecimal() else text


@contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C and SIGTERM end the command with exit code 130, also where a shell ignores them.

    A second one kills it: what it launched ends with it.
    """

    def interrupt(*_: object) -> NoReturn:
        for number in _ENDING:
            signal.signal(number, signal.SIG_DFL)
        raise KeyboardInterrupt

    for number in _ENDING:
        signal.signal(number, interrupt)
    try:
        yield
    except KeyboardInterrupt:
        raise InterruptedRunError("interrupted") from None


def main() -> None:
    """Entry point: errors become one line and an exit code."""
    configure_logs(LogFormat.TEXT, _TEXT_FORMAT)
    try:
        app()
    except DoublestepError as error:
        if logs_json():
            log.error("%s", error, extra=about(error))
        else:
            typer.echo(f"master-node: {error}", err=True)
        sys.exit(error.exit_code)
