"""Command ``serve``."""

from __future__ import annotations

import logging
import os
import threading
from contextlib import ExitStack
from pathlib import Path
from secrets import token_hex
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.bus.bus import DEFAULT_ENDPOINT, Bus
from protocol.bus.credentials import Credentials, Role
from protocol.bus.endpoints import LOOPBACK, Endpoints, Mode
from protocol.errors import DoublestepError
from protocol.host.log_files import STANDARD_ERROR, LogOutput
from protocol.host.logs import LogFormat, configure_logs
from protocol.host.toml_text import assigned_values
from protocol.text.references import split_reference
from protocol.wire.administration import DEFAULT_LOAD_TIMEOUT
from protocol.wire.keys import SlaveKey, check_name
from slave_node.cli.options import (
    BusMode,
    BusModeOption,
    Insecure,
    LogStyle,
    Model,
    Tls,
    shown_places,
)
from slave_node.cli.shutdown import end_on_signals, end_with_parent

if TYPE_CHECKING:  # each command imports what it needs
    from slave_node.worker.process import Worker

log = logging.getLogger("slave_node")


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
        int | None,
        typer.Option(min=0, max=65535, help="Port of metrics for Prometheus."),
    ] = None,
    metrics_host: Annotated[
        str, typer.Option(help="Address for metrics, without authentication.")
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
    log_file: Annotated[str, typer.Option(hidden=True)] = "",
    processor: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Load MODEL and serve it until SIGTERM or Ctrl-C."""
    from protocol.bus.opening import open_bus
    from slave_node.serving.given_parameters import check_parameters
    from slave_node.serving.node import SlaveNode
    from slave_node.worker.process import ModelReference, WorkerProcess

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
        LogOutput(log_file or STANDARD_ERROR, log_format, ("*",) if fmi_logging else ()),
        state,
        log_format,
    )
    if processor is not None:
        os.sched_setaffinity(0, {processor})  # type: ignore[attr-defined,unused-ignore]  # Linux
    stack = ExitStack()
    worker: Worker = WorkerProcess(reference, load_timeout)
    if metrics_port is not None:
        worker = _counting(worker, key.name, stack, metrics_port, metrics_host)
    bus: Bus | None = None
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

    end_on_signals(end)
    if stay_with_parent:
        end_with_parent(end)
    try:
        description = worker.start()
        check_parameters(description, reference.parameters, ignores_bounds=ignore_bounds)
        for remark in description.remarks:
            log.warning("%s", remark)
        bus = open_bus(endpoints, stop=ending)
        node = SlaveNode(bus, worker, key, description, load_timeout=load_timeout)
        if not ending.is_set():
            log.info("%s loaded; on the bus %s", model, shown_places(endpoints))
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


def _counting(worker: Worker, name: str, stack: ExitStack, port: int, host: str) -> Worker:
    """Worker that is counted; its numbers are served while ``stack`` lasts."""
    from protocol.host.metrics import metrics_served
    from slave_node.serving.metrics import CountingWorker

    counting = CountingWorker(worker, name)
    log.info("metrics at %s", stack.enter_context(metrics_served(port, host, counting.read)))
    return counting


def _default_name(model: str, base: Path) -> str:
    reference = split_reference(model)
    if reference is not None:
        return reference[1]
    path = (base / model).resolve()
    return path.name if path.is_dir() else path.stem
