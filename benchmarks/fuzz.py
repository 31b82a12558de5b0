"""Hostile messages against the codec and a slave: how many, how fast, how much memory.

``python -m benchmarks fuzz --messages 1000000 --seed 1``. Ends with an error at the first message
after which something did not hold, and says which one it was: ``--first`` repeats it.
"""

import faulthandler
import logging
from argparse import ArgumentParser
from collections import Counter
from time import perf_counter

from tests.fuzz.harness import fuzz

_CHUNK = 10_000
_HANG_TIME = 60.0
_SLOW = 5.0
_GROWTH_MB = 200.0


def main(words: list[str]) -> None:
    """Run and print a table.

    Raises:
        AssertionError: a law of `tests.fuzz.harness` did not hold, or the bounds on time and
            memory were not kept.
    """
    parser = ArgumentParser(prog="python -m benchmarks fuzz", description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first message")
    options = parser.parse_args(words)
    logging.disable(logging.CRITICAL)  # the slave tells of every refused claim
    begin, outcomes, slowest = perf_counter(), Counter[str](), 0.0
    before = _peak_memory()
    end = options.first + options.messages
    for first in range(options.first, end, _CHUNK):
        faulthandler.dump_traceback_later(_HANG_TIME, exit=True)
        findings = fuzz(options.seed, first, min(_CHUNK, end - first))
        faulthandler.cancel_dump_traceback_later()
        outcomes += findings.outcomes
        slowest = max(slowest, findings.slowest)
        assert findings.slowest < _SLOW, (
            f"message {findings.slowest_number} of seed {options.seed} took {findings.slowest:g} s"
        )
        growth = _peak_memory() - before
        assert growth < _GROWTH_MB, f"{growth:.0f} MB of memory after message {first + _CHUNK}"
    taken = perf_counter() - begin
    rows = {
        "messages": f"{options.messages}",
        "seed": f"{options.seed}",
        **{what: f"{count}" for what, count in sorted(outcomes.items())},
        "crashes, hangs": "0",
        "messages a second": f"{options.messages / taken:.0f}",
        "slowest message": f"{slowest * 1e3:.0f} ms",
        "peak resident memory": f"{_peak_memory():.0f} MB, {_peak_memory() - before:.0f} MB more "
        "than at the start",
    }
    print("\n### Hostile messages\n\n| | |\n|---|---|")
    for name, value in rows.items():
        print(f"| {name} | {value} |")


def _peak_memory() -> float:
    """Of this process [MB]."""
    import resource  # noqa: PLC0415  POSIX only, and this is the only benchmark that needs it

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
