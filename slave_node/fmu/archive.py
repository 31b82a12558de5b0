"""FMU archives: checked before anything is written, then extracted."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path, PurePosixPath

from fmpy import platform, platform_tuple, sharedLibraryExtension

from protocol.archives import MAX_XML_BYTES, bounded_archive, check_xml, checked_archive, read_entry
from protocol.errors import ModelError

PLATFORM_FOLDERS = (str(platform), str(platform_tuple))
"""Names of this platform under ``binaries``: until FMI 2.0, since FMI 3.0."""

_IDENTIFIER = re.compile(r"[A-Za-z0-9_.-]{1,128}")
_NEEDED = ("modelDescription.xml", "binaries", "resources")


def extract(fmu: Path, directory: Path) -> None:
    """Extract what is needed to run ``fmu`` here into ``directory``.

    Raises:
        ModelError: the file is missing, is no FMU, or breaks a rule, with the entry's name;
            nothing was written then.
    """
    with checked_archive(fmu, "FMU") as archive:
        _check_description(fmu, archive)
        for entry in archive.infolist():
            if _is_needed(entry.filename):
                archive.extract(entry, directory)


def check_binary(fmu: Path, directory: Path, model_identifier: str, folder: str) -> Path:
    """The binary of the extracted FMU for this platform.

    Args:
        fmu: the file.
        directory: it was extracted into.
        model_identifier: base name of the binary.
        folder: one of `PLATFORM_FOLDERS`.

    Raises:
        ModelError: it has none; the message says which platforms it has.
    """
    if not _IDENTIFIER.fullmatch(model_identifier):
        raise ModelError(f"{fmu}: modelIdentifier {model_identifier!r:.60} is not a file name")
    binary: Path = directory / "binaries" / folder / (model_identifier + sharedLibraryExtension)
    if not binary.is_file():
        with bounded_archive(fmu) as archive:
            parts = [PurePosixPath(name).parts for name in archive.namelist()]
        found = sorted({p[1] for p in parts if p[0] == "binaries" and len(p) > 2})
        raise ModelError(
            f"{fmu}: has no binary for this platform, {folder}; it has "
            f"{', '.join(found) or 'none'}",
            remedy="export it for this platform, or serve it on a host that it has a binary for",
        )
    return binary


def _is_needed(name: str) -> bool:
    parts = PurePosixPath(name).parts
    if parts[0] == "binaries" and len(parts) > 2:
        return parts[1] in PLATFORM_FOLDERS
    return parts[0] in _NEEDED


def _check_description(fmu: Path, archive: zipfile.ZipFile) -> None:
    try:
        xml = read_entry(archive, "modelDescription.xml", MAX_XML_BYTES)
    except KeyError:
        raise ModelError(f"{fmu}: not an FMU: it holds no modelDescription.xml") from None
    check_xml(f"{fmu}: modelDescription.xml", xml)
