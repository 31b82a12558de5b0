"""The files of a checkpoint, in the folder ``checkpoint`` of a results directory.

* ``system.json``: what is run;
* ``run.zip``: ``run.json``, where the run stood, and ``NAME.state``, the serialised state of each
  slave that has one; replaced as a whole;
* ``NAME.FIRST.calls``: what slave NAME was told from step FIRST on; only ever grows. ``run.json``
  says how much of it counts.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple, Self
from zlib import crc32

from master_node.results.files import (
    CHECKPOINT_FOLDER,
    cannot_read,
    cannot_write,
    malformed,
    replacing,
    synchronize_folder,
)
from master_node.slaves.call_log import CallLog, LoggedStep, SavedState
from protocol.errors import DoublestepError, ResultsError
from protocol.host.archives import UNREADABLE, bounded_archive, read_entry
from protocol.host.new_files import open_new, open_old, remove_folder
from protocol.wire.keys import is_name

_SYSTEM_FILE = "system.json"
_RUN_FILE = "run.zip"
_RUN = "run.json"
_VERSION = 3
_LENGTH = Struct("<I")
_LARGEST = 2**30

_MALFORMED = (*UNREADABLE, LookupError, TypeError, AttributeError, OverflowError)
"""All that damaged bytes become on the way through zipfile and json."""


class SavedSlave(NamedTuple):
    """Recipe that brings a slave to where the run stood.

    Attributes:
        state: to begin with, or None.
        first: number of the first step that is known.
        log: holds the steps.
    """

    state: SavedState | None
    first: int
    log: CallLog

    @staticmethod
    def of(log: CallLog) -> SavedSlave:
        """From what is kept in memory."""
        return SavedSlave(log.state, log.first, log)


@dataclass(frozen=True)
class Checkpoint:
    """Where a run stood.

    Attributes:
        number: of steps that the slaves had taken.
        run: everything else, as plain data for JSON.
        slaves: by name.
    """

    number: int
    run: Mapping[str, Any]
    slaves: Mapping[str, SavedSlave]


@dataclass
class _CallsFile:
    """Part of a file of calls that counts.

    Attributes:
        first: number of its first step.
        steps, size, checksum: of what counts: their count, bytes, CRC-32.
    """

    first: int
    steps: int = 0
    size: int = 0
    checksum: int = 0

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Self:
        """The file that a header describes; raises TypeError where the header is wrong."""
        if not all(type(value) is int and value >= 0 for value in told.values()):
            raise TypeError(f"{told} are not numbers")
        return cls(**told)


@dataclass
class CheckpointStore:
    """Reads and writes them.

    Args:
        directory: of the results.
        system: what is run, as plain data for JSON; None: the folder is there already.
    """

    directory: Path
    system: Mapping[str, Any] | None = None
    _calls: dict[str, _CallsFile] = field(default_factory=dict)

    @property
    def _folder(self) -> Path:
        return self.directory / CHECKPOINT_FOLDER

    @property
    def files(self) -> tuple[Path, ...]:
        """All that says what is run and where it stood."""
        return self._folder, self._folder / _SYSTEM_FILE, self._folder / _RUN_FILE

    @property
    def remedy(self) -> str:
        """Remedy for a run that was broken off."""
        return f"`master-node resume {self.directory}` goes on from there"

    def begin(self) -> None:
        """Replace the checkpoint of an earlier run.

        Raises:
            ResultsError: it cannot be written.
        """
        if self.system is None:
            return
        try:
            self.remove()
            self._folder.mkdir()
            with replacing(self._folder / _SYSTEM_FILE) as file:
                file.write(json.dumps(self.system, indent=2).encode())
            synchronize_folder(self._folder)
            synchronize_folder(self.directory)
        except OSError as error:
            raise cannot_write(self._folder, error) from error

    def remove(self) -> None:
        """The run needs no checkpoint any more."""
        remove_folder(self._folder)

    def write(self, checkpoint: Checkpoint) -> None:
        """Put a checkpoint in the place of the last one, as a whole or not at all.

        Raises:
            ResultsError: it cannot be written.
        """
        path = self._folder / _RUN_FILE
        try:
            calls = {
                name: self._append(name, slave, checkpoint.number)
                for name, slave in checkpoint.slaves.items()
            }
            header = {
                "version": _VERSION,
                "number": checkpoint.number,
                "run": checkpoint.run,
                "slaves": {
                    name: {
                        "state": None if slave.state is None else slave.state.number,
                        **vars(calls[name]),
                    }
                    for name, slave in checkpoint.slaves.items()
                },
            }
            with replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
                archive.writestr(_RUN, json.dumps(header))
                for name, slave in checkpoint.slaves.items():
                    if slave.state is not None:
                        archive.writestr(f"{name}.state", slave.state.data)
            synchronize_folder(self._folder)
        except OSError as error:
            raise cannot_write(Path(error.filename or path), error) from error
        self._remove_old(calls)
        self._calls = calls

    def load(self) -> tuple[Mapping[str, Any], Checkpoint | None]:
        """The system, and where its run stood; None: it was broken off before that was written.

        Raises:
            ResultsError: no run began to step here, or a file cannot be read.
        """
        path = self._folder / _SYSTEM_FILE
        if self._folder.is_symlink():
            raise malformed(self._folder, "it is a link, which is not followed")
        try:
            system = json.loads(path.read_bytes())
            path = self._folder / _RUN_FILE
            if not path.exists():
                return system, None
            with bounded_archive(path) as archive:
                header = json.loads(read_entry(archive, _RUN, _LARGEST))
                if header["version"] != _VERSION:
                    raise malformed(path, f"version {header['version']} instead of {_VERSION}")
                slaves = {}
                for name, told in header["slaves"].items():
                    if not is_name(name):
                        raise malformed(path, f"{name!r:.200} is not the name of a slave")
                    number = told.pop("state")
                    state = None
                    if number is not None:
                        state = SavedState(read_entry(archive, f"{name}.state", _LARGEST), number)
                    self._calls[name] = calls = _CallsFile.of(told)
                    log = CallLog()
                    log.resume(state, calls.first, list(self._read(name, calls)))
                    slaves[name] = SavedSlave(state, calls.first, log)
            return system, Checkpoint(header["number"], header["run"], slaves)
        except FileNotFoundError as error:
            raise ResultsError(
                f"{self.directory} holds no checkpoint",
                remedy="a run can be resumed when it began to step, did not get to its end, and "
                "its checkpoint_interval was not 0; run the system again",
            ) from error
        except OSError as error:
            raise cannot_read(path, error) from error
        except _MALFORMED as error:
            raise malformed(path, f"no checkpoint: {error}") from error

    def _path(self, name: str, calls: _CallsFile) -> Path:
        return self._folder / f"{name}.{calls.first}.calls"

    def _append(self, name: str, slave: SavedSlave, number: int) -> _CallsFile:
        """Bring a slave's steps to the disk, behind those that are there."""
        old = self._calls.get(name)
        calls = _CallsFile(slave.first)
        if old is not None and old.first == slave.first:
            calls = _CallsFile(**vars(old))
        path = self._path(name, calls)
        with open_old(path) if calls.size else open_new(path) as file:
            file.truncate(calls.size)
            file.seek(calls.size)
            for step in slave.log.steps(calls.first + calls.steps, number):
                data = step.to_bytes()
                record = _LENGTH.pack(len(data)) + data
                file.write(record)
                calls.steps += 1
                calls.size += len(record)
                calls.checksum = crc32(record, calls.checksum)
            file.flush()
            os.fsync(file.fileno())
        return calls

    def _read(self, name: str, calls: _CallsFile) -> Iterator[LoggedStep]:
        path = self._path(name, calls)
        with path.open("rb") as file:
            data = file.read(min(calls.size, path.stat().st_size))
        if len(data) != calls.size or crc32(data) != calls.checksum:
            raise malformed(path, "damaged")
        at = 0
        while at < len(data):
            (length,) = _LENGTH.unpack_from(data, at)
            at += _LENGTH.size
            try:
                yield LoggedStep.from_bytes(data[at : at + length])
            except DoublestepError as error:
                raise malformed(path, error.cause) from error
            at += length

    def _remove_old(self, calls: Mapping[str, _CallsFile]) -> None:
        for name, old in self._calls.items():
            if name in calls and old.first != calls[name].first:
                with suppress(OSError):
                    self._path(name, old).unlink()
