"""Part 1: the paper's Table 1 and Figures 2 to 7, measured and written down."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import TypeVar

from benchmarks.reproduction import force_coupling, multistep_slaves, paper_pictures, table_1
from benchmarks.reproduction.local_error_study import VALUES_ONLY, figure, study
from benchmarks.reproduction.paper_text import Evidence, render
from benchmarks.reproduction.table_1 import LOOSE, MOD, PAPER, RICH, Measured, PaperRow
from master_node.numerics.extrapolation import POLYNOMIALS

Key = TypeVar("Key")
Value = TypeVar("Value")

_FILES = (table_1.FMUS, table_1.PYTHON, force_coupling.FMUS, force_coupling.PYTHON)


def write(directory: Path) -> None:
    """Measure everything and write ``paper.md`` with its pictures.

    Args:
        directory: existing; files of an earlier run are replaced.
    """
    evidence = _gather()
    with _told("pictures"):
        _draw(directory, evidence)
    (directory / "paper.md").write_text(render(evidence), encoding="utf-8")


def _gather() -> Evidence:
    with _told("Table 1 by FMUs"):
        fmus = {row: table_1.measure_row(row, table_1.FMUS) for row in PAPER}
    with _told("Table 1 by Python slaves"):
        python = {row: table_1.measure_row(row, table_1.PYTHON) for row in PAPER}
    with _told("Figure 6 by FMUs"):
        cases = [case for case in force_coupling.CASES if not case.is_long]
        force = {case: force_coupling.run(case, force_coupling.FMUS) for case in cases}

    with _told("what is run in process"), _pool() as pool:
        multistep = {
            row: pool.submit(multistep_slaves.summary, row) for row in multistep_slaves.ROWS
        }
        long = {
            case: pool.submit(force_coupling.run, case, force_coupling.FMUS)
            for case in force_coupling.CASES
            if case.is_long
        }
        force_python = {
            case: pool.submit(force_coupling.run, case, force_coupling.PYTHON) for case in cases
        }
        states = pool.submit(study, table_1.FMUS, POLYNOMIALS)
        feed_through = pool.submit(study, force_coupling.FMUS, VALUES_ONLY)
        local_errors = {file: pool.submit(figure, file) for file in _FILES}
        spreads = {row: pool.submit(table_1.spread, row) for row in table_1.controlled()}
        exact = {row: pool.submit(_with_exact_constants, row) for row in table_1.controlled()}
        return Evidence(
            fmus=fmus,
            python=python,
            exact=_results(exact),
            spreads=_results(spreads),
            multistep=_results(multistep),
            force=_results(long) | force,
            force_python=_results(force_python),
            local_errors=_results(local_errors),
            states=states.result(),
            feed_through=feed_through.result(),
        )


def _with_exact_constants(row: PaperRow) -> Measured:
    return table_1.measure_row(row, table_1.FMUS, in_process=True, constants="exact")


def _pool() -> ProcessPoolExecutor:
    """Two processes for what is not timed, started anew: threads do not survive a fork."""
    return ProcessPoolExecutor(2, mp_context=get_context("spawn"))


def _results(futures: Mapping[Key, Future[Value]]) -> dict[Key, Value]:
    return {key: future.result() for key, future in futures.items()}


def _draw(directory: Path, evidence: Evidence) -> None:
    local_errors = evidence.local_errors
    paper_pictures.local_errors(
        directory / "figure_2.png", local_errors[table_1.FMUS], "all outputs"
    )
    paper_pictures.local_errors(
        directory / "figure_3.png", local_errors[force_coupling.FMUS], "F [N]"
    )
    runs = _by_method(evidence.fmus)
    titles = [f"k = {order}" for order in (0, 1)]
    paper_pictures.steps(directory / "figure_4.png", [{"rich": runs[RICH, 0]}], ["k = 0"])
    paper_pictures.steps(
        directory / "figure_5.png",
        [{"rich": runs[RICH, order], "mod": runs[MOD, order]} for order in (0, 1)],
        titles,
    )
    for absolute, name in (
        (force_coupling.TO_THE_LETTER, "figure_6.png"),
        (force_coupling.IN_KILONEWTON, "figure_6_kilonewton.png"),
    ):
        columns: list[dict[str, Measured]] = [
            {
                case.estimator: run
                for case, run in evidence.force.items()
                if (case.absolute, case.order) == (absolute, order)
            }
            for order in force_coupling.ORDERS
        ]
        paper_pictures.steps(directory / name, columns, titles)
    paper_pictures.global_errors(
        directory / "figure_7.png",
        {order: {m: runs[m, order] for m in (LOOSE, RICH, MOD)} for order in (0, 1, 2)},
    )
    paper_pictures.quotients(directory / "constants.png", evidence.states)
    paper_pictures.quotients(directory / "constants_feed_through.png", evidence.feed_through)


def _by_method(runs: dict[PaperRow, Measured]) -> dict[tuple[str, int], Measured]:
    return {(row.method, row.order): run for row, run in runs.items()}


@contextmanager
def _told(what: str) -> Iterator[None]:
    """Say what is being done, and how long it took."""
    print(f"{what} ...", end=" ", flush=True)
    begin = perf_counter()
    yield
    print(f"{perf_counter() - begin:.0f} s", flush=True)
