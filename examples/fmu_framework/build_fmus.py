"""Build FMUs from sources in C, with the platform's C compiler.

The FMI headers come from FMPy's wheel. An FMU that is newer than its sources is left alone.
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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

FRAMEWORK = Path(__file__).resolve().parent

SYSTEMS = {  # platform.system(): its name in FMI 1.0 and 2.0, in FMI 3.0, and the extension
    "Linux": ("linux64", "linux", ".so"),
    "Darwin": ("darwin64", "darwin", ".dylib"),
    "Windows": ("win64", "windows", ".dll"),
}
MACHINES = {"x86_64": "x86_64", "amd64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}

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


@dataclass(frozen=True)
class Fmu:
    """Parts of an FMU."""

    name: str
    """Name of the file, and the modelIdentifier."""
    description: bytes
    """The text of modelDescription.xml."""
    sources: tuple[Path, ...]
    """C sources and headers, no two of one name: in the FMU they all lie in one folder."""
    made_by: tuple[Path, ...] = ()
    """Other files that say what the FMU is; when one of them changes, it is built anew."""
    fmi_version: int = 2
    definitions: tuple[tuple[str, str], ...] = ()
    """Macros for the compiler, name and value. They stand in the FMU too, beside the sources."""
    libraries: tuple[str, ...] = ()
    """Arguments for the linker, ``-lm`` aside."""
    absent_library: str | None = None
    """A library without which the binary cannot be loaded, and which exists while it is linked
    only. The name is that of ``-l``."""
    documents: dict[str, bytes] = field(default_factory=dict)
    """Further files of the archive."""


class Build(Protocol):
    """Interface of the ``build.py`` of an example, for the command line and the tests."""

    def __call__(self, output: Path, *, force: bool = False) -> list[Path]:
        """Build the example's FMUs into the folder ``output``, see `build`."""


def build_fmus(models: Iterable[Path], output: Path, *, force: bool = False) -> list[Path]:
    """Build FMI 2.0 FMUs from models and this framework, see `build`.

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
    return build((_fmu(model) for model in models), output, force=force)


def build(fmus: Iterable[Fmu], output: Path, *, force: bool = False) -> list[Path]:
    """Build the FMUs that are missing or older than their sources into the folder ``output``.

    An FMU appears whole or not at all, so several processes may build into the same folder at
    once.

    Returns:
        The paths of all FMUs, in the order of ``fmus``.

    Raises:
        BuildError: there is no compiler, no header, or an error in the C code.
    """
    output.mkdir(parents=True, exist_ok=True)
    wanted = {output / f"{fmu.name}.fmu": fmu for fmu in fmus}
    stale = [path for path, fmu in wanted.items() if force or not _is_up_to_date(path, fmu)]
    if stale:
        compiler, headers = _find_compiler(), _find_headers()
        with ThreadPoolExecutor() as pool:  # the compiler runs in processes of its own
            list(pool.map(lambda path: _build_fmu(path, wanted[path], compiler, headers), stale))
    return list(wanted)


def _fmu(model: Path) -> Fmu:
    description = model / "modelDescription.xml"
    return Fmu(
        name=model.name,
        description=description.read_bytes(),
        sources=(*FRAMEWORK.glob("*.[ch]"), model / "model.c"),
        made_by=(description,),
    )


def _binary_name(fmu: Fmu) -> str:
    """Where the compiled sources lie in the FMU."""
    try:
        folder, system, extension = SYSTEMS[platform.system()]
        machine = MACHINES[platform.machine().lower()]
    except KeyError:
        raise BuildError(
            f"FMI has no name for the platform {platform.system()!r} on {platform.machine()!r}; "
            f"build on one of {', '.join(SYSTEMS)}"
        ) from None
    if fmu.fmi_version >= 3:
        folder = f"{machine}-{system}"
    return f"binaries/{folder}/{fmu.name}{extension}"


def _is_up_to_date(path: Path, fmu: Fmu) -> bool:
    inputs = [Path(__file__), *fmu.made_by, *fmu.sources]
    try:
        newest = max(path.stat().st_mtime_ns for path in inputs)
        if path.stat().st_mtime_ns <= newest:
            return False
        with zipfile.ZipFile(path) as archive:
            return _binary_name(fmu) in archive.namelist()
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
        raise BuildError("the FMI headers come with FMPy; install it: 'pip install fmpy'")
    headers = Path(package.origin).parent / "c-code"
    for version in (1, 2, 3):
        if not (headers / f"fmi{version}Functions.h").is_file():
            raise BuildError(f"this FMPy has no fmi{version}Functions.h in {headers}; update it")
    return headers


def _build_fmu(path: Path, fmu: Fmu, compiler: list[str], headers: Path) -> None:
    """Compile and pack beside the target, then rename: both paths are on one file system."""
    sources = sorted(fmu.sources, key=lambda source: source.name)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{fmu.name}-") as folder:
        work = Path(folder).resolve()
        binary = work / Path(_binary_name(fmu)).name
        position = () if os.name == "nt" else ("-fPIC",)
        libraries = [*fmu.libraries, "-lm"]
        if fmu.absent_library is not None:
            libraries[:0] = _make_library(fmu.absent_library, work, [*compiler, *FLAGS, *position])
        definitions = [f"-D{name}={value}" for name, value in fmu.definitions]
        _compile(
            [
                *compiler,
                *FLAGS,
                *position,
                *definitions,
                "-isystem",  # their warnings are not ours to mend
                str(headers),
                *(f"-I{folder}" for folder in sorted({_from_framework(p.parent) for p in sources})),
                *(_from_framework(source) for source in sources if source.suffix == ".c"),
                "-o",
                str(binary),
                *libraries,
            ]
        )
        entries = {
            "modelDescription.xml": fmu.description,
            _binary_name(fmu): binary.read_bytes(),
            **{f"sources/{source.name}": source.read_bytes() for source in sources},
            **fmu.documents,
        }
        if definitions:  # one argument in a line, as clang tools read it
            entries["sources/compile_flags.txt"] = "\n".join([*definitions, ""]).encode()
        archive_path = work / path.name
        with zipfile.ZipFile(archive_path, "w") as archive:
            for name, content in entries.items():
                archive.writestr(_zip_entry(name), content)
        archive_path.replace(path)


def _make_library(name: str, work: Path, compile_command: list[str]) -> list[str]:
    """Make a shared library with one function; returns the linker's arguments for it."""
    source = work / f"{name}.c"
    source.write_text(
        f"int {name}(void);\n"
        f'__attribute__((visibility("default"))) int {name}(void)\n{{\n    return 0;\n}}\n'
    )
    library = work / f"lib{name}{SYSTEMS[platform.system()][2]}"
    soname = (f"-Wl,-soname,{library.name}",) if platform.system() == "Linux" else ()
    _compile([*compile_command, str(source), *soname, "-o", str(library)])
    return [f"-L{work}", f"-l{name}"]


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
