"""Systems that a seed draws: small ones, of examples, with any settings and in any way to run."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Literal

from tests.support.places import ROOT

Way = Literal["in process", "launched", "routed", "served", "agent"]
"""Ways to run slaves: by the master, by it through a router, by hand, or by an agent."""

_WAYS: tuple[Way, ...] = ("in process", "launched", "launched", "routed", "served", "agent")

EXAMPLES = ROOT / "examples"

_SYSTEMS: Mapping[str, float] = {
    "quarter_car/displacement.toml": 0.3,
    "quarter_car/displacement_force.toml": 0.3,
    "quarter_car/displacement_python.toml": 0.3,
    "oscillators/two_mass.toml": 0.6,
    "oscillators/kick.toml": 1.5,
    "oscillators/van_der_pol.toml": 2.0,
    "external_inputs/bump.toml": 4.0,
    "no_rollback/wheel_without_state.toml": 0.3,
    "no_rollback/nothing_saved.toml": 0.3,
}
"""The files, and how long each is simulated [s]."""


@dataclass(frozen=True)
class DrawnSystem:
    """System that a seed runs.

    Attributes:
        name: of the example.
        tables: of the system file, but for ``[bus]``; models have absolute paths.
        way: how slaves are run.
    """

    name: str
    tables: Mapping[str, Any]
    way: Way

    def __str__(self) -> str:
        states = {name: slave.get("state", "best") for name, slave in self.slaves.items()}
        settings = self.tables["simulation"] | self.tables["results"]
        return f"{self.name}, {self.way}, states {states}, {settings}"

    @property
    def slaves(self) -> Mapping[str, Mapping[str, Any]]:
        """The tables of the slaves."""
        slaves: Mapping[str, Mapping[str, Any]] = self.tables["slaves"]
        return slaves

    def tables_to_run(self, endpoint: str) -> dict[str, Any]:
        """The tables of the system file to run it.

        Args:
            endpoint: at which the master listens or finds the router, as it needs.
        """
        tables = deepcopy(dict(self.tables))
        if self.way == "routed":
            tables["bus"] = {"mode": "client", "connect": [endpoint]}
        if self.way in ("served", "agent"):
            tables["bus"] = {"listen": [endpoint]}
        for slave in tables["slaves"].values():
            if self.way == "served":
                del slave["model"]
            if self.way == "agent":
                slave["host"] = "agent"
        return tables


def draw_system(random: Random, fmus: Path) -> DrawnSystem:
    """A system whose settings may or may not go together.

    Args:
        random: decides.
        fmus: folder with the FMUs of each example in a folder.
    """
    name = random.choice(list(_SYSTEMS))
    way = random.choice(_WAYS)
    tables = tomllib.loads((EXAMPLES / name).read_text(encoding="utf-8"))
    tables["simulation"] |= _simulation(random, _SYSTEMS[name])
    tables["results"] = _results(random)
    folder = Path(name).parent
    for slave in tables["slaves"].values():
        slave["model"] = _place(folder, slave["model"], fmus)
        state = random.choice(("native", "fork", "fork", "replay", "none", ""))
        if state and "state" not in slave:
            slave["state"] = state
    for signal in tables.get("inputs", {}).values():
        for key in {"table", "function"} & (signal.keys() if isinstance(signal, dict) else set()):
            signal[key] = str(EXAMPLES / folder / signal[key])
    return DrawnSystem(name, tables, way)


def _place(folder: Path, model: str, fmus: Path) -> str:
    root = EXAMPLES if ".py:" in model else fmus
    return str((root / folder / model).resolve())


def _simulation(random: Random, duration: float) -> dict[str, Any]:
    estimator = random.choice(("mod", "mod", "rich", "none"))
    chosen: dict[str, Any] = {
        "stop_time": duration,
        "estimator": estimator,
        "sequence": random.choice(("jacobi", "gauss-seidel")),
        "order": random.choice((0, 1, 2, 3, "auto", "auto")),
        "checkpoint_interval": random.choice((0.0, 0.01, 0.01, 0.1, 10.0)),
        "initial_step_size": duration / random.randint(100, 200),
        "largest_step_size": duration / random.randint(50, 150),
        "controller": random.choice(("pi", "elementary")),
    }
    if estimator == "none":
        del chosen["largest_step_size"]
        return chosen
    chosen["examine"] = random.random() < 0.5
    if random.random() < 0.3:
        chosen["output_interval"] = duration / random.randint(20, 300)
    if random.random() < 0.3:
        chosen["events"] = [duration * random.uniform(0.1, 0.9)]
    if random.random() < 0.1:
        chosen["evaluate_outputs"] = True
    return chosen


def _results(random: Random) -> dict[str, Any]:
    formats = ["csv", "arrow", "parquet", "mat"]
    return {
        "formats": random.sample(formats, random.randint(1, len(formats))),
        "every": random.choice((1, 1, 1, 3)),
    }
