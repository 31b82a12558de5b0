"""Coverage-guided fuzzing of the codec with Atheris, beside the mutator that knows the messages.

Atheris is needed for this file only and no dependency::

    pip install atheris
    python tests/fuzz/fuzz_codec.py --corpus corpus        # writes valid messages to begin with
    python tests/fuzz/fuzz_codec.py corpus -max_total_time=600

It goes on until time is up, or until a message makes a decoder raise what it must not raise; that
message is then in a file ``crash-*`` here, and the file's name as the only argument repeats it.
All options of libFuzzer can be given.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import atheris

with atheris.instrument_imports(include=["protocol"]):
    from tests.fuzz.harness import decode
    from tests.fuzz.messages import KINDS


def test_one_input(data: bytes) -> None:
    """The first byte says which decoder gets the rest."""
    if data:
        decode(KINDS[data[0] % len(KINDS)], data[0] // len(KINDS), data[1:])


def write_corpus(directory: Path) -> None:
    """Put the valid messages where libFuzzer finds them."""
    directory.mkdir(parents=True, exist_ok=True)
    for i, kind in enumerate(KINDS):
        for j, example in enumerate(kind.examples):
            (directory / f"{kind.name}-{j}").write_bytes(bytes([i + len(KINDS) * j]) + example)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--corpus"]:
        write_corpus(Path(sys.argv[2]))
    else:
        atheris.Setup(sys.argv, test_one_input)
        atheris.Fuzz()
