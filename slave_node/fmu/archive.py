"""FMU archives: checked before anything is written, then extracted.

An archive is untrusted input: entry names must stay inside, there
must be no links, and what it unpacks to is bounded.
"""

from __future__ import annotations

import lzma
import re
import stat
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from xml.parsers import expat

from fmpy import platform, platform_tuple, sharedLibraryExtension

from protocol.errors import ModelError

MAX_ENTRIES = 20_000
MAX_TOTAL_BYTES = 4 * 2**30
MAX_RATIO = 200
MAX_XML_BYTES = 64 * 2**20
_RATIO_FREE_BYTES = 16 * 2**20

PLATFORM_FOLDERS = (str(platform), str(platform_tuple))
"""Names of this platform under ``binaries``: until FMI 2.0, since FMI 3.0."""

_IDENTIFIER = re.compile(r"[A-Za-z0-9_.-]{1,128}")
_NEEDED = ("modelDescription.xml", "binaries", "resources")
_UNREADABLE = (  # all that zipfile raises for what is no zip file or a damaged one
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    ValueError,
    NotImplementedError,
    RuntimeError,
)


def extract(fmu: Path, directory: Path) -> None:
    """Extract what is needed to run ``fmu`` here into ``directory``.

    Raises:
        ModelError: the file is missing, is no FMU, or breaks a rule, with the entry's name;
            nothing was written then.
    """
    if not fmu.is_file():
        raise ModelError(f"{fmu}: no such file")
    try:
        with zipfile.ZipFile(fmu) as archive:
            entries = archive.infolist()
            _check_entries(fmu, entries)
            _check_description(fmu, archive)
            for entry in entries:
                if _is_needed(entry.filename):
                    archive.extract(entry, directory)
    except _UNREADABLE as error:
        raise ModelError(
            f"{fmu}: not a readable FMU archive: {error}", remedy="export the FMU again"
        ) from error
    except OSError as error:
        raise ModelError(f"{fmu}: cannot be extracted: {error}") from error


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
        with zipfile.ZipFile(fmu) as archive:
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


def _check_entries(fmu: Path, entries: list[zipfile.ZipInfo]) -> None:
    if len(entries) > MAX_ENTRIES:
        raise ModelError(f"{fmu}: {len(entries)} entries; the limit is {MAX_ENTRIES}")
    total = 0
    seen = set()
    for entry in entries:
        name = entry.filename
        parts = PurePosixPath(name.replace("\\", "/")).parts
        if not parts or name.startswith(("/", "\\")) or ".." in parts or ":" in parts[0]:
            raise ModelError(f"{fmu}: entry {name!r:.200} leads outside the archive")
        if parts in seen:  # the one that was checked need not be the one that is extracted
            raise ModelError(f"{fmu}: entry {name!r:.200} is there twice")
        seen.add(parts)
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise ModelError(f"{fmu}: entry {name!r:.200} is a symbolic link")
        total += entry.file_size
        allowed = _RATIO_FREE_BYTES + MAX_RATIO * entry.compress_size
        if entry.file_size > allowed or total > MAX_TOTAL_BYTES:
            raise ModelError(
                f"{fmu}: entry {name!r:.200} unpacks to {entry.file_size} bytes, beyond the limits"
            )


def _check_description(fmu: Path, archive: zipfile.ZipFile) -> None:
    try:
        size = archive.getinfo("modelDescription.xml").file_size
    except KeyError:
        raise ModelError(f"{fmu}: not an FMU: it holds no modelDescription.xml") from None
    if size > MAX_XML_BYTES:
        raise ModelError(f"{fmu}: modelDescription.xml of {size} bytes; limit {MAX_XML_BYTES}")
    try:
        has_document_type = _has_document_type(archive.read("modelDescription.xml"))
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise ModelError(f"{fmu}: modelDescription.xml cannot be read: {error}") from error
    if has_document_type:
        raise ModelError(
            f"{fmu}: modelDescription.xml declares a document type, which FMI does not use and "
            "which can read files or exhaust memory"
        )


def _has_document_type(xml: bytes) -> bool:
    """Whether a DOCTYPE, where entities are declared, stands before the root element.

    By a parser and not by a search, because it can be written in several encodings. Raises what
    ``expat`` raises.
    """
    found: list[bool] = []
    parser = expat.ParserCreate()

    def stop(is_document_type: bool) -> None:
        found.append(is_document_type)
        raise StopIteration

    parser.StartDoctypeDeclHandler = lambda *_: stop(True)
    parser.StartElementHandler = lambda *_: stop(False)
    try:
        parser.Parse(xml, True)
    except StopIteration:
        return found[0]
    return False
