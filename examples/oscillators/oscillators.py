"""Reference solutions of the coupled oscillators, whole and without a co-simulation.

The equations are those of the FMUs in ``src/``. Everything else is read: parameters, start values
and connections from the system file, what it leaves out from ``modelDescription.xml``.

::

    mass           m x'' = c_left (x_left - x) + d_left (v_left - v)
                         + c_right (x_right - x) + d_right (v_right - v)
    van_der_pol      x'' = mu (1 - x^2) x' - x + c (x_other - x) + d (v_other - v)
    step_source        y = before for t < t_step, after for t >= t_step

With numpy and scipy only: neither a built FMU nor Doublestep is needed.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import OdeSolution, solve_ivp
from scipy.linalg import expm

FloatArray = NDArray[np.float64]

FOLDER = Path(__file__).resolve().parent

_LONGEST_STEP = 0.02
"""Largest internal step of van der Pol oscillators [s], for a dense output as good as the steps."""


@dataclass(frozen=True, eq=False)
class Oscillators:
    """Parameters in a system file, with the FMUs' start values where it says nothing.

    Attributes:
        start_time, stop_time: [s].
        models: the model of each slave, by the slave's name.
        values: the start value of each ``slave.variable`` that has one, parameters included.
        sources: the output that is connected to an input, both as ``slave.variable``.
    """

    start_time: float
    stop_time: float
    models: Mapping[str, str]
    values: Mapping[str, float]
    sources: Mapping[str, str]

    def with_values(self, values: Mapping[str, float]) -> Oscillators:
        """System with other start values and parameters."""
        if unknown := values.keys() - self.values.keys():
            raise KeyError(f"no variable with a start value: {', '.join(sorted(unknown))}")
        return replace(self, values={**self.values, **values})

    def slaves(self, model: str) -> list[str]:
        """The names of the slaves that are of this model."""
        return [name for name, its_model in self.models.items() if its_model == model]

    @property
    def states(self) -> list[str]:
        """The names of all states: x and v of each slave that has them."""
        moving = [name for name in self.models if f"{name}.x" in self.values]
        return [f"{name}.{state}" for name in moving for state in ("x", "v")]

    @property
    def start(self) -> FloatArray:
        """The start values of the states, shape (n,)."""
        return np.array([self.values[name] for name in self.states])

    def signal(self, slave: str, t: float) -> float:
        """The output y of a step_source at the time t [s]."""
        name = "after" if t >= self.values[f"{slave}.t_step"] else "before"
        return self.values[f"{slave}.{name}"]

    def input_row(self, name: str, t: float) -> FloatArray:
        """The row w, shape (n + 1,), by which an input is w (s, 1) at t [s]; s are the states.

        An input is connected to a state, is connected to a step_source, or keeps its start value.
        """
        row = np.zeros(len(self.states) + 1)
        source = self.sources.get(name)
        if source is None:
            row[-1] = self.values[name]
        elif source in self.states:
            row[self.states.index(source)] = 1.0
        else:
            row[-1] = self.signal(source.partition(".")[0], t)
        return row


def read_oscillators(file: Path) -> Oscillators:
    """Read a system file of this folder."""
    system = tomllib.loads(file.read_text(encoding="utf-8"))
    models = {name: Path(table["model"]).stem for name, table in system["slaves"].items()}
    return Oscillators(
        start_time=float(system["simulation"].get("start_time", 0.0)),
        stop_time=float(system["simulation"]["stop_time"]),
        models=models,
        values={
            f"{name}.{variable}": float(value)
            for name, model in models.items()
            for variable, value in {
                **_start_values(model),
                **system["slaves"][name].get("parameters", {}),
            }.items()
        },
        sources={connection["to"]: connection["from"] for connection in system["connections"]},
    )


@cache
def _start_values(model: str) -> dict[str, float]:
    """The start values in the model description of an FMU of this folder."""
    root = ElementTree.parse(FOLDER / "src" / model / "modelDescription.xml")
    return {
        variable.attrib["name"]: float(real.attrib["start"])
        for variable in root.iterfind("ModelVariables/ScalarVariable")
        for real in variable.iterfind("Real[@start]")
    }


# ---- Masses: linear, with inputs that jump ------------------------------------------------------


def mass_matrix(system: Oscillators, t: float) -> FloatArray:
    """The matrix M, shape (n + 1, n + 1), of (s, 1)' = M (s, 1): the masses at the time t [s]."""
    size = len(system.states) + 1
    matrix, rows = np.zeros((size, size)), np.eye(size)
    for i, name in enumerate(system.slaves("mass")):
        x, v = 2 * i, 2 * i + 1
        matrix[x] = rows[v]
        for side in ("left", "right"):
            for quantity, own, constant in (("x", x, "c"), ("v", v, "d")):
                neighbour = system.input_row(f"{name}.{quantity}_{side}", t)
                matrix[v] += system.values[f"{name}.{constant}_{side}"] * (neighbour - rows[own])
        matrix[v] /= system.values[f"{name}.m"]
    return matrix


def move_masses(system: Oscillators, times: FloatArray) -> FloatArray:
    """The exact states at the times [s], shape (n_times, n): matrix exponentials.

    From one jump of a step_source to the next the system is linear with constant coefficients.
    """
    jumps = {system.values[f"{name}.t_step"] for name in system.slaves("step_source")}
    later = sorted(jump for jump in jumps if jump > system.start_time)
    state = np.append(system.start, 1.0)
    moved = np.empty((len(times), len(state)))
    for begin, end in pairwise([system.start_time, *later, math.inf]):
        matrix = mass_matrix(system, begin)
        within = (times >= begin) & (times < end)
        moved[within] = expm(np.multiply.outer(times[within] - begin, matrix)) @ state
        if end < math.inf:
            state = expm((end - begin) * matrix) @ state
    return moved[:, :-1]


# ---- Van der Pol oscillators: not linear --------------------------------------------------------


def move_van_der_pol(system: Oscillators, times: FloatArray) -> FloatArray:
    """The states at the times [s], shape (n_times, n), to about 1e-12."""
    states: FloatArray = _van_der_pol_solution(system)(times).T
    return states


@lru_cache(maxsize=8)
def _van_der_pol_solution(system: Oscillators) -> OdeSolution:
    """The states as a function of the time, integrated once for the whole simulated time."""
    slaves = system.slaves("van_der_pol")
    mu, c, d = (
        np.array([system.values[f"{name}.{p}"] for name in slaves]) for p in ("mu", "c", "d")
    )
    rows = np.array(
        [
            [system.input_row(f"{name}.{quantity}_other", system.start_time) for name in slaves]
            for quantity in ("x", "v")
        ]
    )

    def derivatives(_: float, s: FloatArray) -> FloatArray:
        (x, v), (x_other, v_other) = s.reshape(-1, 2).T, rows @ np.append(s, 1.0)
        acceleration = mu * (1.0 - x * x) * v - x + c * (x_other - x) + d * (v_other - v)
        return np.column_stack([v, acceleration]).ravel()

    solution = solve_ivp(
        derivatives,
        (system.start_time, system.stop_time),
        system.start,
        method="DOP853",
        rtol=1e-12,
        atol=1e-13,
        max_step=_LONGEST_STEP,
        dense_output=True,
    )
    assert solution.success, solution.message
    return solution.sol


# ---- The systems --------------------------------------------------------------------------------

Reference = Callable[[Oscillators, FloatArray], FloatArray]
"""From a system and times [s], shape (n_times,), to its states, shape (n_times, n)."""

SYSTEMS: dict[str, tuple[Path, Reference]] = {
    "two_mass": (FOLDER / "two_mass.toml", move_masses),
    "van_der_pol": (FOLDER / "van_der_pol.toml", move_van_der_pol),
    "chain": (FOLDER / "chain.toml", move_masses),
    "kick": (FOLDER / "kick.toml", move_masses),
}


@cache
def load(name: str) -> Oscillators:
    """The system of this name, read once."""
    return read_oscillators(SYSTEMS[name][0])


def reference_solution(
    name: str,
    names: Sequence[str],
    times: ArrayLike,
    values: Mapping[str, float] | None = None,
) -> FloatArray:
    """Reference for a co-simulation of a system.

    Args:
        name: one of `SYSTEMS`.
        names: outputs as ``slave.variable``, as in ``Result.names``.
        times: [s], shape (n_times,), none before the start time.
        values: start values and parameters other than those of the file, as ``slave.variable``:
            ``{"source.t_step": t}`` gives the motion as if the jump came at t.

    Returns:
        The outputs at the times, shape (n_times, len(names)).

    Raises:
        KeyError: there is no such system, output or value.
        ValueError: a time lies before the start time.
    """
    system, move = load(name), SYSTEMS[name][1]
    if values:
        system = system.with_values(values)
    at = np.asarray(times, float)
    if at.size and at.min() < system.start_time:
        raise ValueError(f"{at.min():g} s is before the start at {system.start_time:g} s")
    columns = dict(zip(system.states, move(system, at).T, strict=True))
    for source in system.slaves("step_source"):
        columns[f"{source}.y"] = np.array([system.signal(source, t) for t in at])
    return np.column_stack([columns[name] for name in names])
