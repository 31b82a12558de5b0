"""Archives and XML of others: bounded in memory and on disk, whatever they say of themselves."""

from __future__ import annotations

import bz2
import lzma
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from master_node.resuming.files import CheckpointStore
from master_node.system.files import import_system, open_system
from protocol.errors import DoublestepError, ModelError, ResultsError
from protocol.host import archives
from protocol.host.archives import (
    MAX_XML_ATTRIBUTES,
    MAX_XML_DEPTH,
    MAX_XML_ELEMENTS,
    bounded_archive,
    check_xml,
    read_entry,
)
from slave_node.loading import describe_model
from tests.support.ssp_documents import ssd, system

ZEROS = 200 * 2**20
"""Size of an unpacked bomb of these tests [bytes]."""

ROOM = 48 * 2**20
"""No refusal takes as much memory [bytes]."""

DEFLATE, BZIP2, LZMA, IMPLODE = 8, 12, 14, 6


class Entry(NamedTuple):
    """Entry of an archive: its declared sizes, and its content."""

    name: str
    method: int
    data: bytes
    size: int = 16
    checksum: int = zlib.crc32(bytes(16))


def archive(path: Path, entries: Iterable[Entry]) -> Path:
    """Written by hand: `zipfile` cannot lie."""
    body = directory = b""
    count = 0
    for name, method, data, size, checksum in entries:
        count += 1
        told = struct.pack("<4H3I", 0, method, 0, 33, checksum, len(data), size)
        text = name.encode()
        lengths = struct.pack("<2H", len(text), 0)
        place = struct.pack("<3H2I", 0, 0, 0, 0, len(body))
        directory += b"PK\1\2" + struct.pack("<H", 46) + struct.pack("<H", 46) + told
        directory += lengths + place + text
        body += b"PK\3\4" + struct.pack("<H", 46) + told + lengths + text + data
    end = struct.pack("<4H2IH", 0, 0, count, count, len(directory), len(body), 0)
    path.write_bytes(body + directory + b"PK\5\6" + end)
    return path


@cache
def compressed(method: int) -> bytes:
    """Zeros in little, for `DEFLATE` as many as `ZEROS`."""
    piece = bytes(2**20)
    count = ZEROS // len(piece) if method == DEFLATE else 1
    if method == DEFLATE:
        deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
        return b"".join(deflate.compress(piece) for _ in range(count)) + deflate.flush()
    if method == BZIP2:
        bzip2 = bz2.BZ2Compressor(9)
        return b"".join(bzip2.compress(piece) for _ in range(count)) + bzip2.flush()
    properties = lzma._encode_filter_properties({"id": lzma.FILTER_LZMA1})  # type: ignore[attr-defined]
    filters = [{"id": lzma.FILTER_LZMA1}]
    lzma1 = lzma.LZMACompressor(lzma.FORMAT_RAW, filters=filters)
    head = struct.pack("<BBH", 9, 4, len(properties)) + properties
    return head + b"".join(lzma1.compress(piece) for _ in range(count)) + lzma1.flush()


@contextmanager
def in_little_memory() -> Iterator[None]:
    """Fails if more than `ROOM` is allocated meanwhile."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < ROOM, f"{peak / 2**20:.0f} MiB"


def inspect(path: Path) -> None:
    """First step of ``slave-node inspect``, ``validate`` and ``serve``."""
    describe_model(path.name, path.parent)


def run(path: Path) -> None:
    """First step of ``master-node run``."""
    with open_system(path):
        pass


def convert(path: Path) -> None:
    """Work of ``master-node import``."""
    import_system(path, path.with_suffix(".toml"))


READERS: list[tuple[str, str, Callable[[Path], None]]] = [
    ("a.fmu", "modelDescription.xml", inspect),
    ("a.ssp", "SystemStructure.ssd", run),
    ("a.ssp", "SystemStructure.ssd", convert),
]


@pytest.mark.parametrize("reader", READERS, ids=["inspect", "run", "import"])
@pytest.mark.parametrize("method", [BZIP2, LZMA, IMPLODE])
def test_only_stored_and_deflated_entries_are_read(
    method: int, reader: tuple[str, str, Callable[[Path], None]], tmp_path: Path
) -> None:
    """FMI and SSP know no others, whose unpacking cannot be bounded; said with the entry."""
    file, entry, read = reader
    data = b"" if method == IMPLODE else compressed(method)
    path = archive(tmp_path / file, [Entry(entry, method, data)])
    with pytest.raises(ModelError, match=rf"entry '{entry}' is compressed by"):
        read(path)


@pytest.mark.parametrize("reader", READERS, ids=["inspect", "run", "import"])
def test_an_entry_that_lies_about_its_size_is_cut(
    reader: tuple[str, str, Callable[[Path], None]], tmp_path: Path
) -> None:
    """Sixteen bytes are announced and sixteen are unpacked, of two hundred million."""
    file, entry, read = reader
    path = archive(tmp_path / file, [Entry(entry, DEFLATE, compressed(DEFLATE))])
    with in_little_memory(), pytest.raises(ModelError):
        read(path)
    written = [f for f in tmp_path.rglob("*") if f.is_file() and f != path]
    assert sum(f.stat().st_size for f in written) < 100


def test_a_directory_of_many_megabytes_is_refused_unread(tmp_path: Path) -> None:
    """Its entries would be counted only after all of them were built."""
    path = archive(
        tmp_path / "a.fmu", (Entry(f"resources/{i:060}", 0, b"", 0, 0) for i in range(9))
    )
    whole = path.read_bytes()
    at = whole.index(b"PK\1\2")
    body, directory, end = whole[:at], whole[at:-22], whole[-22:]
    many = directory * 40_000
    head = struct.pack("<4H2I", 0, 0, 0xFFFF, 0xFFFF, len(many), len(body))
    path.write_bytes(body + many + end[:4] + head + b"\0\0")
    with in_little_memory(), pytest.raises(ModelError, match="bytes at once; the limit is"):
        inspect(path)


def test_the_state_in_a_checkpoint_is_bounded(tmp_path: Path) -> None:
    """A results directory may be somebody else's."""
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    (folder / "system.json").write_text("{}")
    archive(folder / "run.zip", [Entry("run.json", BZIP2, compressed(BZIP2))])
    with in_little_memory(), pytest.raises(ResultsError, match="is compressed by"):
        CheckpointStore(tmp_path).load()


def test_entries_are_what_they_were(tmp_path: Path) -> None:
    """Law: what `zipfile` writes is read again, at every size around the pieces."""
    path = tmp_path / "a.zip"
    sizes = (0, 1, 2**16 - 1, 2**16, 2**16 + 1, 300_000)
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        with zipfile.ZipFile(path, "w", method) as file:
            for size in sizes:
                file.writestr(f"{size}", bytes(i % 251 for i in range(size)))
        with bounded_archive(path) as file:
            for size in sizes:
                assert read_entry(file, f"{size}", size) == bytes(i % 251 for i in range(size))
                if size:
                    with pytest.raises(zipfile.BadZipFile, match=f"limit {size - 1}"):
                        read_entry(file, f"{size}", size - 1)


# ---- XML ----------------------------------------------------------------------------------------

BOMBS = {
    "many": ("<x>" + "<a/>" * 10_000 + "</x>", "elements"),
    "deep": ("<a>" * 10**6 + "</a>" * 10**6, f"deeper than {MAX_XML_DEPTH}"),
    "attributes": ("<x " + " ".join(f'a{i}=""' for i in range(10**5)) + "/>", "attributes"),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_documents_that_a_parser_makes_gigabytes_of_are_refused(
    bomb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too many elements, levels and attributes, in documents within the limit of bytes."""
    text, cause = BOMBS[bomb]
    monkeypatch.setattr(archives, "MAX_XML_ELEMENTS", 10_000)
    with in_little_memory(), pytest.raises(ModelError, match=f"bomb .*{cause}"):
        check_xml("bomb", text.encode())
    for file, entry, read in READERS:
        path = tmp_path / file
        with zipfile.ZipFile(path, "w") as package:
            package.writestr(entry, text)
        with pytest.raises(ModelError, match=cause):
            read(path)


def test_documents_within_the_limits_are_taken() -> None:
    """At each limit, not before it."""
    check_xml("x", ("<x>" + "<a/>" * (MAX_XML_ELEMENTS - 1) + "</x>").encode())
    check_xml("x", ("<a>" * MAX_XML_DEPTH + "</a>" * MAX_XML_DEPTH).encode())
    some = " ".join(f'a{i}=""' for i in range(MAX_XML_ATTRIBUTES))
    check_xml("x", f"<x><a {some}/></x>".encode())


INCLUSION = "http://www.w3.org/2001/XInclude"


@pytest.mark.slow
def test_what_a_document_wants_to_include_is_not_read(tmp_path: Path) -> None:
    """XInclude names a file, and nothing of it is in any message or result."""
    secret = tmp_path / "secret.xml"
    secret.write_text("<secret>precious</secret>")
    include = f'<xi:include xmlns:xi="{INCLUSION}" href="{secret.as_uri()}" parse="text"/>'
    fmu = f'<fmiModelDescription fmiVersion="2.0" modelName="m" guid="g">{include}'
    for (file, entry, read), text in zip(
        READERS[:2], (f"{fmu}</fmiModelDescription>", ssd(system(include))), strict=True
    ):
        path = tmp_path / file
        with zipfile.ZipFile(path, "w") as package:
            package.writestr(entry, text)
        with pytest.raises(DoublestepError) as info:
            read(path)
        assert "precious" not in str(info.value)


def test_nested_packages_share_one_limit_of_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hundred packages within a package may not each fill what one may."""
    monkeypatch.setattr("master_node.system.ssp.reading.MAX_TOTAL_BYTES", 3_000_000)
    inner = tmp_path / "inner.ssp"
    with zipfile.ZipFile(inner, "w") as package:
        package.writestr("SystemStructure.ssd", ssd(system("")))
        package.writestr("resources/data", bytes(1_000_000))
    kind = 'type="application/x-ssp-package" source="resources/inner.ssp"'
    nested = "".join(f'<ssd:Component name="c{i}" {kind}/>' for i in range(4))
    outer = tmp_path / "outer.ssp"
    with zipfile.ZipFile(outer, "w") as package:
        package.writestr("SystemStructure.ssd", ssd(system(nested)))
        package.write(inner, "resources/inner.ssp")
    with pytest.raises(ModelError, match="all packages together unpack to more than 3000000"):
        run(outer)
