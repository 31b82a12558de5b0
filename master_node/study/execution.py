"""Executes a study: what has not been run is run, and the table is filled."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from master_node.study.configuration import Study
from master_node.study.directory import TABLE_FILE, StudyDirectory
from master_node.study.plan import Plan, PlannedRun, make_plan
from master_node.study.progress import StudyProgress
from master_node.study.run_process import RunTask
from master_node.study.runner import Runner
from master_node.study.table import StudyTable

_POLL_TIME = 0.02
_WRITE_INTERVAL = 1.0

MakeRunner = Callable[[StudyDirectory], Runner]
"""Given the directory, which is held."""


@dataclass(frozen=True)
class StudyOutcome:
    """Number of runs, and of those that ended in each way.

    Attributes:
        runs: of the study.
        completed, failed: of these, whenever they were run.
        skipped: of the completed and failed ones, those that had been run before.
    """

    runs: int
    completed: int
    failed: int
    skipped: int


def run_study(
    study: Study,
    directory: Path,
    make_runner: MakeRunner,
    *,
    retry_failed: bool = False,
    replace: bool = False,
    progress: StudyProgress | None = None,
) -> StudyOutcome:
    """Execute the runs of a study that have not been executed, and write its table.

    Args:
        study: as it was read.
        directory: for the table and the runs.
        make_runner: gives who executes them.
        retry_failed: execute those again that have failed.
        replace: remove runs of another study from the directory.
        progress: is shown what happens.

    Raises:
        DoublestepError: the study is wrong, its directory cannot be used, or who executes runs is
            gone. A run that fails is no error: it is counted.
        KeyboardInterrupt: runs that had ended are kept, the others can be run again.
    """
    plan = make_plan(study)
    table = StudyTable(plan)
    progress = progress or StudyProgress(quiet=True)
    with ExitStack() as stack:
        held = stack.enter_context(StudyDirectory(directory))
        records = held.records(plan, replace=replace)
        if retry_failed:
            records = {number: r for number, r in records.items() if r.is_completed}
        for run in plan.runs:
            if run.number in records:
                table.add(run, records[run.number], held.directory_of(run))
        failed = sum(not record.is_completed for record in records.values())
        skipped = len(records)
        table_file = held.path / TABLE_FILE
        stack.callback(table.write, table_file)
        stack.enter_context(progress)
        progress.begin(len(plan.runs), skipped, failed)
        waiting = deque(run for run in plan.runs if run.number not in records)
        runs = {run.number: run for run in waiting}
        runner = stack.enter_context(make_runner(held)) if waiting else None
        under_way = 0
        next_write = monotonic() + _WRITE_INTERVAL
        while runner is not None and (waiting or under_way):
            while waiting and runner.has_room:
                runner.start(_task(plan, waiting.popleft(), held))
                under_way += 1
            for task, record in runner.ended():
                under_way -= 1
                failed += not record.is_completed
                run = runs[task.number]
                table.add(run, record, held.directory_of(run))
                progress.ended(run.number, record)
            progress.update(under_way)
            if monotonic() >= next_write:
                table.write(table_file)
                next_write = monotonic() + _WRITE_INTERVAL
            time.sleep(_POLL_TIME)
    return StudyOutcome(len(plan.runs), len(plan.runs) - failed, failed, skipped)


def _task(plan: Plan, run: PlannedRun, directory: StudyDirectory) -> RunTask:
    settings = plan.study.run
    return RunTask(
        number=run.number,
        system_file=str(plan.study.system_file.absolute()),
        directory=str(directory.directory_of(run)),
        case=dict(run.case),
        fingerprint=run.fingerprint,
        in_process=settings.in_process,
        plot=settings.plot,
        timeout=float(settings.timeout),
    )
