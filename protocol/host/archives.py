"""Zip archives and XML from elsewhere: checked before anything is written or parsed.

An archive is untrusted input: entry names must stay inside, there must be no links, and what it
unpacks to is bounded, whatever it says of itself. XML must declare no document type, and is
bounded in bytes, elements and depth: a parser makes a hundred bytes of each byte of a bomb.

Tools write one name in several ways, with ``./`` in front, with double slashes or backslashes.
Entries are known by their plain names, with single slashes.
"""

from __future__ import annotations

import io
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
MAX_XML_ELEMENTS = 1_000_000
MAX_XML_ATTRIBUTES = 64
"""Largest number of attributes of one element."""

MAX_XML_DEPTH = 100
_RATIO_FREE_BYTES = 16 * 2**20
_MAX_READ = 8 * 2**20
_PIECE = 2**16
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)

UNREADABLE = (
    zipfile.BadZipFile,
    zlib.error,
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

    Its entries have plain names; one for the root folder itself is left out.

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
        with bounded_archive(path) as archive:
            _check_entries(path, archive.infolist())
            _name_plainly(archive)
            yield archive
    except UNREADABLE as error:
        raise ModelError(
            f"{path}: not a readable {kind} archive: {error}", remedy=f"export the {kind} again"
        ) from error
    except OSError as error:
        raise ModelError(f"{path}: cannot be extracted: {error}") from error


@contextmanager
def bounded_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """A zip file for reading, of which little is held in memory whatever it says.

    Its directory is bounded. Entries are read by ``extract``, or by `read_entry`. Raises what
    `UNREADABLE` names, and OSError.
    """
    with _BoundedFile(io.FileIO(path)) as file, zipfile.ZipFile(file) as archive:
        yield archive


class _BoundedFile(io.BufferedReader):
    """Refuses to read much at once: `zipfile` reads a directory whole, however long it says."""

    def read(self, size: int | None = -1, /) -> bytes:
        whole = size is None or size < 0
        if not whole and size > _MAX_READ:  # type: ignore[operator]  # not None
            raise zipfile.BadZipFile(f"it wants {size} bytes at once; the limit is {_MAX_READ}")
        data = super().read(_MAX_READ + 1 if whole else size)
        if len(data) > _MAX_READ:
            raise zipfile.BadZipFile(f"no end within {_MAX_READ} bytes")
        return data


def read_entry(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """An entry as bytes, unpacked piece by piece.

    Raises:
        KeyError: there is no such entry.
        zipfile.BadZipFile: it is longer than ``limit`` [bytes], or compressed in a way that cannot
            be bounded; else as `UNREADABLE`.
    """
    entry = archive.getinfo(name)
    if entry.compress_type not in _COMPRESSIONS:
        raise zipfile.BadZipFile(f"entry {name!r:.200} is compressed by {_method(entry)}")
    if entry.file_size > limit:
        raise zipfile.BadZipFile(f"entry {name!r:.200} of {entry.file_size} bytes; limit {limit}")
    pieces = []
    with archive.open(entry) as file:
        while piece := file.read(_PIECE):
            pieces.append(piece)
    return b"".join(pieces)


def _method(entry: zipfile.ZipInfo) -> str:
    names: dict[int, str] = zipfile.compressor_names  # type: ignore[attr-defined]
    return names.get(entry.compress_type, f"method {entry.compress_type}")


def check_xml(where: str, xml: bytes) -> None:
    """Check that a document can be given to a parser.

    Args:
        where: file, and entry if there is one, for messages.
        xml: the whole document.

    Raises:
        ModelError: it is too large or too deep, is not XML, or declares a document type.
    """
    if len(xml) > MAX_XML_BYTES:
        raise ModelError(f"{where} of {len(xml)} bytes; limit {MAX_XML_BYTES}")
    try:
        _Walk().go(xml)
    except _RefusedError as error:
        raise ModelError(f"{where} {error}") from None
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise ModelError(f"{where} cannot be read: {error}") from error


class _RefusedError(Exception):
    """Why a document cannot be given to a parser."""


class _Walk:
    """Goes through a document without building anything; raises what ``expat`` raises.

    By a parser and not by a search: a document can be written in several encodings. All at once:
    given in pieces, a tag of many megabytes is begun anew with each piece.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._elements = 0

    def go(self, xml: bytes) -> None:
        parser = expat.ParserCreate()
        parser.ordered_attributes = True
        parser.StartDoctypeDeclHandler = self._document_type
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.Parse(xml, True)

    @staticmethod
    def _document_type(*_: object) -> None:
        raise _RefusedError(
            "declares a document type, which neither FMI nor SSP uses and which can read files or "
            "exhaust memory"
        )

    def _start(self, _: str, attributes: Sequence[str]) -> None:
        self._depth += 1
        self._elements += 1
        if self._elements > MAX_XML_ELEMENTS:
            raise _RefusedError(f"has more than {MAX_XML_ELEMENTS} elements")
        if self._depth > MAX_XML_DEPTH:
            raise _RefusedError(f"is deeper than {MAX_XML_DEPTH} elements")
        if len(attributes) > 2 * MAX_XML_ATTRIBUTES:
            raise _RefusedError(f"has more than {MAX_XML_ATTRIBUTES} attributes in an element")

    def _end(self, _: str) -> None:
        self._depth -= 1


def _check_entries(path: Path, entries: Sequence[zipfile.ZipInfo]) -> None:
    if len(entries) > MAX_ENTRIES:
        raise ModelError(f"{path}: {len(entries)} entries; the limit is {MAX_ENTRIES}")
    total = 0
    seen: dict[tuple[str, ...], bool] = {}
    for entry in entries:
        name = entry.filename
        parts, is_folder = _parts(name), _is_folder(name)
        leads_outside = name.startswith(("/", "\\")) or ".." in parts or ":" in "".join(parts[:1])
        if leads_outside or not (parts or is_folder):
            raise ModelError(f"{path}: entry {name!r:.200} leads outside the archive")
        if parts in seen and not (is_folder and seen[parts]):
            # the file that was checked need not be the one that is extracted
            raise ModelError(f"{path}: entry {name!r:.200} is there twice")
        seen[parts] = is_folder
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise ModelError(f"{path}: entry {name!r:.200} is a symbolic link")
        if entry.compress_type not in _COMPRESSIONS:
            raise ModelError(
                f"{path}: entry {name!r:.200} is compressed by {_method(entry)}",
                remedy="FMI and SSP know stored and deflated entries only: export it again",
            )
        total += entry.file_size
        allowed = _RATIO_FREE_BYTES + MAX_RATIO * entry.compress_size
        if entry.file_size > allowed or total > MAX_TOTAL_BYTES:
            raise ModelError(
                f"{path}: entry {name!r:.200} unpacks to {entry.file_size} bytes, beyond the limits"
            )


def _parts(name: str) -> tuple[str, ...]:
    """Folders and file of an entry; none for the root folder."""
    return PurePosixPath(name.replace("\\", "/")).parts


def _is_folder(name: str) -> bool:
    return name.endswith(("/", "\\"))


def _name_plainly(archive: zipfile.ZipFile) -> None:
    entries = {}
    for entry in archive.infolist():
        parts = _parts(entry.filename)
        entry.filename = "/".join(parts) + ("/" if _is_folder(entry.filename) else "")
        if parts:
            entries[entry.filename] = entry
    archive.filelist[:] = entries.values()
    archive.NameToInfo = entries
