"""Tunable parameters that change while a run goes on: at communication points, as events."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_node import InputSettings, Result, System, simulate
from master_node.simulation import resume
from protocol.errors import ConfigurationError, DoublestepError
from tests.support.interrupting import Interrupt

CHANGES, GAINS = (0.0, 0.3, 0.7), (1.0, 4.0, 0.5)


def held(times: Any, values: Any) -> InputSettings:
    """A table whose values hold."""
    return InputSettings(table=(times, values), interpolation="hold", extrapolate="hold")


def tuned(
    folder: Path,
    version: int = 2,
    *,
    slave: dict[str, Any] | None = None,
    base: Path = Path(),
    **inputs: Any,
) -> System:
    """A drive with the input 2: y' = gain mode u."""
    signals = inputs or {"gain": held(CHANGES, GAINS)}
    return System(
        simulation={"stop_time": 1.0},
        slaves={"drive": {"model": str(folder / f"drive{version}.fmu"), **(slave or {})}},
        inputs={"drive.u": 2.0, **{f"drive.{name}": signal for name, signal in signals.items()}},
        results={"locals": ["drive.gain", "drive.mode", "drive.total"]},
        base=base,
    )


def integral(times: np.ndarray, changes: Any, values: Any) -> np.ndarray:
    """Integral of a value that changes, each time to hold from there on."""
    ends = (*changes[1:], np.inf)
    parts = [
        v * np.clip(times - a, 0.0, b - a) for a, b, v in zip(changes, ends, values, strict=True)
    ]
    return np.sum(parts, axis=0)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(
    ("slave", "simulation"),
    [
        ({}, {}),
        ({}, {"estimator": "rich"}),
        ({}, {"sequence": "gauss-seidel"}),
        ({"state": "fork"}, {}),
        ({"state": "replay"}, {}),
        ({"state": "none"}, {}),
        ({}, {"estimator": "none", "initial_step_size": 0.1}),
    ],
)
def test_a_table_tunes_a_parameter(
    capability_dir: Path, version: int, slave: dict[str, Any], simulation: dict[str, Any]
) -> None:
    """The output is exact, for each change is a communication point; what depends on it follows."""
    system = tuned(capability_dir, version, slave=slave).with_simulation(**simulation)
    result = simulate(system, in_process=True)
    expected = 2.0 * integral(result.time, CHANGES, GAINS)
    np.testing.assert_allclose(result["drive.y"], expected, rtol=0.0, atol=1e-12)
    assert {0.3, 0.7} <= {round(time, 12) for time in result.time.tolist()}
    assert set(result["drive.gain"].tolist()) == set(GAINS)
    assert np.array_equal(result["drive.total"], 3.0 * result["drive.gain"])
    if simulation.get("estimator") != "none":
        assert result.summary["discontinuities"] == 2


@pytest.mark.parametrize("version", [2, 3])
def test_an_enumeration_is_tuned_by_its_items(capability_dir: Path, version: int) -> None:
    """By name or by number; the numbers are in the results."""
    modes = held((0.0, 0.5), np.array(["forward", "reverse"]))
    result = simulate(tuned(capability_dir, version, mode=modes), in_process=True)
    expected = 2.0 * integral(result.time, (0.0, 0.5), (1.0, -1.0))
    np.testing.assert_allclose(result["drive.y"], expected, rtol=0.0, atol=1e-12)
    assert set(result.item_names("drive.mode").tolist()) == {"forward", "reverse"}


def test_a_function_tunes_a_parameter(capability_dir: Path) -> None:
    """It is asked at communication points, and its breakpoints are among them."""
    function = InputSettings(function=lambda t: 1.0 if t < 0.25 else 3.0, breakpoints=(0.25,))
    result = simulate(tuned(capability_dir, gain=function), in_process=True)
    expected = 2.0 * integral(result.time, (0.0, 0.25), (1.0, 3.0))
    np.testing.assert_allclose(result["drive.y"], expected, rtol=0.0, atol=1e-12)


def test_a_constant_is_its_start_value(capability_dir: Path) -> None:
    """They give the bits that ``parameters`` give."""
    here = simulate(tuned(capability_dir, gain=2.5), in_process=True)
    slave = {"parameters": {"gain": 2.5}}
    there = simulate(tuned(capability_dir, slave=slave, mode=1), in_process=True)
    assert here["drive.y"].tobytes() == there["drive.y"].tobytes()


def test_the_same_bits_over_the_bus_and_after_a_resume(
    capability_dir: Path, tmp_path: Path, no_process_left: None
) -> None:
    """Tuned values are there again after a run was broken off between changes."""
    rows = "".join(f"{time};{gain}\n" for time, gain in zip(CHANGES, GAINS, strict=True))
    (tmp_path / "gain.csv").write_text(f"t;gain\n{rows}", encoding="utf-8")
    table = {"table": "gain.csv", "interpolation": "hold", "extrapolate": "hold"}
    system = tuned(capability_dir, base=tmp_path, gain=table).with_simulation(
        checkpoint_interval=1e-9, largest_step_size=0.02
    )
    simulate(system, output=tmp_path / "here", in_process=True)
    simulate(system, output=tmp_path / "bus")
    with pytest.raises(DoublestepError, match="interrupted"):
        simulate(system, output=tmp_path / "cut", observers=[Interrupt(30)])
    assert 0.3 < Result.load(tmp_path / "cut").time[-1] < 0.7
    resume(tmp_path / "cut")
    csv = [(tmp_path / folder / "results.csv").read_bytes() for folder in ("here", "bus", "cut")]
    assert csv[0] == csv[1] == csv[2]


@pytest.mark.parametrize(
    ("version", "inputs", "told"),
    [
        (2, {"n": held((0.0, 0.5), (3, 4))}, "drive.n is a fixed parameter.*in `parameters`"),
        (2, {"total": 1.0}, "drive.total is neither an input nor a tunable parameter but of"),
        (2, {"y": 1.0}, "drive.y is neither an input nor a tunable parameter"),
        (1, {"gain": 2.0}, "drive.gain is a fixed parameter"),
        (2, {"gain": held((0.0, 0.5), (3.0, 11.0))}, r"row 2: it must be at most 10\.0 \(max\)"),
        (2, {"mode": held((0.0, 0.5), (1, 2))}, r"row 2: .* 2 is none of them.*ignore_bounds"),
        (2, {"gain": InputSettings(table=((0.0, 1.0), (1.0, 2.0)))}, 'say interpolation = "hold"'),
    ],
)
def test_what_cannot_be_tuned_is_told_before_the_start(
    capability_dir: Path, version: int, inputs: dict[str, Any], told: str
) -> None:
    """With what the variable is, and the remedy."""
    with pytest.raises(ConfigurationError, match=told):
        simulate(tuned(capability_dir, version, **inputs), in_process=True)
