"""Systems and faults that seeds draw, with real processes, and the same files after it all.

``python -m benchmarks nemesis --seeds 100``. Prints the seeds for which a law of
`tests.faults.nemesis.seeds` did not hold, and ends with an error then; ``--first`` repeats one.
"""

import logging
import shutil
import tempfile
import warnings
from argparse import ArgumentParser
from collections import Counter
from pathlib import Path
from time import monotonic

from tests.faults.fault_points import router
from tests.faults.nemesis.seeds import run_seed
from tests.faults.nemesis.systems import EXAMPLES


def main(words: list[str]) -> None:
    """Run and print a table.

    Raises:
        SystemExit: a law did not hold.
    """
    parser = ArgumentParser(prog="python -m benchmarks nemesis", description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--time", type=float, default=float("inf"), help="begin no seed later [s]")
    parser.add_argument("--keep", type=Path, help="folder for all files of seeds that differ")
    options = parser.parse_args(words)
    logging.disable(logging.CRITICAL)  # each run warns of what happens to it
    warnings.simplefilter("ignore")
    faults, ways, codes, broken = Counter[str](), Counter[str](), Counter[int](), 0
    begin, done = monotonic(), 0
    with router() as shared:
        for seed in range(options.first, options.first + options.seeds):
            if monotonic() > begin + options.time:
                break
            with tempfile.TemporaryDirectory(prefix=f"seed-{seed}-") as name:
                done += 1
                try:
                    outcome = run_seed(seed, EXAMPLES, Path(name), shared.endpoint)
                except Exception as error:  # a seed must not end the others
                    broken += 1
                    print(f"{type(error).__name__}: {error}")
                    print(*getattr(error, "__notes__", ()), sep="\n", end="\n\n", flush=True)
                    if options.keep:
                        shutil.copytree(name, options.keep / str(seed), symlinks=True)
                    continue
            ways[outcome.system.way] += 1
            codes.update(code for code in outcome.codes if code)
            faults.update(f"{f.kind} {f.part}" for f, found in outcome.faults if found)
    print("\n### Nemesis\n\n| fault | times, the same files after it |\n|---|---|")
    for what, count in sorted(faults.items()):
        print(f"| {what} | {count} |")
    print(f"\n{done} seeds in {monotonic() - begin:.0f} s, {broken} broke a law.")
    print("How slaves were run:", ", ".join(f"{n} {way}" for way, n in ways.most_common()) + ".")
    print("Ends before the last one:", ", ".join(f"{n} by exit code {c}" for c, n in codes.items()))
    if broken:
        raise SystemExit(1)
