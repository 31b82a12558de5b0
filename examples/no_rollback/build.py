"""Build the wheel and the chassis of the quarter car as FMUs whose state cannot be saved.

    python examples/no_rollback/build.py [--output DIR] [--force]

Their binaries are those of ``../quarter_car``; the model description denies canGetAndSetFMUstate
and canSerializeFMUstate. A master that keeps to it has no way back.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
import zipfile
from pathlib import Path
from types import ModuleType

FOLDER = Path(__file__).resolve().parent
sys.path.append(str(FOLDER.parent))  # the examples are no package that could be installed

from fmu_framework.build_fmus import ZIP_TIME, main  # noqa: E402  needs the line above

__all__ = ["MODELS", "build"]

MODELS = ("chassis", "wheel")

_DENIED = ("canGetAndSetFMUstate", "canSerializeFMUstate")


def build(
    output: Path, *, force: bool = False, whole_car: Path = FOLDER.parent / "quarter_car"
) -> list[Path]:
    """Build into the folder ``output`` what is missing or older than the FMUs that it is made of.

    Those are built into the folder ``whole_car`` if they are missing there. Returns the paths of
    the FMUs, in the order of ``MODELS``. See `build_fmus` for what is raised.
    """
    output.mkdir(parents=True, exist_ok=True)
    made = []
    for whole in _quarter_car().build(whole_car, force=force):
        if whole.stem not in MODELS:
            continue
        fmu = output / f"{whole.stem}_without_state.fmu"
        if force or not fmu.exists() or fmu.stat().st_mtime < whole.stat().st_mtime:
            _deny(whole, fmu)
        made.append(fmu)
    return made


def _quarter_car() -> ModuleType:
    path = FOLDER.parent / "quarter_car" / "build.py"
    spec = importlib.util.spec_from_file_location("quarter_car_build", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _deny(whole: Path, fmu: Path) -> None:
    """Copy an FMU, all entries with one time, and deny what needs a saved state."""
    with tempfile.TemporaryDirectory(dir=fmu.parent) as directory:
        part = Path(directory) / fmu.name
        with zipfile.ZipFile(whole) as source, zipfile.ZipFile(part, "w") as copy:
            for entry in source.infolist():
                data = source.read(entry)
                if entry.filename == "modelDescription.xml":
                    for name in _DENIED:
                        data = data.replace(f'{name}="true"'.encode(), f'{name}="false"'.encode())
                copied = zipfile.ZipInfo(entry.filename, ZIP_TIME)
                copied.external_attr = entry.external_attr
                copy.writestr(copied, data, zipfile.ZIP_DEFLATED)
        part.replace(fmu)


if __name__ == "__main__":
    sys.exit(main(build, "Build the quarter car without saved states.", FOLDER))
