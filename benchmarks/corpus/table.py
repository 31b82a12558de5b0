"""The records of all models as tables: by tool, and the refusals by reason."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from benchmarks.corpus.trials import End

Record = Mapping[str, Any]

_UNBOUNDED = (End.TRACEBACK, End.CRASH, End.HANG, End.MEMORY, End.LEFT_PROCESSES)
_RUNS = ("fixed", "alone", "coupled")

COLUMNS = (
    "tool",
    "FMUs",
    "run alone",
    "run coupled",
    "refused",
    "refused, but FMPy runs it",
    "traceback, crash, hang",
    "too slow",
    "compared with FMPy",
    "of them equal",
)


def by_tool(records: Sequence[Record]) -> Iterator[tuple[str, ...]]:
    """Rows of `COLUMNS`: one for each tool, the one with the most models first, and the sum."""
    tried = [record for record in records if record["has_binary"]]
    tools = Counter(record["tool"] for record in tried)
    for tool, _ in sorted(tools.items(), key=lambda item: (-item[1], item[0])):
        yield _row(tool, [record for record in tried if record["tool"] == tool])
    yield _row("all", tried)


def coupling_reasons(records: Iterable[Record]) -> Iterator[tuple[str, ...]]:
    """Rows: why models that run alone are refused in the small coupling, and how many."""
    refused = [r for r in records if r.get("coupled", {}).get("end") == End.REFUSED]
    counted = Counter(general(record["coupled"]["reason"]) for record in refused)
    for reason, number in counted.most_common():
        yield reason, str(number)


def reasons(records: Iterable[Record]) -> Iterator[tuple[str, ...]]:
    """Rows: why models are refused, how many of them, and how many of those FMPy runs."""
    counted: Counter[str] = Counter()
    run_by_fmpy: Counter[str] = Counter()
    for record in records:
        if record["has_binary"] and is_refused(record):
            reason = general(record["alone"]["reason"])
            counted[reason] += 1
            run_by_fmpy[reason] += record["fmpy"]["end"] == End.DONE
    for reason, number in counted.most_common():
        yield reason, str(number), str(run_by_fmpy[reason])


def faults(records: Iterable[Record]) -> Iterator[str]:
    """A sentence for each end of a trial that none should have, and for each difference."""
    for record in records:
        for trial in ("validate", *_RUNS):
            end = record.get(trial, {}).get("end")
            if end in _UNBOUNDED:
                yield f"{record['file']}: {trial}: {end}: {record[trial]['reason']}"
        if is_refused(record) and record["fmpy"]["end"] == End.DONE:
            yield f"{record['file']}: refused, but FMPy runs it: {record['alone']['reason']}"
        runs = record.get("alone", {}).get("end") == End.DONE
        if runs and record["validate"]["end"] == End.REFUSED:
            yield f"{record['file']}: validate refuses what runs: {record['validate']['reason']}"
        difference = (record.get("comparison") or {}).get("difference")
        if difference:
            yield f"{record['file']}: differs from FMPy: {difference}"


def is_refused(record: Record) -> bool:
    """True if the model does not run alone with the defaults, for a reason that was told."""
    return record.get("alone", {}).get("end") == End.REFUSED


def general(reason: str) -> str:
    """A reason without what is special to one model: paths, names in quotes and numbers."""
    reason = re.sub(r"^\S+: (?:model: )?", "", reason)
    reason = re.sub(r"/\S+?\.fmu: ", "", reason)
    reason = re.sub(r"(?:/[^\s/:]+)+", "PATH", reason)
    return re.sub(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?", "N", reason)[:160]


def _row(tool: str, records: Sequence[Record]) -> tuple[str, ...]:
    def ended(trial: str, *ends: End) -> int:
        return sum(record[trial]["end"] in ends for record in records)

    refused = [record for record in records if is_refused(record)]
    compared = [record for record in records if record["comparison"] is not None]
    numbers = (
        len(records),
        ended("alone", End.DONE),
        ended("coupled", End.DONE),
        len(refused),
        sum(record["fmpy"]["end"] == End.DONE for record in refused),
        sum(
            any(record[trial]["end"] in _UNBOUNDED for trial in ("validate", *_RUNS))
            for record in records
        ),
        sum(any(record[trial]["end"] == End.SLOW for trial in _RUNS) for record in records),
        len(compared),
        sum(not record["comparison"]["difference"] for record in compared),
    )
    return (tool, *map(str, numbers))
