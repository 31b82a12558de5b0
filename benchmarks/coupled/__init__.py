"""Coupled systems of real FMUs with the defaults: ``python -m benchmarks coupled FOLDER``.

Each system whose FMUs are in the folder is run with the defaults, and compared with a run with
fixed steps that has converged, and with the cheapest one of equal error. Each system has a process
of its own, bounded in time and memory. Ends with an error where a run is completed, and wrong by
more than a hundred tolerances, without a warning.
"""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.bounded import run_bounded
from benchmarks.corpus.models import distinct_models
from benchmarks.coupled.systems import SYSTEMS

_ROOT = Path(__file__).parents[2]
_GIB = 2.0**30
_SHARE_OF_TIME = 0.7
_WRONG = 100.0

COLUMNS = (
    "system",
    "tools",
    "outcome",
    "error / tolerance",
    "warnings",
    "do_steps",
    "best fixed steps of equal error",
    "ratio",
)

Record = Mapping[str, Any]


def main(words: list[str]) -> None:
    """Measure all systems and print the table."""
    parser = ArgumentParser(prog="python -m benchmarks coupled", description=__doc__)
    parser.add_argument("folder", type=Path, help="with FMU files, at any depth")
    parser.add_argument("--seconds", type=float, default=300.0, help="bound on each system [s]")
    parser.add_argument("--memory", type=float, default=4.0, help="bound on each system [GiB]")
    parser.add_argument("--only", default="", help="systems whose name contains this text")
    parser.add_argument("--json", action="store_true", help="print all that was found")
    options = parser.parse_args(words)
    if not options.folder.is_dir():
        parser.error(f"{options.folder} is not a folder")
    fmus = {model.sha256[:8]: model for model in distinct_models(options.folder)}
    names = [name for name in SYSTEMS if options.only in name]
    records: list[Record] = []
    for name in names:
        print(name, file=sys.stderr, flush=True)
        found = {k: fmus[s.sha256] for k, s in SYSTEMS[name].slaves.items() if s.sha256 in fmus}
        missing = [s.file for k, s in SYSTEMS[name].slaves.items() if k not in found]
        if missing:
            records.append({"name": name, "outcome": "skipped", "message": _lacks(name, missing)})
            continue
        paths = {slave: str(model.path.resolve()) for slave, model in found.items()}
        measured = _measure(name, paths, options.seconds, options.memory * _GIB)
        tools = sorted({model.tool for model in found.values()})
        records.append({"name": name, "tools": tools} | measured)
    print(json.dumps(records, indent=1) if options.json else "\n".join(_table(records)))
    wrong = list(faults(records))
    if wrong:
        sys.exit("\n".join(wrong))


def faults(records: Iterable[Record]) -> Iterator[str]:
    """A sentence for each run that ended as none should: wrong without a warning, or not at all."""
    for record in records:
        error, name = record.get("error"), record["name"]
        if record["outcome"] == "broken off":
            yield f"{name}: {record['message']}"
        elif error is not None and error > _WRONG and not record["warnings"]:
            yield f"{name}: completed, but {record['where']} is off by {error:.3g} tolerances"


def row(record: Record) -> tuple[str, ...]:
    """Cells of `COLUMNS`."""
    name, outcome = record["name"], record["outcome"]
    if outcome in ("skipped", "broken off"):
        return (
            name,
            ", ".join(record.get("tools", ())),
            f"{outcome}: {record['message']}",
            *[""] * 5,
        )
    fixed = record["fixed_do_steps"]
    cost = f"{fixed} (order {record['fixed_order']})" if fixed else "none found"
    ratio = f"{record['do_steps'] / fixed:.2g}" if fixed else ""
    error = record["error"]
    if error is not None:
        told = f"{error:.2g} ({record['where']})"
    elif record["reference_change"] is not None:
        told = f"the reference still changes by {record['reference_change']:.2g}"
    else:
        told = f"no reference: {record['problem']}"
    if outcome == "refused":
        outcome, told, cost = f"refused: {record['message']}", "", ""
    counts = (str(len(record["warnings"])), str(record["do_steps"]))
    return name, ", ".join(record["tools"]), outcome, told, *counts, cost, ratio


def _table(records: Sequence[Record]) -> Iterator[str]:
    yield f"| {' | '.join(COLUMNS)} |"
    yield "|" + "---|" * len(COLUMNS)
    for record in records:
        cells = (" ".join(cell.replace("|", "/").split()) for cell in row(record))
        yield f"| {' | '.join(cells)} |"
    for record in records:
        for warning in record.get("warnings", ()):
            yield f"\n{record['name']}: {warning}"


def _lacks(name: str, files: Sequence[str]) -> str:
    return f"the folder lacks {', '.join(files)} of {SYSTEMS[name].repository}"


def _measure(name: str, fmus: Mapping[str, str], seconds: float, memory: float) -> Record:
    """In a process of its own."""
    with TemporaryDirectory(prefix="coupled-") as scratch:
        file = Path(scratch) / "measured.json"
        outcome = run_bounded(
            [
                sys.executable,
                *("-m", "benchmarks.coupled.measurement", name, str(file)),
                *(f"{slave}={path}" for slave, path in fmus.items()),
                f"--seconds={_SHARE_OF_TIME * seconds:g}",
            ],
            Path(scratch),
            {"PYTHONPATH": str(_ROOT)},
            seconds,
            memory,
        )
        if file.is_file():
            return dict(json.loads(file.read_text(encoding="utf-8")))
    last = (outcome.stderr.strip().splitlines() or [f"exit code {outcome.exit_code}"])[-1]
    why = f"more {outcome.bound} than it may take" if outcome.bound else last
    return {"outcome": "broken off", "message": why}
