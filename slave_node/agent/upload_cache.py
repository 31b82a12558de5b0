"""Models that masters send: put together from pieces, checked, and kept by their SHA-256.

A file gets its name only when it is whole and has the hash that was announced, in one step: what
is there can be loaded. What is loaded is looked at once more.
"""

from __future__ import annotations

import hashlib
import logging
import os
import stat
import threading
import time
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from secrets import token_hex

from protocol.errors import ConfigurationError, ModelError, ProtocolError, SlaveBusyError
from protocol.host.files import file_sha256
from protocol.host.processes import user_id
from protocol.wire.agents import AgentModel, Upload, UploadState, is_sha256

log = logging.getLogger("slave_node")

_IDLE_TIME = 600.0
_GIVEN_UP_TIME = 10.0  # then an upload no longer takes the room of another
_STALE_TIME = 86400.0
MAX_PARTS = 16
_SUFFIX = ".fmu"
_PART_SUFFIX = ".part"


@dataclass
class _Part:
    """An upload under way. ``digest`` is of the ``received`` bytes in ``path``."""

    path: Path
    size: int
    received: int = 0
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)
    touched: float = field(default_factory=time.monotonic)


class UploadCache:
    """A directory with uploaded models. Several processes may use one. All methods are atomic.

    Args:
        directory: made if it is not there; for the user alone.
        largest: length of the largest model [bytes].
        capacity: of all together [bytes]; those that were not used for the longest time go.

    Raises:
        ConfigurationError: the directory cannot be used, or others can write into it.
    """

    def __init__(self, directory: Path, largest: int, capacity: int) -> None:
        self.directory = directory.absolute()
        self.largest = largest
        self._capacity = capacity
        self._parts: dict[str, _Part] = {}
        self._lock = threading.Lock()
        self._suffix = f".{token_hex(4)}{_PART_SUFFIX}"
        try:
            self.directory.mkdir(mode=0o700, parents=True, exist_ok=True)
            status = self.directory.stat()
            self._remove_stale()
        except OSError as error:
            raise ConfigurationError(f"{directory} cannot be used: {error}") from error
        if os.name == "posix" and (
            status.st_uid != user_id() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        ):
            raise ConfigurationError(
                f"{directory}: others can write into the directory of uploaded models",
                remedy=f"chmod 700 {directory}, or name another one with --cache",
            )

    def models(self) -> tuple[AgentModel, ...]:
        """Those that are whole, by their hashes.

        Raises:
            ConfigurationError: the directory cannot be read.
        """
        with self._lock:
            files = self._whole()
        return tuple(
            AgentModel("", path.stem, status.st_size)
            for path, status in sorted(files.items(), key=lambda item: item[0].name)
        )

    def path(self, sha256: str) -> Path | None:
        """The model of this hash, looked at once more; None when there is none.

        Raises:
            ConfigurationError: it cannot be read.
        """
        path = self.directory / f"{sha256}{_SUFFIX}"
        with self._lock:
            try:
                if not is_sha256(sha256) or not path.is_file():
                    return None
                if file_sha256(path) == sha256:
                    os.utime(path)
                    return path
                log.error("%s was changed: removed", path)
                path.unlink()
            except OSError as error:
                raise ConfigurationError(f"{path} cannot be read: {error}") from error
        return None

    def receive(self, upload: Upload, in_use: AbstractSet[str] = frozenset()) -> UploadState:
        """Take a piece, if it comes next; the state says which one does.

        A piece that is there already is left; several masters may send one model at once. An
        upload of which nothing was heard for a while goes when there is no room for another one.

        Args:
            upload: the piece.
            in_use: hashes of models that must stay.

        Raises:
            ConfigurationError: the model is too large, there is no room for it, or a file cannot
                be written.
            SlaveBusyError: there is no room as long as other models are being sent.
            ProtocolError: the size is another one than before.
            ModelError: the whole has another hash; it is thrown away.
        """
        with self._lock:
            try:
                return self._receive(upload, in_use)
            except OSError as error:
                self._drop(upload.sha256)
                raise ConfigurationError(
                    f"cannot keep the model in {self.directory}: {error}"
                ) from error

    def close(self) -> None:
        """Throw away what is not whole."""
        with self._lock:
            for sha256 in list(self._parts):
                self._drop(sha256)

    def _receive(self, upload: Upload, in_use: AbstractSet[str]) -> UploadState:
        whole = self.directory / f"{upload.sha256}{_SUFFIX}"
        if whole.is_file():
            return UploadState(whole.stat().st_size, True)
        if upload.size > self.largest:
            raise ConfigurationError(
                f"a model of {upload.size} bytes is not taken, only up to {self.largest}",
                remedy="raise --upload-limit of the agent, or copy the model there by hand",
            )
        part = self._parts.get(upload.sha256) or self._begin(upload, in_use)
        if part.size != upload.size:
            raise ProtocolError(
                f"the model is being sent with {part.size} bytes, not {upload.size}"
            )
        part.touched = time.monotonic()
        if upload.offset == part.received and upload.data:
            with part.path.open("ab") as file:
                file.write(upload.data)
            part.digest.update(upload.data)
            part.received += len(upload.data)
        if part.received < part.size:
            return UploadState(part.received, False)
        self._finish(upload.sha256, part, whole)
        return UploadState(part.size, True)

    def _begin(self, upload: Upload, in_use: AbstractSet[str]) -> _Part:
        self._make_room(upload.size, in_use)
        part = _Part(self.directory / f"{upload.sha256}{self._suffix}", upload.size)
        part.path.write_bytes(b"")
        self._parts[upload.sha256] = part
        return part

    def _finish(self, sha256: str, part: _Part, whole: Path) -> None:
        found = part.digest.hexdigest()
        if found != sha256:
            self._drop(sha256)
            raise ModelError(
                f"what was sent has the SHA-256 {found}, not {sha256}: thrown away",
                remedy="the file may have been changed while it was sent: run again",
            )
        part.path.replace(whole)
        del self._parts[sha256]
        log.info("received a model of %d bytes, SHA-256 %s", part.size, sha256)

    def _make_room(self, size: int, in_use: AbstractSet[str]) -> None:
        now = time.monotonic()
        for sha256, part in list(self._parts.items()):
            if now - part.touched > _IDLE_TIME:
                self._drop(sha256)
        while len(self._parts) >= MAX_PARTS:
            if not self._drop_given_up(now):
                raise SlaveBusyError(
                    f"{MAX_PARTS} models are being sent already", remedy="wait for these"
                )
        files = self._whole()
        whole = sum(status.st_size for status in files.values())
        while whole + self._sent() + size > self._capacity and self._drop_given_up(now):
            pass
        taken = whole + self._sent()
        for path in sorted(files, key=lambda path: files[path].st_mtime_ns):
            if taken + size <= self._capacity:
                break
            if path.stem not in in_use:
                path.unlink(missing_ok=True)
                taken -= files[path].st_size
                log.info("made room: removed the uploaded model %s", path.stem)
        if taken + size > self._capacity:
            if taken - self._sent() + size <= self._capacity:
                raise SlaveBusyError(
                    f"there is no room for a model of {size} bytes while others are being sent",
                    remedy="wait for these",
                )
            raise ConfigurationError(
                f"there is no room for a model of {size} bytes: {taken} of {self._capacity} are "
                "in use",
                remedy="raise --cache-limit of the agent",
            )

    def _sent(self) -> int:
        """Room that the models need that are being sent [bytes]."""
        return sum(part.size for part in self._parts.values())

    def _drop_given_up(self, now: float) -> bool:
        """Throw away the upload that is idle for longest, if it is for long; whether it was."""
        sha256 = min(self._parts, key=lambda name: self._parts[name].touched, default=None)
        if sha256 is None or now - self._parts[sha256].touched <= _GIVEN_UP_TIME:
            return False
        self._drop(sha256)
        return True

    def _drop(self, sha256: str) -> None:
        part = self._parts.pop(sha256, None)
        if part is not None:
            part.path.unlink(missing_ok=True)

    def _whole(self) -> dict[Path, os.stat_result]:
        files = {}
        try:
            for path in self.directory.glob(f"*{_SUFFIX}"):
                with suppress(FileNotFoundError):  # another process made room
                    if is_sha256(path.stem):
                        files[path] = path.stat()
        except OSError as error:
            raise ConfigurationError(f"{self.directory} cannot be read: {error}") from error
        return files

    def _remove_stale(self) -> None:
        """Remove files that killed processes have left behind."""
        for path in self.directory.glob(f"*{_PART_SUFFIX}"):
            if time.time() - path.stat().st_mtime > _STALE_TIME:
                path.unlink(missing_ok=True)
