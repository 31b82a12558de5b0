"""Key expressions, built and parsed in this one place.

::

    doublestep/slaves/<slave>/<instance>/<verb>     queryable: one verb, or a list of calls
    doublestep/slaves/<slave>/<instance>/alive      liveliness token of a slave
    doublestep/masters/<run>/alive                  liveliness token of a master
    doublestep/masters/<run>/status                 queryable: what a master says of its run
    doublestep/routers/<router>/alive               liveliness token of a router
    doublestep/routers/<router>/status              queryable: what a router says of itself
    doublestep/agents/<agent>/<instance>/<verb>     queryable: one verb of an agent
    doublestep/agents/<agent>/<instance>/alive      liveliness token of an agent

``<instance>`` is made anew by each slave or agent process, so that a query can never reach two of
the same name, nor one that was started again in between. That of a slave which was started for a
run begins with the id of the run and a dash: it is for that run alone, and is not found by name.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from secrets import token_hex

from protocol.errors import ConfigurationError

EXECUTE = "execute"
CLAIM = "claim"
RELEASE = "release"
STATUS = "status"
ABORT = "abort"
MODELS = "models"
UPLOAD = "upload"
START = "start"
STOP = "stop"
OUTPUT = "output"
_ALIVE = "alive"

_ROOT = "doublestep"
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,128}")


def is_name(name: str) -> bool:
    """True when ``name`` is safe as a part of a key and of a file name; see `check_name`."""
    return _NAME.fullmatch(name) is not None and name not in (".", "..")


def check_name(name: str, what: str = "slave name") -> str:
    """``name`` itself when it is safe as a part of a key and of a file name.

    Raises:
        ConfigurationError: anything but 1 to 128 of ``A-Z a-z 0-9 _ . -``, or ``.`` or ``..``.
    """
    if not is_name(name):
        raise ConfigurationError(
            f"{name!r} is not a valid {what}",
            remedy="use 1 to 128 characters out of A-Z a-z 0-9 _ . -",
        )
    return name


def _names_in(key: str, kind: str, count: int) -> list[str]:
    """The names in the key of a liveliness token; none if it is no such key, or one is not valid.

    Peers choose them, and they go into other keys and onto terminals.
    """
    root, _, rest = key.partition("/")
    *names, last = rest.split("/")
    is_token = root == _ROOT and names[:1] == [kind] and last == _ALIVE
    names = names[1:]
    return names if is_token and len(names) == count and all(map(is_name, names)) else []


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

    @property
    def is_of_run(self) -> bool:
        """True if it was started for one run; all others are found by name."""
        return "-" in self.instance

    @staticmethod
    def of_run(name: str, run: str) -> SlaveKey:
        """A new address of a slave that is started for a run."""
        return SlaveKey(name, f"{run}-{token_hex(4)}")

    @staticmethod
    def from_alive(key: str) -> SlaveKey | None:
        """The address in the key of a liveliness token; None when it is none of a slave."""
        names = _names_in(key, "slaves", 2)
        return SlaveKey(*names) if names else None


@dataclass(frozen=True, slots=True, order=True)
class AgentKey:
    """Address of one agent process on the bus."""

    name: str
    instance: str

    def verb(self, verb: str) -> str:
        """The key on which this agent serves ``verb``."""
        return f"{_ROOT}/agents/{self.name}/{self.instance}/{verb}"

    @property
    def alive(self) -> str:
        """The key of its liveliness token."""
        return self.verb(_ALIVE)

    @property
    def status(self) -> str:
        """The key on which it tells of itself."""
        return self.verb(STATUS)

    @staticmethod
    def from_alive(key: str) -> AgentKey | None:
        """The address in the key of a liveliness token; None when it is none of an agent."""
        names = _names_in(key, "agents", 2)
        return AgentKey(*names) if names else None


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
        names = _names_in(key, "masters", 1)
        return MasterKey(*names) if names else None


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
        names = _names_in(key, "routers", 1)
        return RouterKey(*names) if names else None


def alive_routers() -> str:
    """Matches the liveliness tokens of all routers."""
    return f"{_ROOT}/routers/*/{_ALIVE}"


def alive_agents(name: str = "*") -> str:
    """Matches the liveliness tokens of all agents, or of all those called ``name``."""
    return f"{_ROOT}/agents/{name}/*/{_ALIVE}"


def alive_slaves(name: str = "*") -> str:
    """Matches the liveliness tokens of all slaves, or of all those called ``name``."""
    return f"{_ROOT}/slaves/{name}/*/{_ALIVE}"


def alive_master(run: str) -> str:
    """The key of the liveliness token of the master of ``run``; of all masters for ``*``."""
    return MasterKey(run).alive
