"""Build the FMUs with which the tests drive every capability that FMI knows.

    python examples/capabilities/build.py [--output DIR] [--force]

What each of them is for stands in ``README.md``, how they are built in
``../fmu_framework/build_fmus.py``.
"""

from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path.append(str(FOLDER.parent))  # the examples are no package that could be installed

from capabilities.catalogue import FMUS  # noqa: E402  needs the line above
from fmu_framework import build_fmus  # noqa: E402
from fmu_framework.build_fmus import BuildError, main  # noqa: E402

__all__ = ["FMUS", "BuildError", "build"]


def build(output: Path, *, force: bool = False) -> list[Path]:
    """Build what is missing or older than its sources into the folder ``output``.

    Returns the paths of all FMUs, in the order of ``FMUS``. See `build_fmus.build`.
    """
    return build_fmus.build(FMUS, output, force=force)


if __name__ == "__main__":
    sys.exit(main(build, "Build the FMUs of all capabilities.", FOLDER))
