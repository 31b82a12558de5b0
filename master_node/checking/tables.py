"""Report of a checked system as tables that can be read on 80 columns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from master_node.checking.report import (
    ConnectionReport,
    InputReport,
    LoopReport,
    SlaveReport,
    StateCosts,
    StepBound,
    SystemReport,
)
from protocol.host.tables import lines, plain
from protocol.text.names import number_of

_MOST_ROWS = 60
"""Rows of a table that are shown; JSON has all."""

_STATES = {"fork": "forked", "replay": "replayed", "none": "cannot be saved", "native": "native"}


def report_tables(report: SystemReport) -> list[Table]:
    """The report for people; no table for what there is none of."""
    tables = [
        _table(
            "Slaves", ("slave", "model", "saved states", "found out"), map(_slave, report.slaves)
        ),
        _table("Connections", ("from", "to", "on the way"), map(_connection, report.connections)),
        _table(
            "Inputs that no output feeds",
            ("input", "value", "from"),
            map(_input, report.unconnected),
        ),
        _table("Outputs that feed nothing", ("output",), ((name,) for name in report.unused)),
        _table(
            "Loops of direct feed-through", ("outputs", "closed", "gain"), map(_loop, report.loops)
        ),
        _table(
            "What bounds the communication step size H",
            ("", "[s]", "why"),
            map(_bound, report.bounds),
        ),
        _table("Warnings", ("",), ((text,) for text in report.warnings), header=False),
    ]
    return [table for table in tables if table.row_count]


def _table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], *, header: bool = True
) -> Table:
    table = Table(
        title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_header=header
    )
    for column in columns:
        table.add_column(plain(column), overflow="fold")
    all_rows = list(rows)
    for row in all_rows[:_MOST_ROWS]:
        table.add_row(*(_cell(cell) for cell in row))
    if len(all_rows) > _MOST_ROWS:
        more = f"and {len(all_rows) - _MOST_ROWS} more, which --json shows"
        table.add_row(plain(more), *("" for _ in columns[1:]))
    return table


def _cell(cell: object) -> Text:
    return lines(cell) if isinstance(cell, list) else plain(cell)


def _slave(slave: SlaveReport) -> tuple[object, ...]:
    found = [f"{number_of(slave.inputs, 'input')}, {number_of(slave.outputs, 'output')}"]
    order = f"input polynomials up to order {slave.input_order}"
    found.append(f"{order} ({slave.input_derivatives})" if slave.input_order else "inputs held")
    if slave.output_derivative_order:
        found.append(f"output derivatives up to order {slave.output_derivative_order}")
    if slave.internal_clock is not None:
        found.append(f"internal clock of {slave.internal_clock:g} s")
    elif slave.step_multiple is not None:
        found.append(f"steps are multiples of {slave.step_multiple:g} s")
    model = [slave.model, slave.kind]
    model += [slave.generation_tool] if slave.generation_tool else []
    return [slave.name, f"{slave.place}, {slave.host}"], model, list(_states(slave)), found


def _states(slave: SlaveReport) -> Iterator[str]:
    verdict = f": {slave.state_verdict}" if slave.state_verdict else ""
    yield _STATES.get(slave.state_kind, slave.state_kind) + verdict
    if slave.state_costs is not None:
        yield _costs(slave.state_costs)
    if slave.state_kind == "replay":
        yield "going back takes longer with each step"
    if slave.state_reason:
        yield f"because {slave.state_reason}"
    if slave.state_remedy:
        yield slave.state_remedy


def _costs(costs: StateCosts) -> str:
    if costs.refusal:
        return f"refused: {costs.refusal}"
    return f"get {_time(costs.get)}, set {_time(costs.set)}, free {_time(costs.free)}"


def _time(seconds: float) -> str:
    return f"{seconds * 1e3:.3g} ms" if seconds >= 1e-3 else f"{seconds * 1e6:.3g} us"


def _connection(connection: ConnectionReport) -> tuple[object, ...]:
    way = []
    if (connection.factor, connection.offset) != (1.0, 0.0):
        offset = f" {connection.offset:+.6g}" if connection.offset else ""
        way.append(f"times {connection.factor:.6g}{offset}")
    if connection.cast:
        way.append(connection.cast)
    if connection.is_mapped:
        way.append("values mapped")
    if not connection.is_continuous:
        way.append("held in each step")
    return (
        _with_unit(connection.source, connection.source_unit),
        _with_unit(connection.target, connection.target_unit),
        ", ".join(way),
    )


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _input(one: InputReport) -> tuple[object, ...]:
    value = one.description or ("-" if one.value is None else one.value)
    value = repr(value) if value == "" else value
    return _with_unit(one.name, one.unit), value, one.given_by


def _loop(loop: LoopReport) -> tuple[object, ...]:
    sign = " -> " if loop.is_single else ", "
    outputs = sign.join(loop.outputs)
    if loop.unknown:
        return outputs, str(loop.when), f"unknown: {loop.unknown}"
    if loop.is_single:
        return outputs, str(loop.when), f"{loop.gain:.4g}"
    return (
        outputs,
        str(loop.when),
        f"{loop.gain:.4g} (spectral radius: there are several ways around)",
    )


def _bound(bound: StepBound) -> tuple[object, ...]:
    return bound.what, "" if bound.value is None else f"{bound.value:.6g}", bound.why
