"""Build the FMUs of the quarter car and pack them with a system structure description.

python examples/ssp/build.py [--output DIR] [--force]
"""

from __future__ import annotations

import sys
import tempfile
import zipfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path.append(str(FOLDER.parent))  # the examples are no package that could be installed

from fmu_framework.build_fmus import BuildError, build_fmus, main  # noqa: E402  needs the line above

__all__ = ["FILES", "MODELS", "BuildError", "build"]

MODELS = ("chassis", "wheel")
FILES = ("SystemStructure.ssd", "resources/road.ssv", "resources/road.ssm")


def build(output: Path, *, force: bool = False) -> list[Path]:
    """Write ``quarter_car.ssp`` into the folder ``output``; gives its path. See `build_fmus`."""
    output.mkdir(parents=True, exist_ok=True)
    package = output / "quarter_car.ssp"
    sources = [FOLDER.parent / "quarter_car" / "src" / model for model in MODELS]
    with tempfile.TemporaryDirectory() as scratch:
        fmus = build_fmus(sources, Path(scratch), force=force)
        with zipfile.ZipFile(package, "w") as archive:
            for name in FILES:
                archive.write(FOLDER / name, name, zipfile.ZIP_DEFLATED)
            for fmu in fmus:
                archive.write(fmu, f"resources/{fmu.name}")
    return [package]


if __name__ == "__main__":
    sys.exit(main(build, "Build quarter_car.ssp.", FOLDER))
