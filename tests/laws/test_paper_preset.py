"""``preset = "paper"``: the method as Schierz, Arnold and Clauß have it, in one key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from master_node import SimulationSettings, System, load_system
from master_node.numerics.extrapolation import InputPolynomial
from protocol.errors import ConfigurationError
from tests.support.quarter_car_case import CHASSIS, WHEEL, car, run_slaves

PAPER: dict[str, Any] = {
    "order": 1,
    "derivative_points": 0,
    "constants": "paper",
    "controller": "elementary",
    "discontinuities": False,
    "initial_history": "rest",
    "coupling": "explicit",
}
"""Settings of the preset, key by key."""

OTHERS: dict[str, Any] = {
    "order": 3,
    "constants": "exact",
    "controller": "pi",
    "discontinuities": True,
    "initial_history": "none",
    "coupling": "auto",
}
"""Another value for each key that can have one beside it."""


def written(path: Path, **simulation: Any) -> System:
    """A system from a file."""

    def toml(value: Any) -> str:
        return f'"{value}"' if isinstance(value, str) else str(value).lower()

    lines = [f"{key} = {toml(value)}" for key, value in simulation.items()]
    file = path / "system.toml"
    file.write_text("[simulation]\nstop_time = 1.0\n" + "\n".join(lines) + "\n[slaves.a]\n")
    return load_system(file)


def test_it_stands_for_these_keys_and_no_other(tmp_path: Path) -> None:
    """All others keep their defaults."""
    settings = written(tmp_path, preset="paper").simulation
    named = settings.model_dump()
    defaults = SimulationSettings(stop_time=1.0).model_dump()
    assert {key: named[key] for key in PAPER} == PAPER
    changed = {key for key, value in defaults.items() if named[key] != value}
    assert changed == {"preset", *PAPER}
    assert settings.polynomial == InputPolynomial(1, 0)
    assert settings.rests_before_start


@pytest.mark.parametrize("key", OTHERS)
def test_a_key_beside_it_wins(tmp_path: Path, key: str) -> None:
    """In a file and in Python alike; the other keys of the preset stay."""
    given = {"preset": "paper", key: OTHERS[key]}
    for settings in (
        written(tmp_path, **given).simulation,
        System(simulation={"stop_time": 1.0, **given}, slaves={"a": {}}).simulation,
    ):
        found = settings.model_dump()
        assert {k: found[k] for k in PAPER} == {**PAPER, key: OTHERS[key]}


@pytest.mark.parametrize("key", [key for key in OTHERS if key != "order"])
def test_on_the_command_line_it_wins_over_the_file(tmp_path: Path, key: str) -> None:
    """The preset on the command line replaces all that the file says of the method."""
    system = written(tmp_path, **{key: OTHERS[key]}, relative_tolerance=1e-3)
    found = system.with_simulation(preset="paper").simulation.model_dump()
    assert {k: found[k] for k in PAPER} == PAPER
    assert found["relative_tolerance"] == 1e-3


@pytest.mark.parametrize(("order", "kept"), [("auto", 1), (0, 0), (1, 1), (2, 2), (3, 3)])
def test_a_fixed_order_of_the_file_stays(tmp_path: Path, order: Any, kept: int) -> None:
    """The paper has them all; it only has no choice among them."""
    system = written(tmp_path, order=order)
    assert system.with_simulation(preset="paper").simulation.order == kept
    derivatives = written(tmp_path, order=3, derivative_points=1)
    assert derivatives.with_simulation(preset="paper").simulation.polynomial == (3, 0)


@pytest.mark.parametrize("key", OTHERS)
def test_a_key_beside_it_on_the_command_line_wins(tmp_path: Path, key: str) -> None:
    """A key on the command line wins over the preset, there or in the file."""
    for system, preset in (
        (written(tmp_path), {"preset": "paper"}),
        (written(tmp_path, preset="paper"), {}),
    ):
        found = system.with_simulation(**preset, **{key: OTHERS[key]}).simulation.model_dump()
        assert {k: found[k] for k in PAPER} == {**PAPER, key: OTHERS[key]}


def test_what_contradicts_it_is_refused(tmp_path: Path) -> None:
    """Its constants hold for values only and for slaves that step at once."""
    for keys in ({"derivative_points": 1}, {"sequence": "gauss-seidel"}):
        with pytest.raises(ConfigurationError, match='constants = "paper" hold for'):
            written(tmp_path, preset="paper", **keys)
    with pytest.raises(ConfigurationError, match=r"preset = 'papers': .*'paper'"):
        written(tmp_path, preset="papers")
    free = written(tmp_path, preset="paper", constants="exact", sequence="gauss-seidel")
    assert free.simulation.controller == "elementary"


@pytest.mark.parametrize("estimator", ["rich", "mod"])
def test_a_run_with_it_is_one_with_its_keys(estimator: str) -> None:
    """Bit for bit, and the summary tells all of them."""
    options = {"estimator": estimator, "stop_time": 0.3}
    results = [
        run_slaves(car(**{**options, **keys}), {"chassis": CHASSIS.slave(), "wheel": WHEEL.slave()})
        for keys in ({"preset": "paper"}, PAPER)
    ]
    a, b = (run.result for run in results)
    assert a.steps.tolist() == b.steps.tolist()
    assert a.outputs.tobytes() == b.outputs.tobytes()
    told = a.summary["settings"]["simulation"]
    assert {key: told[key] for key in PAPER} == PAPER
    assert told["preset"] == "paper"
