"""FMUs, archives or folders: checked before anything is written, then extracted or copied."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from fmpy import platform, platform_tuple, sharedLibraryExtension

from protocol.errors import ModelError
from protocol.host.archives import MAX_XML_BYTES, check_xml, checked_archive, read_entry
from protocol.host.files import DESCRIPTION, entry_names

PLATFORM_FOLDERS = (str(platform), str(platform_tuple))
"""Names of this platform under ``binaries``: until FMI 2.0, since FMI 3.0."""

_IDENTIFIER = re.compile(r"[A-Za-z0-9_.-]{1,128}")
_NEEDED = (DESCRIPTION, "binaries", "resources")
_SHOWN = 5


def extract(fmu: Path, directory: Path) -> None:
    """Bring what is needed to run ``fmu`` here, an archive or a folder, into ``directory``.

    Raises:
        ModelError: it is missing, is no FMU, or breaks a rule, with the entry's name; nothing was
            written then.
    """
    if fmu.is_dir():
        _copy(fmu, directory)
        return
    with checked_archive(fmu, "FMU") as archive:
        names = archive.namelist()
        if DESCRIPTION not in names:
            raise _no_fmu(fmu, names)
        check_xml(f"{fmu}: {DESCRIPTION}", read_entry(archive, DESCRIPTION, MAX_XML_BYTES))
        for entry in archive.infolist():
            if _is_needed(entry.filename):
                archive.extract(entry, directory)


def check_binary(fmu: Path, directory: Path, model_identifier: str, folder: str) -> Path:
    """The binary of the extracted FMU for this platform.

    Args:
        fmu: the file, or the folder.
        directory: it was extracted into.
        model_identifier: base name of the binary.
        folder: one of `PLATFORM_FOLDERS`.

    Raises:
        ModelError: it has none; the message says which platforms it has, or the name that its
            binary has instead.
    """
    if not _IDENTIFIER.fullmatch(model_identifier):
        raise ModelError(f"{fmu}: modelIdentifier {model_identifier!r:.60} is not a file name")
    name = model_identifier + sharedLibraryExtension
    binary: Path = directory / "binaries" / folder / name
    if binary.is_file():
        return binary
    binaries = _binaries(fmu)
    others = [other for other in binaries.get(folder, []) if other.endswith(sharedLibraryExtension)]
    if others:
        raise ModelError(
            f"{fmu}: its modelIdentifier is {model_identifier!r}, so its binary for this platform "
            f"must be binaries/{folder}/{name}; it has {', '.join(others[:_SHOWN])}",
            remedy="export it again, or give the binary the name of the modelIdentifier",
        )
    raise ModelError(
        f"{fmu}: has no binary for this platform, {folder}; it has {', '.join(binaries) or 'none'}",
        remedy="export it for this platform, or serve it on a host that it has a binary for",
    )


def _copy(fmu: Path, directory: Path) -> None:
    description = fmu / DESCRIPTION
    try:
        if not description.is_file():
            names = [path.relative_to(fmu).as_posix() for path in fmu.glob(f"*/{DESCRIPTION}")]
            raise _no_fmu(fmu, names)
        if description.stat().st_size > MAX_XML_BYTES:
            raise ModelError(f"{description} is longer than {MAX_XML_BYTES} bytes")
        check_xml(str(description), description.read_bytes())
        for name in entry_names(fmu):
            if _is_needed(name):
                target = directory / name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(fmu / name, target)
    except OSError as error:
        raise ModelError(f"{fmu}: cannot be copied: {error}") from error


def _no_fmu(fmu: Path, names: Iterable[str]) -> ModelError:
    inside = sorted(name for name in names if PurePosixPath(name).name == DESCRIPTION)
    what = f"{fmu}: not an FMU: it holds no {DESCRIPTION}"
    if not inside:
        return ModelError(what)
    folder = PurePosixPath(inside[0]).parent
    if fmu.is_dir():
        return ModelError(f"{what} but {inside[0]}", remedy=f"name the folder {fmu / folder}")
    return ModelError(
        f"{what} at its root, but {inside[0]}",
        remedy=f"pack what is in the folder {folder}, and not the folder itself",
    )


def _binaries(fmu: Path) -> dict[str, list[str]]:
    """The files in each folder of ``binaries``, sorted."""
    if fmu.is_dir():
        names = list(entry_names(fmu))
    else:
        with checked_archive(fmu, "FMU") as archive:
            names = archive.namelist()
    found: dict[str, list[str]] = {}
    for parts in sorted(PurePosixPath(name).parts for name in names if not name.endswith("/")):
        if parts[0] == "binaries" and len(parts) > 2:
            found.setdefault(parts[1], []).append("/".join(parts[2:]))
    return found


def _is_needed(name: str) -> bool:
    parts = PurePosixPath(name).parts
    if parts[0] == "binaries" and len(parts) > 2:
        return parts[1] in PLATFORM_FOLDERS
    return parts[0] in _NEEDED
