"""The table of results of a study: a row for each run."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from master_node.numerics.reductions import REDUCTIONS
from master_node.results import Result
from master_node.results.files import replacing
from master_node.study.configuration import ReducedOutput
from master_node.study.directory import run_name
from master_node.study.plan import Plan, PlannedRun
from master_node.study.records import RunRecord
from master_node.system.fields import Scalar
from protocol.errors import ConfigurationError, ResultsError

Cell = Scalar | None

PENDING = "pending"
_COUNTERS = ("communication_steps", "rejected_double_steps", "do_steps")
_COLUMNS = ("outcome", "exit_code", *_COUNTERS, "wall_time")


class StudyTable:
    """Grows run by run; `write` replaces the file as a whole.

    The columns are ``run``, the parameters, ``outcome``, ``exit_code``, ``communication_steps``,
    ``rejected_double_steps``, ``do_steps`` of all slaves, ``wall_time`` [s], the reduced outputs,
    and ``message``. A cell without a value is empty.

    Args:
        plan: says what the rows and columns are.

    Raises:
        ConfigurationError: two columns would have the same name.
    """

    def __init__(self, plan: Plan) -> None:
        self._outputs = plan.study.results.outputs
        self.columns = ("run", *plan.parameters, *_COLUMNS, *self._outputs, "message")
        for name in self._outputs:
            if self.columns.count(name) > 1:
                raise ConfigurationError(
                    f"{plan.study.source}: [results.outputs] {name}: a column of the table has "
                    "this name already"
                )
        self._rows = {run.number: self._row(run, {"outcome": PENDING}) for run in plan.runs}

    def add(self, run: PlannedRun, record: RunRecord, directory: Path) -> None:
        """Fill in the row of a run that has ended.

        Args:
            run: which.
            record: what became of it.
            directory: where its results are.

        Raises:
            ResultsError: its results cannot be read.
        """
        cells: dict[str, Cell] = {
            "outcome": record.outcome,
            "exit_code": record.exit_code,
            "wall_time": record.wall_time,
            "message": record.message.replace("\n", " "),
        }
        if record.is_completed:
            result = Result.load(directory)
            cells |= _counters(result.summary, directory)
            cells |= {name: _reduced(result, o, directory) for name, o in self._outputs.items()}
        self._rows[run.number] = self._row(run, cells)

    def write(self, path: Path) -> None:
        """Write the table.

        Raises:
            ResultsError: it cannot be written.
        """
        text = io.StringIO(newline="")
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(self.columns)
        rows.writerows(self._rows.values())
        try:
            with replacing(path) as file:
                file.write(text.getvalue().encode(errors="replace"))
        except OSError as error:
            raise ResultsError(f"cannot write {path}: {error.strerror or error}") from error

    def _row(self, run: PlannedRun, cells: Mapping[str, Cell]) -> list[str]:
        all_cells = {"run": run_name(run.number), **run.case, **cells}
        return [_text(all_cells.get(column)) for column in self.columns]


def _counters(summary: Mapping[str, Any], directory: Path) -> dict[str, Cell]:
    try:
        steps, rejected = (int(summary[name]) for name in _COUNTERS[:2])
        do_steps = sum(map(int, summary["do_steps"].values()))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ResultsError(f"{directory}: its summary lacks {error}") from error
    return dict(zip(_COUNTERS, (steps, rejected, do_steps), strict=True))


def _reduced(result: Result, output: ReducedOutput, directory: Path) -> float:
    try:
        values = result[output.variable].astype(float)
    except KeyError as error:
        raise ResultsError(f"{directory}: {error.args[0]}") from None
    if not len(values):
        raise ResultsError(f"{directory}: there is no result")
    return REDUCTIONS[output.reduce](result.time, values)


def _text(cell: Cell) -> str:
    """Numbers as ``repr``, so that they read back to the same bits; booleans as TOML has them."""
    if cell is None:
        return ""
    return json.dumps(cell) if isinstance(cell, bool) else str(cell)
