"""Whole runs over a bus on which messages get lost, late, doubled and out of order.

``python -m benchmarks fault_schedules --schedules 10000``. Each schedule follows from its number.
Ends with an error if a run gave other bits than undisturbed, did not end within its bound, or left
a slave that another master cannot use; ``python -m tests.faults.fault_schedules N`` repeats number
N.
"""

import logging
from argparse import ArgumentParser
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from time import perf_counter

from tests.faults.fault_schedules import Outcome, run_schedule

_CHUNK = 50


def main(words: list[str]) -> None:
    """Run and print a table.

    Raises:
        SystemExit: a law of `tests.faults.fault_schedules` did not hold.
    """
    parser = ArgumentParser(prog="python -m benchmarks fault_schedules", description=__doc__)
    parser.add_argument("--schedules", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first schedule")
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args(words)
    begin = perf_counter()
    seeds = range(options.first, options.first + options.schedules)
    with ProcessPoolExecutor(options.processes, get_context("spawn")) as pool:
        outcomes = list(pool.map(_outcome, seeds, chunksize=_CHUNK))
    taken = perf_counter() - begin
    runs = [outcome for outcome in outcomes if isinstance(outcome, Outcome)]
    broken = [outcome for outcome in outcomes if isinstance(outcome, str)]
    print("\n### Fault schedules\n\n| outcome | schedules |\n|---|---|")
    for what, count in Counter(run.what for run in runs).most_common():
        print(f"| {what} | {count} |")
    print(f"| silent difference, no end, or a slave that is lost for others | {len(broken)} |")
    longest = max((run.longest_request for run in runs), default=0.0)
    print(f"\nLongest request: {longest:.1f} s of virtual time. ", end="")
    print(f"{len(seeds) / taken * 60.0:.0f} schedules a minute.")
    if broken:
        raise SystemExit("\n".join(broken[:20]))


def _outcome(seed: int) -> Outcome | str:
    logging.disable(logging.CRITICAL)
    try:
        return run_schedule(seed)
    except Exception as error:  # a schedule must not end the others
        notes = "; ".join(getattr(error, "__notes__", ()))
        return f"{type(error).__name__}: {error}; {notes}"
