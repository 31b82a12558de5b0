"""Digests of results: ``python -m benchmarks digests --seeds 300 > before.txt``.

Prints the SHA-256 digest of the results and steps of each example, and of systems that seeds
draw, all of them run in process. Two versions of the program that print the same lines give the
same bits.
"""

from __future__ import annotations

import hashlib
import logging
import tempfile
import warnings
from argparse import ArgumentParser
from collections.abc import Iterator
from pathlib import Path
from random import Random

import tomli_w

from master_node import System, load_system, simulate
from protocol.errors import DoublestepError
from tests.faults.nemesis.systems import EXAMPLES, draw_system

_DIGESTED = ("results.csv", "steps.csv")
_ATTEMPTS = 2000


class _Limit:
    """Observer that ends a run after `_ATTEMPTS` double steps."""

    def __init__(self) -> None:
        self._left = _ATTEMPTS

    def started(self, _: object) -> None:
        """See `Observer`."""

    def attempted(self, _: object) -> None:
        """See `Observer`."""
        self._left -= 1
        if not self._left:
            raise DoublestepError("enough steps")

    def ended(self, _: object) -> None:
        """See `Observer`."""


def main(words: list[str]) -> None:
    """Run all systems and print a line for each."""
    parser = ArgumentParser(prog="python -m benchmarks digests", description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args(words)
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as name:
        for number, (title, file) in enumerate(_systems(options.seeds, Path(name))):
            print(_digest(file, Path(name) / f"out{number}"), title, flush=True)


def _systems(seeds: int, folder: Path) -> Iterator[tuple[str, Path]]:
    """Name and file of each system."""
    for file in sorted(EXAMPLES.rglob("*.toml")):
        if "[slaves" in file.read_text(encoding="utf-8"):
            yield str(file.relative_to(EXAMPLES)), file
    for seed in range(seeds):
        drawn = draw_system(Random(seed), EXAMPLES)
        tables = {**drawn.tables, "results": {**drawn.tables["results"], "formats": ["csv"]}}
        file = folder / f"seed{seed}.toml"
        file.write_text(tomli_w.dumps(tables), encoding="utf-8")
        yield f"seed {seed}", file


def _digest(file: Path, out: Path) -> str:
    """Digest of what a system's run writes, or the error that ends it."""
    try:
        system: System = load_system(file)
        simulate(system, output=out, in_process=True, observers=(_Limit(),))
        outcome = "completed"
    except DoublestepError as error:
        outcome = type(error).__name__
    digest = hashlib.sha256()
    for name in _DIGESTED:
        path = out / name
        digest.update(path.read_bytes() if path.exists() else b"")
    return f"{digest.hexdigest()[:32]} {outcome}"
