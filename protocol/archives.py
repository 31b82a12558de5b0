"""Zip archives and XML from elsewhere: checked before anything is written or parsed.

An archive is untrusted input: entry names must stay inside, there must be no links, and what it
unpacks to is bounded. XML must declare no document type.
"""

from __future__ import annotations

import lzma
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from xml.parsers import expat

from protocol.errors import ModelError

MAX_ENTRIES = 20_000
MAX_TOTAL_BYTES = 4 * 2**30
MAX_RATIO = 200
MAX_XML_BYTES = 64 * 2**20
_RATIO_FREE_BYTES = 16 * 2**20

UNREADABLE = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    ValueError,
    NotImplementedError,
    RuntimeError,
)
"""All that `zipfile` raises for what is no zip file or a damaged one."""


@contextmanager
def checked_archive(path: Path, kind: str) -> Iterator[zipfile.ZipFile]:
    """The archive, open for reading, after all its entries were checked.

    Args:
        path: of the archive.
        kind: what it should be, for messages, such as ``FMU``.

    Raises:
        ModelError: the file is missing, cannot be read or extracted, or breaks a rule, with the
            entry's name. Errors of ``zipfile`` in the body are told in the same way.
    """
    if not path.is_file():
        raise ModelError(f"{path}: no such file")
    try:
        with zipfile.ZipFile(path) as archive:
            _check_entries(path, archive.infolist())
            yield archive
    except UNREADABLE as error:
        raise ModelError(
            f"{path}: not a readable {kind} archive: {error}", remedy=f"export the {kind} again"
        ) from error
    except OSError as error:
        raise ModelError(f"{path}: cannot be extracted: {error}") from error


def check_xml(where: str, xml: bytes) -> None:
    """Check that a document can be given to a parser.

    Args:
        where: file, and entry if there is one, for messages.
        xml: the whole document.

    Raises:
        ModelError: it is too large, its head is not XML, or it declares a document type.
    """
    if len(xml) > MAX_XML_BYTES:
        raise ModelError(f"{where} of {len(xml)} bytes; limit {MAX_XML_BYTES}")
    try:
        has_document_type = _has_document_type(xml)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise ModelError(f"{where} cannot be read: {error}") from error
    if has_document_type:
        raise ModelError(
            f"{where} declares a document type, which neither FMI nor SSP uses and which can "
            "read files or exhaust memory"
        )


def _check_entries(path: Path, entries: Sequence[zipfile.ZipInfo]) -> None:
    if len(entries) > MAX_ENTRIES:
        raise ModelError(f"{path}: {len(entries)} entries; the limit is {MAX_ENTRIES}")
    total = 0
    seen = set()
    for entry in entries:
        name = entry.filename
        parts = PurePosixPath(name.replace("\\", "/")).parts
        if not parts or name.startswith(("/", "\\")) or ".." in parts or ":" in parts[0]:
            raise ModelError(f"{path}: entry {name!r:.200} leads outside the archive")
        if parts in seen:  # the one that was checked need not be the one that is extracted
            raise ModelError(f"{path}: entry {name!r:.200} is there twice")
        seen.add(parts)
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise ModelError(f"{path}: entry {name!r:.200} is a symbolic link")
        total += entry.file_size
        allowed = _RATIO_FREE_BYTES + MAX_RATIO * entry.compress_size
        if entry.file_size > allowed or total > MAX_TOTAL_BYTES:
            raise ModelError(
                f"{path}: entry {name!r:.200} unpacks to {entry.file_size} bytes, beyond the limits"
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
