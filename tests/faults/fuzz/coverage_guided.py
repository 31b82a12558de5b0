"""Coverage-guided fuzzing with Atheris, beside the mutator that knows the messages.

Atheris is needed for this file only: ``pip install 'doublestep[fuzz]'``, where there is a wheel or
a Clang with libFuzzer for it. ``python -m benchmarks coverage_guided`` runs both; one alone::

    python tests/faults/fuzz/coverage_guided.py codec corpus -runs=1000000
    python tests/faults/fuzz/coverage_guided.py service corpus -max_total_time=600

The corpus is a directory; valid messages are put there to begin with. It goes on until its runs or
its time are up, or until a law of `tests.faults.fuzz.harness` does not hold; the message is then
in a file ``crash-*`` here, and the file's name in place of the corpus repeats it. All options of
libFuzzer can be given.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3]))

import atheris

with atheris.instrument_imports(include=["protocol", "slave_node"]):
    from tests.faults.fuzz.harness import Service, decode
    from tests.faults.fuzz.messages import KINDS, Kind

_CHECK_EVERY = 500


def split(data: bytes) -> tuple[Kind, int, bytes]:
    """The first byte says which kind of message the rest is meant to be, and for whom."""
    return KINDS[data[0] % len(KINDS)], data[0] // len(KINDS), data[1:]


def fuzz_codec(data: bytes) -> None:
    """Give it to a decoder."""
    if data:
        decode(*split(data))


def fuzz_service(service: Service) -> Callable[[bytes], None]:
    """Gives messages to a slave, and looks after it now and then as its master."""
    heard = 0

    def hear(data: bytes) -> None:
        nonlocal heard
        if data:
            service.hear(*split(data))
        heard += 1
        if heard % _CHECK_EVERY == 0:
            service.check()

    return hear


def write_corpus(directory: Path) -> None:
    """Put the valid messages where libFuzzer finds them."""
    directory.mkdir(parents=True, exist_ok=True)
    for i, kind in enumerate(KINDS):
        for j, example in enumerate(kind.examples):
            (directory / f"{kind.name}-{j}").write_bytes(bytes([i + len(KINDS) * j]) + example)


def main(target: str, corpus: str, *options: str) -> None:
    """Fuzz ``codec`` or ``service``; does not return, as libFuzzer ends the process."""
    logging.disable(logging.CRITICAL)  # the slave tells of every refused claim
    if not Path(corpus).is_file():
        write_corpus(Path(corpus))
    words = [sys.argv[0], corpus, *options]
    if target == "codec":
        atheris.Setup(words, fuzz_codec)
        atheris.Fuzz()
    else:
        with Service() as service:
            atheris.Setup(words, fuzz_service(service))
            atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
