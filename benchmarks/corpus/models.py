"""The FMUs of a folder: what their model descriptions say, read without any check."""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

_DESCRIPTION = "modelDescription.xml"
_LINUX = re.compile(r"(\./)?binaries[/\\](linux64|x86_64-linux)[/\\].+\.so")
_TOOLS = (
    "20-sim",
    "Altair Activate",
    "Amesim",
    "Dymola",
    "FMUContainer",
    "Hopsan",
    "JModelica.org",
    "MapleSim",
    "OpenModelica",
    "Optimica",
    "Overture",
    "PythonFMU3",
    "PythonFMU",
    "RabbitMQ",
    "Reference FMUs",
    "SIANI FMU Builder",
    "Simulink",
    "SimulationX",
)
_OTHER_NAMES = {
    "C++ Code using FMI support functions from IBK": "IBK FMICodeGenerator",
    "FMICodeGenerator": "IBK FMICodeGenerator",
    "FMI Toolbox": "Simulink (FMI Toolbox)",
    "FMI Kit for Simulink": "Simulink (FMI Kit)",
    "with FMI Kit": "Simulink (FMI Kit)",
}
_VERSION = re.compile(r"[\s,-]*(?:\(|\bv?\d).*")


@dataclass(frozen=True, slots=True)
class CorpusModel:
    """An FMU file or an FMU folder.

    Attributes:
        path: of the file or folder.
        sha256: of the file, or of names and contents of a folder, hexadecimal.
        tool: that exported it, without its version.
        version: of FMI; "" where the model description cannot be read.
        has_binary: whether it has a shared library for 64-bit Linux.
    """

    path: Path
    sha256: str
    tool: str
    version: str
    has_binary: bool


def distinct_models(folder: Path) -> list[CorpusModel]:
    """The FMU files in a folder and below, and the folders that hold a model description.

    Copies are left out: of each content there is one, the first by name.
    """
    models: dict[str, CorpusModel] = {}
    for path in sorted(_paths(folder)):
        model = _read(path)
        models.setdefault(model.sha256, model)
    return list(models.values())


def normalized_tool(generation_tool: str) -> str:
    """The name of a tool without its version; "not said" for none."""
    for part, name in _OTHER_NAMES.items():
        if part.lower() in generation_tool.lower():
            return name
    for name in _TOOLS:
        if name.lower() in generation_tool.lower():
            return name
    return _VERSION.sub("", generation_tool).strip() or "not said"


def _paths(folder: Path) -> Iterator[Path]:
    yield from (path for path in folder.rglob("*.fmu") if path.is_file())
    yield from (path.parent for path in folder.rglob(_DESCRIPTION) if path.parent != folder)


def _read(path: Path) -> CorpusModel:
    sha256, names, description = _content(path)
    tool, version = "", ""
    try:
        root = ElementTree.fromstring(description)
        tool, version = root.get("generationTool", ""), root.get("fmiVersion", "")
    except ElementTree.ParseError:
        pass
    has_binary = any(_LINUX.fullmatch(name) for name in names)
    return CorpusModel(path, sha256, normalized_tool(tool), version, has_binary)


def _content(path: Path) -> tuple[str, list[str], bytes]:
    """Hash, names of all files, and the model description; b"" where there is none."""
    if path.is_dir():
        digest = hashlib.sha256()
        files = sorted(file for file in path.rglob("*") if file.is_file())
        for file in files:
            digest.update(str(file.relative_to(path)).encode() + b"\0" + file.read_bytes() + b"\0")
        names = [file.relative_to(path).as_posix() for file in files]
        return digest.hexdigest(), names, (path / _DESCRIPTION).read_bytes()
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            found = [name for name in names if name.removeprefix("./") == _DESCRIPTION]
            return sha256, names, archive.read(found[0]) if found else b""
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError):
        return sha256, [], b""
