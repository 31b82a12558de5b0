"""Writes the pages of the parts that are asked for, or of all."""

import argparse
import importlib
from pathlib import Path

PARTS = ("paper", "beyond", "stiff")
DOCUMENTS = Path(__file__).parents[2] / "docs" / "reproduction"


def main() -> None:
    """Run the parts one after the other."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reproduction", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--output", type=Path, default=DOCUMENTS, help="where the pages go")
    arguments = parser.parse_args()
    unknown = set(arguments.parts) - set(PARTS)
    if unknown:
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    arguments.output.mkdir(parents=True, exist_ok=True)
    for part in arguments.parts or PARTS:
        importlib.import_module(f"benchmarks.reproduction.{part}").write(arguments.output)


if __name__ == "__main__":
    main()
