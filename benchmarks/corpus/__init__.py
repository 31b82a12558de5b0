"""All FMUs of a folder, tried one by one: ``python -m benchmarks corpus FOLDER``.

Each is validated, run alone with a fixed communication step size and compared with FMPy's own
loop bit for bit, run alone with the defaults, and coupled with a lag with the defaults. Each trial
has processes of its own, bounded in time and memory. Records are kept in a folder, so that a run
that was interrupted goes on where it was. Ends with an error where something did not hold.
"""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.corpus.models import CorpusModel, distinct_models
from benchmarks.corpus.table import COLUMNS, by_tool, coupling_reasons, faults, reasons
from benchmarks.corpus.trials import Bounds, try_model

_GIB = 2.0**30


def main(words: list[str]) -> None:
    """Try all models and print the tables."""
    parser = ArgumentParser(prog="python -m benchmarks corpus", description=__doc__)
    parser.add_argument("folder", type=Path, help="with FMU files and FMU folders, at any depth")
    parser.add_argument(
        "--records", type=Path, default=Path("corpus_records"), help="folder for what was found"
    )
    parser.add_argument("--seconds", type=float, default=300.0, help="bound on each trial [s]")
    parser.add_argument("--memory", type=float, default=4.0, help="bound on each trial [GiB]")
    parser.add_argument("--steps", type=int, default=100, help="most communication steps of a run")
    parser.add_argument("--only", default="", help="models whose path contains this text")
    parser.add_argument("--again", action="store_true", help="try again what has a record")
    parser.add_argument("--known", action="store_true", help="try nothing: print what has a record")
    parser.add_argument("--json", action="store_true", help="print all records, not the tables")
    options = parser.parse_args(words)
    if not options.folder.is_dir():
        parser.error(f"{options.folder} is not a folder")
    models = [m for m in distinct_models(options.folder) if options.only in str(m.path)]
    models.sort(key=lambda model: not model.has_binary)  # the others are soon done
    if options.known:
        models = [model for model in models if _file(options.records, model).is_file()]
    bounds = Bounds(options.seconds, options.memory * _GIB, options.steps)
    records = _records(models, options.records, bounds, again=options.again)
    if options.json:
        print(json.dumps(records, indent=1))
    else:
        _print_tables(records)
    found = list(faults(records))
    if found:
        sys.exit("\n".join(found))


def _records(
    models: Iterable[CorpusModel], folder: Path, bounds: Bounds, *, again: bool
) -> list[dict[str, Any]]:
    """The record of each model, from its file or by trying it."""
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    models = list(models)
    for number, model in enumerate(models, 1):
        file = _file(folder, model)
        if again or not file.is_file():
            print(f"{number}/{len(models)} {model.path.name}", file=sys.stderr, flush=True)
            record = try_model(model, bounds)
            part = file.with_suffix(".part")
            part.write_text(json.dumps(record, indent=1), encoding="utf-8")
            part.replace(file)
        records.append(json.loads(file.read_text(encoding="utf-8")))
    return records


def _file(folder: Path, model: CorpusModel) -> Path:
    return folder / f"{model.sha256[:16]}.json"


def _print_tables(records: list[dict[str, Any]]) -> None:
    without = sum(not record["has_binary"] for record in records)
    print(f"\n### FMUs of other tools\n\n{len(records)} distinct FMUs, {without} of them without a")
    print("binary for 64-bit Linux.\n")
    _print_table(COLUMNS, by_tool(records))
    print()
    _print_table(("refused because", "FMUs", "that FMPy runs"), reasons(records))
    print()
    _print_table(("refused in the coupling because", "FMUs"), coupling_reasons(records))


def _print_table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    columns = tuple(columns)
    print(f"| {' | '.join(columns)} |")
    print("|" + "---|" * len(columns))
    for row in rows:
        print(f"| {' | '.join(cell.replace('|', '/') for cell in row)} |")
