"""Processes that are killed, stopped or cut off at drawn points of a run, and the bits after it.

``python -m benchmarks fault_points --points 50``. Each point follows from its number. Ends with an
error if a run gave other bits than undisturbed, failed, or left a process: ``--first`` repeats it.
"""

import logging
import tempfile
from argparse import ArgumentParser
from collections import Counter
from pathlib import Path
from time import perf_counter

from benchmarks.quarter_car import EXAMPLE
from tests.faults.fault_points import NUMBER, router, run_point


def main(words: list[str]) -> None:
    """Run and print a table.

    Raises:
        SystemExit: the law of `tests.faults.fault_points` did not hold.
    """
    parser = ArgumentParser(prog="python -m benchmarks fault_points", description=__doc__)
    parser.add_argument("--points", type=int, default=NUMBER)
    parser.add_argument("--first", type=int, default=0, help="number of the first point")
    options = parser.parse_args(words)
    logging.disable(logging.CRITICAL)  # each run warns of what happens to it
    numbers = range(options.first, options.first + options.points)
    faults, broken, slowest = Counter[str](), [], 0.0
    with router() as shared:
        for number in numbers:
            begin = perf_counter()
            with tempfile.TemporaryDirectory() as folder:
                try:
                    point = run_point(number, EXAMPLE, Path(folder), shared)
                except Exception as error:  # a point must not end the others
                    notes = "; ".join(getattr(error, "__notes__", ()))
                    broken.append(f"{type(error).__name__}: {error}; {notes}")
                else:
                    faults[str(point.fault)] += 1
            slowest = max(slowest, perf_counter() - begin)
    print("\n### Fault points\n\n| fault | points, the same bits after it |\n|---|---|")
    for what, count in faults.items():
        print(f"| {what} | {count} |")
    print(f"| other bits, a failure, or a process that is left | {len(broken)} |")
    print(f"\nSlowest point: {slowest:.1f} s, starts of all processes included.")
    if broken:
        raise SystemExit("\n".join(broken))
