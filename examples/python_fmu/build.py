"""Build the FMUs in Python: the wheel by PythonFMU, the chassis by PythonFMU3.

pip install pythonfmu pythonfmu3
python examples/python_fmu/build.py [--output DIR] [--force]
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path.append(str(FOLDER.parent))  # the examples are no package that could be installed

from fmu_framework.build_fmus import BuildError, main  # noqa: E402  needs the line above

__all__ = ["MODELS", "BuildError", "build", "build_model"]

MODELS = {"wheel": ("pythonfmu", "--handle-state"), "chassis": ("pythonfmu3",)}
"""The package that makes each FMU, and what it is told."""

SHARED = "runge_kutta.py"
_TIME = 60.0


def build(output: Path, *, force: bool = False) -> list[Path]:
    """Build what is missing or older than its script into the folder ``output``.

    Returns the paths of the FMUs, in the order of ``MODELS``.

    Raises:
        BuildError: a package is missing, or cannot make the FMU.
    """
    return [
        build_model(FOLDER / f"{name}.py", output, *arguments, force=force)
        for name, arguments in MODELS.items()
    ]


def build_model(
    script: Path, output: Path, package: str, *options: str, force: bool = False
) -> Path:
    """Make an FMU of a script, in a process of its own: its modules are in nobody's way there.

    Args:
        script: whose class names the model as the script is called.
        output: folder for the FMU, made if it is missing.
        package: ``pythonfmu`` or ``pythonfmu3``.
        options: for its command ``build``.
        force: build it even if it is up to date.

    Returns:
        The path of the FMU.

    Raises:
        BuildError: as `build`.
    """
    output.mkdir(parents=True, exist_ok=True)
    fmu = output / f"{script.stem}.fmu"
    sources = [script, FOLDER / SHARED, Path(__file__)]
    if not force and fmu.exists() and fmu.stat().st_mtime >= max(_changed(p) for p in sources):
        return fmu
    with tempfile.TemporaryDirectory(dir=output) as directory:
        command = [sys.executable, "-m", package, "build", "-f", str(script), "-d", directory]
        run = subprocess.run(
            [*command, *options, str(FOLDER / SHARED)],
            capture_output=True,
            text=True,
            timeout=_TIME,
            check=False,
        )
        made = Path(directory) / fmu.name
        if run.returncode or not made.is_file():
            lines = (run.stderr or run.stdout).strip().splitlines()
            raise BuildError(f"{package} made no {fmu.name}: {lines[-1] if lines else 'no reason'}")
        made.replace(fmu)
    return fmu


def _changed(path: Path) -> float:
    return path.stat().st_mtime


if __name__ == "__main__":
    sys.exit(main(build, "Build the FMUs in Python.", FOLDER))
