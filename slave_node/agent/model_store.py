"""The models in a directory of this host, by file name and by SHA-256.

Who asks over the network names a model and never a path: what is looked up is the list of what
is there.
"""

from __future__ import annotations

import logging
import re
import threading
from dataclasses import dataclass
from pathlib import Path

from protocol.errors import ConfigurationError
from protocol.host.files import DESCRIPTION, Contents, entry_names
from protocol.wire.agents import AgentModel

log = logging.getLogger("slave_node")

_FILE_NAME = re.compile(r"[A-Za-z0-9_.][A-Za-z0-9_.-]{0,127}")


@dataclass(frozen=True, slots=True)
class _Hashed:
    changed: int
    contents: Contents


class ModelStore:
    """FMUs in a directory, files and folders; and Python files, if they are wanted.

    A folder is one if it is an unpacked FMU; others are not looked into. Files may come, go and
    change at any time.

    Args:
        directory: existing.
        python: list files ``.py`` too.

    Raises:
        ConfigurationError: there is no such directory.
    """

    def __init__(self, directory: Path, *, python: bool = False) -> None:
        if not directory.is_dir():
            raise ConfigurationError(
                f"{directory}: no such directory", remedy="name the directory of the models"
            )
        self.directory = directory.absolute()
        self._suffixes = (".fmu", ".py") if python else (".fmu",)
        self._lock = threading.Lock()
        self._hashed: dict[Path, _Hashed] = {}
        self._refused: set[str] = set()

    def models(self) -> tuple[AgentModel, ...]:
        """Models that are there now, sorted by name. Reads files that are new or were changed.

        Raises:
            ConfigurationError: the directory cannot be read.
        """
        with self._lock:
            found = []
            hashed = {}
            for path in self._paths():
                try:
                    entry = hashed[path] = self._entry(path)
                except OSError as error:
                    log.warning("%s cannot be read: %s", path, error)
                    continue
                found.append(AgentModel(path.name, *entry.contents))
            self._hashed = hashed
            return tuple(found)

    def count(self) -> int:
        """Number of models; reads no files."""
        with self._lock:
            return len(self._paths())

    def name_of(self, sha256: str) -> str | None:
        """The file with this hash; None when there is none. Raises as `models`."""
        return next((m.name for m in self.models() if m.sha256 == sha256), None)

    def has(self, name: str) -> bool:
        """True if there is a file of this name. Raises as `models`."""
        with self._lock:
            return any(path.name == name for path in self._paths())

    def _paths(self) -> list[Path]:
        try:
            paths = sorted(
                path
                for path in self.directory.iterdir()
                if (path.suffix.lower() in self._suffixes and path.is_file())
                or (path / DESCRIPTION).is_file()
            )
        except OSError as error:
            raise ConfigurationError(f"{self.directory} cannot be read: {error}") from error
        named = [path for path in paths if _FILE_NAME.fullmatch(path.name)]
        refused = {path.name for path in paths} - {path.name for path in named}
        for name in sorted(refused - self._refused):
            log.warning("%r is left out: use only A-Z a-z 0-9 _ . - in its name", name)
        self._refused = refused
        return named

    def _entry(self, path: Path) -> _Hashed:
        files = sorted(map(path.joinpath, entry_names(path))) if path.is_dir() else [path]
        statuses = [file.stat() for file in files]
        changed = hash((*files, *((status.st_size, status.st_mtime_ns) for status in statuses)))
        known = self._hashed.get(path)
        if known and known.changed == changed:
            return known
        return _Hashed(changed, Contents.of(path))
