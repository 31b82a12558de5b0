"""Hostile messages against the codec and a slave: how many, how fast, how much memory.

``python -m benchmarks fuzz --messages 1000000 --seed 1``. Ends with an error at the first message
after which something did not hold, and says which one it was: ``--first`` repeats it.
"""

import ctypes
import faulthandler
import gc
import logging
from argparse import ArgumentParser
from collections import Counter
from time import perf_counter

import psutil

from tests.faults.fuzz.harness import fuzz

_CHUNK = 10_000
_HANG_TIME = 60.0
_SLOW = 2.0
_PEAK_MB = 200.0
_GROWTH_MB = 20.0


def main(words: list[str]) -> None:
    """Run and print a table.

    Raises:
        AssertionError: a law of `tests.faults.fuzz.harness` did not hold, or the bounds on time and
            memory were not kept: for one message, and from the first messages to the last.
    """
    parser = ArgumentParser(prog="python -m benchmarks fuzz", description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first message")
    options = parser.parse_args(words)
    logging.disable(logging.CRITICAL)  # the slave tells of every refused claim
    begin, outcomes, slowest = perf_counter(), Counter[str](), 0.0
    before, after_first = _peak_memory(), 0.0
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
        peak = _peak_memory() - before
        assert peak < _PEAK_MB, f"{peak:.0f} MB of memory at message {first + _CHUNK} or before"
        after_first = after_first or _memory()
        growth = _memory() - after_first
        assert growth < _GROWTH_MB, f"{growth:.0f} MB of memory kept after message {first + _CHUNK}"
    taken = perf_counter() - begin
    rows = {
        "messages": f"{options.messages}",
        "seed": f"{options.seed}",
        **{what: f"{count}" for what, count in sorted(outcomes.items())},
        "crashes, hangs": "0",
        "messages a second": f"{options.messages / taken:.0f}",
        "slowest message, processor time": f"{slowest * 1e3:.0f} ms",
        "resident memory at the start": f"{before:.0f} MB",
        "at its peak, in a message of 3 MB": f"{_peak_memory():.0f} MB",
        f"after {_CHUNK} messages": f"{after_first:.0f} MB",
        "at the end": f"{_memory():.0f} MB",
    }
    print("\n### Hostile messages\n\n| | |\n|---|---|")
    for name, value in rows.items():
        print(f"| {name} | {value} |")


def _memory() -> float:
    """Memory of this process, once the C library has given back what is free [MB]."""
    gc.collect()
    library = ctypes.CDLL(None)
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)
    return psutil.Process().memory_info().rss / 2.0**20


def _peak_memory() -> float:
    """Memory of this process [MB]."""
    import resource  # noqa: PLC0415  POSIX only, and this is the only benchmark that needs it

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
