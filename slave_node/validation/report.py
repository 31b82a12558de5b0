"""Tables of ``slave-node inspect`` and ``validate``."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Column, Table

from protocol.description import SlaveDescription
from protocol.host.tables import lines, plain
from protocol.values import item_name
from protocol.variables import Variable
from slave_node.validation.trials import Finding, Grade

_STATE = {
    "native": "saved and restored by the model itself",
    "fork": "saved by forking the process that holds the model",
    "replay": "restored by doing everything again from the start time",
    "none": "cannot be saved: only a fixed communication step is possible (--estimator none)",
}

_INPUTS = {
    "native": "yes",
    "emulated": "no: its steps are split into substeps",
    "none": "no",
}


def description_tables(description: SlaveDescription) -> list[Table]:
    """The model, its variables and its capabilities as tables.

    Names and hashes are whole at any width, as they are what a system file wants.
    """
    return [_model(description), _variables(description)]


def report_table(model: str, findings: Sequence[Finding]) -> Table:
    """The report of ``slave-node validate``."""
    table = Table(title=plain(model), title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("tried", "", "result", "so"):
        table.add_column(column, overflow="fold")
    for finding in findings:
        grade = plain(finding.grade, _STYLES[finding.grade])
        table.add_row(plain(finding.what), grade, plain(finding.result), plain(finding.consequence))
    return table


_STYLES = {Grade.OK: "green", Grade.NOTE: "yellow", Grade.PROBLEM: "bold red"}


def _model(description: SlaveDescription) -> Table:
    columns = (Column(overflow="fold"), Column(overflow="fold"))
    table = Table(*columns, title=plain(description.model), show_header=False, title_justify="left")
    can = description.capabilities
    rows = {
        "kind": description.kind,
        "generation tool": description.generation_tool,
        "guid": description.guid,
        "sha256": description.sha256,
        "state": _state(description),
        "state can be serialized": _yes(can.can_serialize_state),
        "interpolates inputs": _INPUTS[description.input_derivatives],
        "output derivatives up to order": str(can.max_output_derivative_order),
        "variable communication step size": _yes(can.can_handle_variable_step_size),
        "outputs follow inputs without a step": _yes(can.outputs_follow_inputs),
        "direct feed-through": "; ".join(
            f"{output} of {', '.join(inputs)}"
            for output, inputs in description.feed_through.items()
            if inputs
        )
        or "none",
    }
    if description.fixed_step_size is not None:
        rows["only communication step size [s]"] = str(description.fixed_step_size)
    if description.remarks:
        rows["remarks"] = "; ".join(description.remarks)
    for name, value in rows.items():
        table.add_row(name, plain(value or "-"))
    return table


def _state(description: SlaveDescription) -> str:
    reason = f" ({description.state_reason})" if description.state_reason else ""
    return _STATE[description.state_kind] + reason


def _variables(description: SlaveDescription) -> Table:
    """All that is said of each variable, in columns that leave room for its description."""
    table = Table(title="Variables", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("name", overflow="fold", min_width=8)
    table.add_column("kind", overflow="fold", min_width=9)
    for column in ("type", "unit"):
        table.add_column(column, overflow="fold")
    table.add_column("start", overflow="fold", justify="right")
    table.add_column("description", overflow="fold", min_width=12)
    for v in description.variables:
        about = [v.description, _values(v), "" if v.nominal == 1.0 else f"nominal {v.nominal}"]
        cells = (v.name, _kind(v), v.type.value, v.unit, _start(v))
        table.add_row(*map(plain, cells), lines(filter(None, about)))
    return table


def _kind(variable: Variable) -> str:
    """Causality, with the variability where it is not that of a signal."""
    is_usual = variable.variability == "continuous"
    return variable.causality.value if is_usual else f"{variable.variability} {variable.causality}"


def _start(variable: Variable) -> str:
    if variable.start is None:
        return ""
    return item_name(variable, variable.start) or str(variable.start)


def _values(variable: Variable) -> str:
    """Bounds of the model: the items of an enumeration with their numbers, or min and max."""
    if variable.items:
        return ", ".join(f"{name} = {number}" for name, number in variable.items.items())
    smallest, largest = variable.minimum, variable.maximum
    if smallest is not None and largest is not None:
        return f"{smallest} to {largest}"
    if smallest is not None:
        return f"from {smallest}"
    return "" if largest is None else f"up to {largest}"


def _yes(value: bool) -> str:
    return "yes" if value else "no"
