"""Faults of a nemesis, their victims and moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from random import Random
from typing import TypeVar

from tests.faults.nemesis.systems import DrawnSystem

_T = TypeVar("_T")

_PARTS = {
    "in process": ("master", "holder"),
    "launched": ("master", "node", "worker", "holder"),
    "routed": ("master", "node", "worker", "holder", "relay"),
    "served": ("master", "node", "worker", "holder", "relay"),
    "agent": ("master", "node", "worker", "holder", "relay", "agent"),
}
_KINDS = {
    "master": ("kill", "kill", "stop", "interrupt", "full disk"),
    "relay": ("cut", "stall", "delay"),
}
_OF_OTHERS = ("kill", "kill", "stop")
_LONGEST_START = 3.0
_LONGEST_STEP = 5e-3


@dataclass(frozen=True)
class Fault:
    """One of them.

    Attributes:
        kind: ``kill``, ``stop``, ``interrupt``, ``full disk``, ``cut``, ``stall`` or ``delay``.
        part: ``master``, ``node``, ``worker``, ``holder`` of a saved state, ``relay``, ``agent``.
        slave: name of the slave whose part it is; any name where a part is no slave's.
        attempt: after so many attempted steps of all masters together; 0: from the first start.
        delay: so long after that [s].
        duration: of what passes [s].
        which: 0 to 1, where there are several: signals, holders, sizes of a disk.
    """

    kind: str
    part: str
    slave: str
    attempt: int
    delay: float
    duration: float
    which: float

    def __str__(self) -> str:
        whom = f"{self.part} of {self.slave}" if self.part in ("node", "worker", "holder") else ""
        lasting = self.kind in ("stop", "cut", "stall", "delay")
        return (
            f"{self.kind} {whom or self.part}"
            + (f" for {self.duration:.2f} s" if lasting else "")
            + f" {self.delay:.4f} s after attempt {self.attempt}"
        )

    def choose(self, choices: Sequence[_T]) -> _T:
        """One of several."""
        return choices[int(self.which * len(choices))]


def draw_faults(random: Random, system: DrawnSystem, attempts: int) -> list[Fault]:
    """One to three, together or far from each other.

    Args:
        random: decides.
        system: that they happen to.
        attempts: of its undisturbed run.
    """
    faults = [_fault(random, system, attempts) for _ in range(random.choice((1, 1, 2, 3)))]
    if random.random() < 0.5:
        first = faults[0]
        faults[1:] = [
            replace(
                fault,
                attempt=first.attempt,
                delay=first.delay + random.choice((0.0, 0.1, 1.0)) * random.random(),
            )
            for fault in faults[1:]
        ]
    return faults


def _fault(random: Random, system: DrawnSystem, attempts: int) -> Fault:
    part = random.choice(_PARTS[system.way])
    when = random.random()
    attempt = 0 if when < 0.15 else attempts if when > 0.9 else random.randint(1, attempts)
    return Fault(
        random.choice(_KINDS.get(part, _OF_OTHERS)),
        part,
        random.choice(list(system.slaves)),
        attempt,
        random.uniform(0.0, _LONGEST_STEP if attempt else _LONGEST_START),
        random.choice((0.1, 1.0, 4.0)) * random.uniform(0.5, 1.0),
        random.random(),
    )
