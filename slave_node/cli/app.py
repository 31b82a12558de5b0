"""The ``slave-node`` command."""

from __future__ import annotations

import logging
import math
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from secrets import token_hex
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.bus.bus import DEFAULT_ENDPOINT
from protocol.bus.credentials import Credentials, Role
from protocol.bus.endpoints import LOOPBACK, Endpoints, Mode
from protocol.errors import ConfigurationError, DoublestepError
from protocol.host.interruption import interruptible
from protocol.host.logs import LogFormat, about, configure_logs, logs_json
from protocol.host.processes import ending_signals
from protocol.host.scratch import ScratchDirectory
from protocol.host.standard_error import forgive_standard_error
from protocol.host.standard_output import guarded_standard_output, output_of_others
from protocol.host.terminal import say, say_error, say_json
from protocol.host.threads import start_thread
from protocol.host.toml_text import assigned_values
from protocol.wire.administration import DEFAULT_LOAD_TIMEOUT, STATUS_BYTES
from protocol.wire.keys import AgentKey, RouterKey, SlaveKey, check_name

if TYPE_CHECKING:
    from slave_node.worker.process import Worker

app = typer.Typer(
    help="Serve an FMU or a Python model as a co-simulation slave.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
log = logging.getLogger("slave_node")

_MB = 10**6

Model = Annotated[
    str,
    typer.Argument(
        help="An .fmu file, the folder of an FMU, package.module:Class or path/to/file.py:Class."
    ),
]

Insecure = Annotated[bool, typer.Option("--insecure", help="Allow addresses other than loopback.")]

Tls = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Certificates: encrypt, and let in only who has one."),
]

LogStyle = Annotated[LogFormat, typer.Option(help="Of messages.")]


class BusMode(StrEnum):
    """How a slave or an agent takes part in the bus; a router is a command of its own."""

    PEER = Mode.PEER
    CLIENT = Mode.CLIENT


BusModeOption = Annotated[
    BusMode, typer.Option("--mode", help="peer: reach masters directly; client: through a router.")
]


@app.command()
def serve(  # noqa: PLR0917  options of the command line
    model: Model,
    name: Annotated[
        str, typer.Option(help="Name on the bus, as in the system file [default: the model's].")
    ] = "",
    connect: Annotated[
        list[str] | None,
        typer.Option(help=f"Master to connect to [default: {DEFAULT_ENDPOINT}]."),
    ] = None,
    listen: Annotated[
        list[str] | None, typer.Option(help="Address on which masters can reach this slave.")
    ] = None,
    parameter: Annotated[
        list[str] | None, typer.Option(help="Start value, name=value; may be repeated.")
    ] = None,
    ignore_bounds: Annotated[
        bool,
        typer.Option("--ignore-bounds", help="Take start values beyond the model's min and max."),
    ] = False,
    insecure: Insecure = False,
    tls: Tls = None,
    mode: BusModeOption = BusMode.PEER,
    metrics_port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Serve metrics for Prometheus there.")
    ] = None,
    metrics_host: Annotated[
        str, typer.Option(help="Address for that; nobody is asked who he is.")
    ] = LOOPBACK,
    log_format: LogStyle = LogFormat.TEXT,
    fmi_logging: Annotated[
        bool, typer.Option("--fmi-logging", help="Let the FMU log all categories.")
    ] = False,
    state: Annotated[
        str,
        typer.Option(
            help="How its state is saved unless the master asks for another way: native, fork, "
            "replay or none [default: the best that the model and this host allow]."
        ),
    ] = "",
    load_timeout: Annotated[
        float, typer.Option(help="Bound on loading or resetting the model [s].", min=0.0, max=1e6)
    ] = DEFAULT_LOAD_TIMEOUT,
    base: Annotated[
        Path, typer.Option(help="Directory to which the model's path is relative.")
    ] = Path(),
    instance: Annotated[str, typer.Option(hidden=True)] = "",
    stay_with_parent: Annotated[bool, typer.Option(hidden=True)] = False,
    processor: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Load MODEL and serve it until SIGTERM or Ctrl-C."""
    from protocol.bus.zenoh import ZenohBus  # noqa: PLC0415  keeps the worker light
    from slave_node.serving.given_parameters import check_parameters  # noqa: PLC0415
    from slave_node.serving.node import SlaveNode  # noqa: PLC0415
    from slave_node.worker.process import ModelReference, WorkerProcess  # noqa: PLC0415

    key = SlaveKey(check_name(name or _default_name(model, base)), instance or token_hex(4))
    configure_logs(log_format, f"%(asctime)s {key.name}: %(message)s", slave=key.name)
    endpoints = Endpoints(
        listen=tuple(listen or ()),
        connect=tuple(connect or (() if listen else (DEFAULT_ENDPOINT,))),
        insecure=insecure,
        mode=Mode(mode),
        credentials=None if tls is None else Credentials(tls.absolute(), Role.SLAVE),
    )
    reference = ModelReference(
        model,
        base.absolute(),
        key.name,
        assigned_values("--parameter", parameter or ()),
        fmi_logging,
        state,
        log_format,
    )
    if processor is not None:
        os.sched_setaffinity(0, {processor})  # type: ignore[attr-defined,unused-ignore]  # Linux
    stack = ExitStack()
    worker: Worker = WorkerProcess(reference, load_timeout)
    if metrics_port is not None:
        worker = _counting(worker, key.name, stack, metrics_port, metrics_host)
    bus: ZenohBus | None = None
    node: SlaveNode | None = None
    ending = threading.Event()

    def end_work() -> None:
        if node is None or node.busy:  # loading, or in a step
            worker.kill()

    def end(reason: str) -> None:
        ending.set()
        log.info("ending: %s", reason)
        end_work()
        if bus is not None:
            bus.close()
            end_work()  # what began meanwhile; now nothing begins any more

    _end_on_signals(end)
    if stay_with_parent:
        _end_with_parent(end)
    try:
        description = worker.start()
        check_parameters(description, reference.parameters, ignores_bounds=ignore_bounds)
        for remark in description.remarks:
            log.warning("%s", remark)
        bus = ZenohBus(endpoints, stop=ending)
        node = SlaveNode(bus, worker, key, description, load_timeout=load_timeout)
        if not ending.is_set():
            log.info("%s loaded; on the bus %s", model, _where(endpoints))
            node.serve()
    except DoublestepError:
        if not ending.is_set():  # else it is what the ending did to what was under way
            raise
    finally:
        if bus is not None:
            bus.close()
        worker.stop()
        stack.close()
    log.info("ended")


@app.command()
def router(
    listen: Annotated[
        list[str] | None,
        typer.Option(help=f"Address for masters and slaves [default: {DEFAULT_ENDPOINT}]."),
    ] = None,
    connect: Annotated[list[str] | None, typer.Option(help="Another router.")] = None,
    insecure: Insecure = False,
    tls: Tls = None,
    log_format: LogStyle = LogFormat.TEXT,
) -> None:
    """Connect masters and slaves in mode client with each other, until SIGTERM or Ctrl-C."""
    from protocol.bus.zenoh import ZenohBus  # noqa: PLC0415  each command imports what it needs
    from slave_node.serving.router import serve_router  # noqa: PLC0415

    configure_logs(log_format, "%(asctime)s router: %(message)s")
    endpoints = Endpoints(
        listen=tuple(listen or (DEFAULT_ENDPOINT,)),
        connect=tuple(connect or ()),
        insecure=insecure,
        mode=Mode.ROUTER,
        credentials=None if tls is None else Credentials(tls.absolute(), Role.ROUTER),
    )
    ending = threading.Event()

    def end(reason: str) -> None:
        log.info("ending: %s", reason)
        ending.set()

    _end_on_signals(end)
    bus = ZenohBus(endpoints)
    try:
        log.info("on the bus %s", _where(endpoints))
        serve_router(bus, RouterKey(token_hex(4)), _where(endpoints), ending)
    finally:
        bus.close()
    log.info("ended")


@app.command()
def check(  # noqa: PLR0917  options of the command line
    name: Annotated[str, typer.Argument(help="Slave to look for [default: a router].")] = "",
    agent: Annotated[bool, typer.Option("--agent", help="NAME is an agent.")] = False,
    connect: Annotated[
        str, typer.Option(help="Router, or the slave or agent itself where it listens.")
    ] = DEFAULT_ENDPOINT,
    insecure: Insecure = False,
    tls: Tls = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="For the connection [s].")] = 3.0,
) -> None:
    """Exit code 0 if NAME serves, 3 if not: for health checks of service managers."""
    from protocol.bus.zenoh import ZenohBus  # noqa: PLC0415  each command imports what it needs
    from slave_node.serving.health import check_alive  # noqa: PLC0415

    role = Role.SLAVE if name else Role.ROUTER
    endpoints = Endpoints(
        connect=(connect,),
        insecure=insecure,
        mode=Mode.CLIENT,
        credentials=None if tls is None else Credentials(tls.absolute(), role),
    )
    if name:
        check_name(name)
    with interruptible():
        bus = ZenohBus(endpoints, timeout=timeout, largest=STATUS_BYTES)
        try:
            check_alive(bus, name, agent=agent)
        finally:
            bus.close()


@app.command()
def agent(  # noqa: PLR0917  options of the command line
    models: Annotated[
        Path, typer.Option(metavar="DIR", help="Models that masters may start, without subfolders.")
    ],
    name: Annotated[
        str, typer.Option(help="Name on the bus, as `host` in system files [default: the host's].")
    ] = "",
    label: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What this host has; may be repeated."),
    ] = None,
    licence: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=COUNT", help="How many slaves may hold a licence; may be repeated."
        ),
    ] = None,
    allow_upload: Annotated[
        bool, typer.Option("--allow-upload", help="Load FMUs that masters send.")
    ] = False,
    upload_limit: Annotated[
        int, typer.Option(metavar="MB", min=1, help="Largest FMU that masters may send.")
    ] = 500,
    cache: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keeps what was sent [default: in the user's cache]."),
    ] = None,
    cache_limit: Annotated[
        int, typer.Option(metavar="MB", min=1, help="How much is kept of what was sent.")
    ] = 5000,
    allow_python: Annotated[
        bool, typer.Option("--allow-python", help="Start Python models that masters name.")
    ] = False,
    logs: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keep what the slaves say [default: until they end]."),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(help=f"Master or router to connect to [default: {DEFAULT_ENDPOINT}]."),
    ] = None,
    listen: Annotated[
        list[str] | None, typer.Option(help="Address on which masters reach agent and slaves.")
    ] = None,
    insecure: Insecure = False,
    tls: Tls = None,
    mode: BusModeOption = BusMode.PEER,
    log_format: LogStyle = LogFormat.TEXT,
) -> None:
    """Start slaves on this host when masters ask for them, until SIGTERM or Ctrl-C."""
    from protocol.bus.zenoh import ZenohBus  # noqa: PLC0415
    from protocol.wire.agents import AGENT_MESSAGE_BYTES  # noqa: PLC0415  each command imports its own
    from protocol.wire.packing import MAX_MESSAGE_BYTES  # noqa: PLC0415
    from slave_node.agent.agent import Agent, Offer, Surroundings  # noqa: PLC0415
    from slave_node.agent.model_store import ModelStore  # noqa: PLC0415
    from slave_node.agent.options import (  # noqa: PLC0415
        default_cache,
        parse_labels,
        parse_licences,
        places_of,
    )
    from slave_node.agent.upload_cache import UploadCache  # noqa: PLC0415

    key = AgentKey(check_name(name or socket.gethostname(), "agent name"), token_hex(4))
    configure_logs(log_format, f"%(asctime)s agent {key.name}: %(message)s")
    if logs is not None:
        _make_directory(logs)
    places = places_of(connect or (), listen or (), Mode(mode), insecure=insecure, tls=tls)
    offer = Offer(
        labels=parse_labels(label or ()),
        licences=parse_licences(licence or ()),
        store=ModelStore(models, python=allow_python),
        cache=UploadCache(cache or default_cache(key.name), upload_limit * _MB, cache_limit * _MB)
        if allow_upload
        else None,
        python=allow_python,
    )
    ending = threading.Event()

    def end(reason: str) -> None:
        log.info("ending: %s", reason)
        ending.set()

    _end_on_signals(end)
    with ExitStack() as stack:
        scratch = stack.enter_context(ScratchDirectory())
        try:
            is_passing_on = bool(places.own.listen)  # what masters and slaves say to each other
            largest = MAX_MESSAGE_BYTES if is_passing_on else AGENT_MESSAGE_BYTES
            bus = ZenohBus(places.own, stop=ending, largest=largest)
            stack.callback(bus.close)
            log.info("on the bus %s", _where(places.own))
            surroundings = Surroundings(places.of_slaves, scratch, logs)
            Agent(bus, key, offer, surroundings).serve(ending)
        except DoublestepError:
            if not ending.is_set():  # else it is what the ending did to what was under way
                raise
    log.info("ended")


@app.command()
def certificates(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where the authority is, or will be.")
    ],
    host: Annotated[
        list[str],
        typer.Option(
            metavar="NAME[=ADDRESS,...]",
            help="Host by the name under which it is called, and further names or addresses.",
        ),
    ],
    role: Annotated[
        list[Role] | None, typer.Option(help="What the hosts may be [default: slave].")
    ] = None,
    days: Annotated[
        int, typer.Option(min=1, max=3650, help="Validity of host certificates.")
    ] = 825,
) -> None:
    """Make certificates for --tls: an authority in DIR, and what host NAME needs in DIR/NAME."""
    from slave_node.certificates import Host, make_certificates  # noqa: PLC0415

    hosts = [Host.parse(text) for text in host]
    with interruptible():
        for path in make_certificates(directory, hosts, role or [Role.SLAVE], days):
            say(path)


@app.command()
def inspect(
    model: Model,
    as_json: Annotated[bool, typer.Option("--json", help="Print the description as JSON.")] = False,
) -> None:
    """Show MODEL's variables, units, capabilities, feed-through and how its state can be saved."""
    from slave_node.loading import describe_model  # noqa: PLC0415
    from slave_node.validation.report import description_tables  # noqa: PLC0415

    with interruptible(), output_of_others():
        description = describe_model(model, Path.cwd())
    if as_json:
        say_json(_finite(asdict(description)))
        return
    from protocol.host.tables import show  # noqa: PLC0415

    show(*description_tables(description))


@app.command()
def validate(
    model: Model,
    step_size: Annotated[
        float | None, typer.Option(help="Of the trial steps [s] [default: the model's, or 0.01].")
    ] = None,
    timeout: Annotated[float, typer.Option(help="Bound on each trial [s].", min=0.1)] = 60.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Try what MODEL can do, and say what Doublestep does about the rest."""
    from slave_node.validation.trials import is_usable, unusable  # noqa: PLC0415
    from slave_node.validation.trials import validate as trials  # noqa: PLC0415

    findings = []
    if as_json:
        with interruptible(), output_of_others():
            findings = list(trials(model, Path.cwd(), step_size, timeout=timeout))
        say_json([asdict(finding) for finding in findings])
    else:
        from rich.console import Console  # noqa: PLC0415

        from protocol.host.tables import show  # noqa: PLC0415
        from slave_node.validation.report import report_table  # noqa: PLC0415

        with interruptible(), Console(stderr=True).status("trying"), output_of_others():
            findings = list(trials(model, Path.cwd(), step_size, timeout=timeout))
        show(report_table(model, findings))
    if not is_usable(findings):
        raise unusable(model)


def _counting(worker: Worker, name: str, stack: ExitStack, port: int, host: str) -> Worker:
    """The same worker, counted; its numbers are served while ``stack`` lasts."""
    from protocol.host.metrics import metrics_served  # noqa: PLC0415  only when asked for
    from slave_node.serving.metrics import CountingWorker  # noqa: PLC0415

    counting = CountingWorker(worker, name)
    log.info("metrics at %s", stack.enter_context(metrics_served(port, host, counting.read)))
    return counting


def _where(endpoints: Endpoints) -> str:
    places = [f"at {e}" for e in endpoints.listen] + [f"to {e}" for e in endpoints.connect]
    return ", ".join(places)


def _make_directory(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be made: {error}") from error


def _default_name(model: str, base: Path) -> str:
    if ":" in model:
        return model.rpartition(":")[2]
    path = (base / model).resolve()
    return path.name if path.is_dir() else path.stem


def _finite(value: Any) -> Any:
    """The same with texts for the numbers that JSON does not have."""
    match value:
        case dict():
            return {key: _finite(item) for key, item in value.items()}
        case list() | tuple():
            return [_finite(item) for item in value]
        case float() if not math.isfinite(value):
            return str(value)
    return value


def _end_on_signals(end: Callable[[str], None]) -> None:
    """On a thread, because the one that gets the signal may hold any lock."""

    def handle(number: int, _: FrameType | None) -> None:
        start_thread(lambda: end(signal.Signals(number).name), "end")

    for number in ending_signals():
        signal.signal(number, handle)


def _end_with_parent(end: Callable[[str], None]) -> None:
    """Our standard input is the parent's end of a pipe: it closes when the parent is gone."""

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        end("who started this slave is done or gone")

    start_thread(watch, "parent")


def main() -> None:
    """Entry point: errors become one line and an exit code."""
    forgive_standard_error()
    try:
        with guarded_standard_output():
            app()
    except DoublestepError as error:
        if logs_json():
            log.error("%s", error, extra=about(error))
        else:
            say_error("slave-node", error)
        sys.exit(error.exit_code)
