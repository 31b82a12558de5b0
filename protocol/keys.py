"""Key expressions, built and parsed in this one place.

::

    doublestep/slaves/<slave>/<instance>/<verb>     queryable: one verb, or a list of calls
    doublestep/slaves/<slave>/<instance>/alive      liveliness token of a slave
    doublestep/masters/<run>/alive                  liveliness token of a master
    doublestep/masters/<run>/status                 queryable: what a master says of its run
    doublestep/routers/<router>/alive               liveliness token of a router
    doublestep/routers/<router>/status              queryable: what a router says of itself

``<instance>`` is made anew by each slave process, so that a query can never reach two slaves of
the same name, nor one that was started again in between.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from protocol.errors import ConfigurationError

EXECUTE = "execute"
CLAIM = "claim"
RELEASE = "release"
STATUS = "status"
ABORT = "abort"
_ALIVE = "alive"

_ROOT = "doublestep"
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,128}")


def check_name(name: str, what: str = "slave name") -> str:
    """``name`` itself when it is safe as a part of a key and of a file name.

    Raises:
        ConfigurationError: anything but 1 to 128 of ``A-Z a-z 0-9 _ . -``, or ``.`` or ``..``.
    """
    if not _NAME.fullmatch(name) or name in (".", ".."):
        raise ConfigurationError(
            f"{name!r} is not a valid {what}",
            remedy="use 1 to 128 characters out of A-Z a-z 0-9 _ . -",
        )
    return name


@dataclass(frozen=True, slots=True, order=True)
class SlaveKey:
    """Address of one slave process on the bus."""

    name: str
    instance: str

    def verb(self, verb: str) -> str:
        """The key on which this slave serves ``verb``."""
        return f"{_ROOT}/slaves/{self.name}/{self.instance}/{verb}"

    @property
    def alive(self) -> str:
        """The key of its liveliness token."""
        return self.verb(_ALIVE)

    @staticmethod
    def from_alive(key: str) -> SlaveKey | None:
        """The address in the key of a liveliness token; None when it is none of a slave."""
        parts = key.split("/")
        if len(parts) == 5 and parts[:2] == [_ROOT, "slaves"] and parts[4] == _ALIVE:
            return SlaveKey(parts[2], parts[3])
        return None


@dataclass(frozen=True, slots=True, order=True)
class MasterKey:
    """Address of the master of one run."""

    run: str

    @property
    def alive(self) -> str:
        """The key of its liveliness token."""
        return f"{_ROOT}/masters/{self.run}/{_ALIVE}"

    @property
    def status(self) -> str:
        """The key on which it tells of its run."""
        return f"{_ROOT}/masters/{self.run}/{STATUS}"

    @staticmethod
    def from_alive(key: str) -> MasterKey | None:
        """The address in the key of a liveliness token; None when it is none of a master."""
        parts = key.split("/")
        if len(parts) == 4 and parts[:2] == [_ROOT, "masters"] and parts[3] == _ALIVE:
            return MasterKey(parts[2])
        return None


@dataclass(frozen=True, slots=True, order=True)
class RouterKey:
    """Address of one router process."""

    instance: str

    @property
    def alive(self) -> str:
        """The key of its liveliness token."""
        return f"{_ROOT}/routers/{self.instance}/{_ALIVE}"

    @property
    def status(self) -> str:
        """The key on which it tells of itself."""
        return f"{_ROOT}/routers/{self.instance}/{STATUS}"

    @staticmethod
    def from_alive(key: str) -> RouterKey | None:
        """The address in the key of a liveliness token; None when it is none of a router."""
        parts = key.split("/")
        if len(parts) == 4 and parts[:2] == [_ROOT, "routers"] and parts[3] == _ALIVE:
            return RouterKey(parts[2])
        return None


def alive_routers() -> str:
    """Matches the liveliness tokens of all routers."""
    return f"{_ROOT}/routers/*/{_ALIVE}"


def alive_slaves(name: str = "*") -> str:
    """Matches the liveliness tokens of all slaves, or of all those called ``name``."""
    return f"{_ROOT}/slaves/{name}/*/{_ALIVE}"


def alive_master(run: str) -> str:
    """The key of the liveliness token of the master of ``run``; of all masters for ``*``."""
    return MasterKey(run).alive
