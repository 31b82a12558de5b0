"""The ``slave-node`` command."""

from __future__ import annotations

import json
import logging
import math
import os
import signal
import sys
import threading
import tomllib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from secrets import token_hex
from types import FrameType
from typing import Annotated, Any

import typer

from protocol.bus import DEFAULT_ENDPOINT
from protocol.errors import ConfigurationError, DoublestepError
from protocol.keys import SlaveKey, check_name
from protocol.slave import StartValue

app = typer.Typer(
    help="Serve an FMU or a Python model as a co-simulation slave.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
log = logging.getLogger("slave_node")

Model = Annotated[
    str, typer.Argument(help="An .fmu file, package.module:Class or path/to/file.py:Class.")
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
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Allow addresses other than loopback.")
    ] = False,
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
    base: Annotated[
        Path, typer.Option(help="Directory to which the model's path is relative.")
    ] = Path(),
    instance: Annotated[str, typer.Option(hidden=True)] = "",
    stay_with_parent: Annotated[bool, typer.Option(hidden=True)] = False,
    processor: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Load MODEL and serve it until SIGTERM or Ctrl-C."""
    from protocol.zenoh_bus import Endpoints, ZenohBus  # noqa: PLC0415  keeps the worker light
    from slave_node.node import SlaveNode  # noqa: PLC0415
    from slave_node.worker import ModelReference, WorkerProcess  # noqa: PLC0415

    key = SlaveKey(check_name(name or _default_name(model)), instance or token_hex(4))
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format=f"%(asctime)s {key.name}: %(message)s"
    )
    endpoints = Endpoints(
        listen=tuple(listen or ()),
        connect=tuple(connect or (() if listen else (DEFAULT_ENDPOINT,))),
        insecure=insecure,
    )
    reference = ModelReference(
        model, base.absolute(), key.name, _parameters(parameter or []), fmi_logging, state
    )
    if processor is not None:
        os.sched_setaffinity(0, {processor})  # type: ignore[attr-defined,unused-ignore]  # Linux
    worker = WorkerProcess(reference)
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
        bus = ZenohBus(endpoints)
        node = SlaveNode(bus, worker, key, description)
        if not ending.is_set():
            where = [f"at {e}" for e in endpoints.listen] + [f"to {e}" for e in endpoints.connect]
            log.info("%s loaded; on the bus %s", model, ", ".join(where))
            node.serve()
    except DoublestepError:
        if not ending.is_set():  # else it is what the ending did to what was under way
            raise
    finally:
        if bus is not None:
            bus.close()
        worker.stop()
    log.info("ended")


@app.command()
def inspect(
    model: Model,
    as_json: Annotated[bool, typer.Option("--json", help="Print the description as JSON.")] = False,
) -> None:
    """Show MODEL's variables, units, capabilities, feed-through and how its state can be saved."""
    from slave_node.inspection import description_tables  # noqa: PLC0415
    from slave_node.loading import describe_model  # noqa: PLC0415

    description = describe_model(model, Path.cwd())
    if as_json:
        typer.echo(json.dumps(_finite(asdict(description)), indent=2))
        return
    from rich.console import Console  # noqa: PLC0415

    console = Console()
    for table in description_tables(description):
        console.print(table)


def _default_name(model: str) -> str:
    return model.rpartition(":")[2] if ":" in model else Path(model).stem


def _parameters(assignments: list[str]) -> dict[str, StartValue]:
    """``name=value`` with the value in TOML's notation; what is none is a string."""
    values: dict[str, StartValue] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name:
            raise ConfigurationError(f"--parameter {assignment}: write name=value")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text
        if not isinstance(value, float | int | bool | str):
            raise ConfigurationError(f"--parameter {assignment}: not a number, boolean or string")
        values[name.strip()] = value
    return values


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
        threading.Thread(target=end, args=(signal.Signals(number).name,), daemon=True).start()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, handle)


def _end_with_parent(end: Callable[[str], None]) -> None:
    """Our standard input is the parent's end of a pipe: it closes when the parent is gone."""

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        end("the master that started this slave is done or gone")

    threading.Thread(target=watch, name="parent", daemon=True).start()


def main() -> None:
    """Entry point: errors become one line and an exit code."""
    try:
        app()
    except DoublestepError as error:
        typer.echo(f"slave-node: {error}", err=True)
        sys.exit(error.exit_code)
