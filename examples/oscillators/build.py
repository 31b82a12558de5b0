"""Build the FMUs of the oscillators with the platform's C compiler.

    python examples/oscillators/build.py [--output DIR] [--force]

How they are built stands in ``../fmu_framework/build_fmus.py``.
"""

from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path.append(str(FOLDER.parent))  # the examples are no package that could be installed

from fmu_framework.build_fmus import BuildError, build_fmus, main  # noqa: E402  needs the line above

__all__ = ["MODELS", "BuildError", "build"]

MODELS = ("mass", "van_der_pol", "step_source")


def build(output: Path, *, force: bool = False) -> list[Path]:
    """Build what is missing or older than its sources into the folder ``output``.

    Returns the paths of all FMUs, in the order of ``MODELS``. See `build_fmus`.
    """
    return build_fmus([FOLDER / "src" / model for model in MODELS], output, force=force)


if __name__ == "__main__":
    sys.exit(main(build, "Build the FMUs of the oscillators.", FOLDER))
