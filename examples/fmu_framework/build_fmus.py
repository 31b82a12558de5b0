"""Build FMUs from this framework and models in C, with the platform's C compiler.

The FMI 2.0 headers come from FMPy's wheel. An FMU that is newer than its sources is left alone.
The same sources and the same compiler give the same bytes, so a sha256 names a build.

The ``build.py`` of each example calls it.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

FRAMEWORK = Path(__file__).resolve().parent

PLATFORMS = {  # platform.system(): folder of the binary in the FMU, its file name extension
    "Linux": ("linux64", ".so"),
    "Darwin": ("darwin64", ".dylib"),
    "Windows": ("win64", ".dll"),
}

FLAGS = (
    "-std=c99",
    "-O2",
    "-ffp-contract=off",  # a fused multiply-add here but not there would change the last bits
    "-Wall",
    "-Wextra",
    "-Werror",
    "-fvisibility=hidden",
    "-shared",
)

ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # the earliest a zip can say


class BuildError(Exception):
    """An FMU cannot be built here; the message says what to install or to mend."""


class Build(Protocol):
    """What the ``build.py`` of an example offers, at the command line and to the tests."""

    def __call__(self, output: Path, *, force: bool = False) -> list[Path]:
        """Build the example's FMUs into the folder ``output``, see `build_fmus`."""


def build_fmus(models: Iterable[Path], output: Path, *, force: bool = False) -> list[Path]:
    """Build the FMUs that are missing or older than their sources into the folder ``output``.

    An FMU appears whole or not at all, so several processes may build into the same folder at
    once.

    Args:
        models: the folder of each model, which has its name and holds its ``model.c`` and
            ``modelDescription.xml``.
        output: folder for the FMUs; it is made if it is missing.
        force: build even what is up to date.

    Returns:
        The paths of all FMUs, in the order of ``models``.

    Raises:
        BuildError: there is no compiler, no header, or an error in the C code.
    """
    output.mkdir(parents=True, exist_ok=True)
    fmus = {output / f"{model.name}.fmu": model for model in models}
    stale = [fmu for fmu, model in fmus.items() if force or not _is_up_to_date(fmu, model)]
    if stale:
        compiler, headers = _find_compiler(), _find_headers()
        with ThreadPoolExecutor() as pool:  # the compiler runs in processes of its own
            list(pool.map(lambda fmu: _build_fmu(fmu, fmus[fmu], compiler, headers), stale))
    return list(fmus)


def _source_files(model: Path) -> list[Path]:
    """The C sources and headers of a model; in the FMU they all lie in one folder."""
    return sorted([*FRAMEWORK.glob("*.[ch]"), model / "model.c"], key=lambda path: path.name)


def _model_description(model: Path) -> Path:
    return model / "modelDescription.xml"


def _binary_name(model: str) -> str:
    """Where the compiled model lies in the FMU."""
    try:
        folder, extension = PLATFORMS[platform.system()]
    except KeyError:
        raise BuildError(
            f"FMI 2.0 has no name for the platform {platform.system()!r}; "
            f"build on one of {', '.join(PLATFORMS)}"
        ) from None
    return f"binaries/{folder}/{model}{extension}"


def _is_up_to_date(fmu: Path, model: Path) -> bool:
    inputs = [Path(__file__), _model_description(model), *_source_files(model)]
    try:
        newest = max(path.stat().st_mtime_ns for path in inputs)
        if fmu.stat().st_mtime_ns <= newest:
            return False
        with zipfile.ZipFile(fmu) as archive:
            return _binary_name(model.name) in archive.namelist()
    except (FileNotFoundError, zipfile.BadZipFile):
        return False


def _find_compiler() -> list[str]:
    chosen = os.environ.get("CC")
    if chosen:
        command = shlex.split(chosen, posix=os.name == "posix")
        if shutil.which(command[0]):
            return command
        raise BuildError(f"the C compiler {command[0]!r} named by CC is not on the PATH")
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return [name]
    raise BuildError(
        "no C compiler found (looked for $CC, cc, gcc, clang); install one: "
        "'apt install gcc' (Debian, Ubuntu), 'dnf install gcc' (Fedora), "
        "'xcode-select --install' (macOS), MinGW-w64 (Windows)"
    )


def _find_headers() -> Path:
    package = importlib.util.find_spec("fmpy")  # located, not imported: only its headers matter
    if package is None or package.origin is None:
        raise BuildError("the FMI 2.0 headers come with FMPy; install it: 'pip install fmpy'")
    headers = Path(package.origin).parent / "c-code"
    if not (headers / "fmi2Functions.h").is_file():
        raise BuildError(f"this FMPy has no fmi2Functions.h in {headers}; update it")
    return headers


def _build_fmu(fmu: Path, model: Path, compiler: list[str], headers: Path) -> None:
    """Compile and pack beside the target, then rename: both paths are on one file system."""
    sources = _source_files(model)
    with tempfile.TemporaryDirectory(dir=fmu.parent, prefix=f".{model.name}-") as folder:
        work = Path(folder)
        binary = work / Path(_binary_name(model.name)).name
        _compile(
            [
                *compiler,
                *FLAGS,
                *(() if os.name == "nt" else ("-fPIC",)),
                "-isystem",  # their warnings are not ours to mend
                str(headers),
                "-I.",
                *(_from_framework(path) for path in sources if path.suffix == ".c"),
                "-o",
                str(binary.resolve()),
                "-lm",
            ]
        )
        entries = {
            "modelDescription.xml": _model_description(model),
            _binary_name(model.name): binary,
            **{f"sources/{path.name}": path for path in sources},
        }
        archive_path = work / fmu.name
        with zipfile.ZipFile(archive_path, "w") as archive:
            for name, path in entries.items():
                archive.writestr(_zip_entry(name), path.read_bytes())
        archive_path.replace(fmu)


def _from_framework(path: Path) -> str:
    return Path(os.path.relpath(path, FRAMEWORK)).as_posix()


def _compile(command: list[str]) -> None:
    """Run the compiler among the sources, so that the paths it may record are relative ones."""
    result = subprocess.run(command, cwd=FRAMEWORK, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        raise BuildError(f"the C compiler failed: {shlex.join(command)}\n{result.stderr.strip()}")


def _zip_entry(name: str) -> zipfile.ZipInfo:
    """An entry with nothing in it that depends on when, where or by whom it was packed."""
    entry = zipfile.ZipInfo(name, ZIP_TIME)
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.create_system = 3  # Unix, wherever it was packed
    entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
    return entry


def main(build: Build, description: str, folder: Path) -> int:
    """The command line of an example's ``build.py``; returns the exit code.

    Args:
        build: what to call.
        description: for ``--help``.
        folder: where the FMUs go unless ``--output`` says otherwise.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--output", type=Path, default=folder, metavar="DIR", help="folder for the FMUs"
    )
    parser.add_argument("--force", action="store_true", help="build even what is up to date")
    arguments = parser.parse_args()
    try:
        for fmu in build(arguments.output, force=arguments.force):
            print(fmu)
    except BuildError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0
