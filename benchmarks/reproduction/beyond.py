"""Writes ``beyond.md``: what there is beyond the paper's method, measured section by section."""

from __future__ import annotations

from pathlib import Path

from benchmarks.reproduction import (
    beyond_controllers,
    beyond_default,
    beyond_dense_output,
    beyond_feed_through,
    beyond_first_step,
    beyond_jumps,
    beyond_order,
    beyond_sequence,
    beyond_tolerance,
    beyond_work_precision,
)
from benchmarks.reproduction.beyond_text import commands, paragraphs

FILE = "beyond.md"


def write(directory: Path) -> None:
    """Make all runs; write ``beyond.md`` and its pictures into ``directory``."""
    directory.mkdir(parents=True, exist_ok=True)
    text = paragraphs(
        _introduction(),
        beyond_default.section(),
        beyond_order.section(),
        beyond_work_precision.section(directory),
        beyond_tolerance.section(),
        beyond_controllers.section(),
        beyond_jumps.section(),
        beyond_feed_through.section(),
        beyond_sequence.section(),
        beyond_dense_output.section(),
        beyond_first_step.section(),
    )
    (directory / FILE).write_text(text + "\n", encoding="utf-8")


def _introduction() -> str:
    return paragraphs(
        "# Beyond the paper",
        "What Doublestep adds to the method of Schierz, Arnold and Clauß, measured. This page, its "
        "tables and its pictures are written by",
        commands("make fmus", "python -m benchmarks.reproduction beyond"),
        "and the commands in each section repeat one row of its tables. All runs are in process, "
        "with the FMUs of [examples/](../../examples/README.md), and with the settings of the "
        "system files but for what a table says. Over Zenoh the results are the same bit for bit.",
        "*Steps* are accepted communication steps, *rejections* are rejected double steps, "
        "*do_steps* are those of each slave, repeated ones and comparison solutions included, and "
        "*tolerance* is both RTOL and ATOL. The *error* at a communication point is the Euclidean "
        "norm of what all outputs are off from the exact solution, its mean is over all "
        "communication points.",
    )
