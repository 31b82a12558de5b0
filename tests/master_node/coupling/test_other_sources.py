"""Local variables and calculated parameters that feed inputs of other slaves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_node import Result, System, load_system, simulate
from master_node.system.files import export_system, open_system
from protocol.errors import ConfigurationError
from tests.support.slow import quick_at

LAG = (
    "from protocol.variables import Variable, VariableType\n"
    "from slave_node.model import Model, real\n"
    "class Integrator(Model):\n"
    "    inputs = (real('u', start=0.0),)\n"
    "    states = outputs = (real('x', start=0.0),)\n"
    "    def derivatives(self, t, x, u):\n"
    "        return [u[0]]\n"
    "class Lag(Model):\n"
    "    inputs = (real('u', start=0.0),)\n"
    "    states = (real('x', start=1.0),)\n"
    "    def derivatives(self, t, x, u):\n"
    "        return [u[0] - x[0]]\n"
)


def fed(folder: Path, fmus: Path, source: str, version: int = 2, **more: Any) -> System:
    """An integrator of a variable of a drive, which has the input 1 + t, the gain 2 and n = 4."""
    (folder / "lag.py").write_text(LAG, encoding="utf-8")
    simulation = {"stop_time": 1.0, "relative_tolerance": 1e-5, "absolute_tolerance": 1e-6}
    return System(
        simulation=simulation | more.pop("simulation", {}),
        slaves={
            "drive": {
                "model": str(fmus / f"drive{version}.fmu"),
                "parameters": {"gain": 2.0, "n": 4},
                **more,
            },
            "sum": {"model": "lag.py:Integrator"},
        },
        connections=[(f"drive.{source}", "sum.u")],
        inputs={"drive.u": (np.array([0.0, 1.0]), np.array([1.0, 2.0]))},
        base=folder,
    )


INTEGRALS = {
    "flow": lambda t: 2.0 * t + t**2,
    "s": lambda t: t**3 / 3.0 + t**4 / 12.0,
    "total": lambda t: 8.0 * t,
}


@pytest.mark.parametrize(
    ("version", "source"),
    [
        (version, source)
        for version in (1, 2, 3)
        for source in INTEGRALS
        if (version, source) != (1, "total")
    ],
)
@pytest.mark.parametrize("estimator", quick_at(["mod"], ["mod", "rich"]))
def test_what_a_model_computes_feeds_inputs(
    tmp_path: Path, capability_dir: Path, version: int, source: str, estimator: str
) -> None:
    """An algebraic variable, a state and a calculated parameter of FMI 1.0, 2.0 and 3.0.

    FMI 1.0 has no calculated parameters.
    """
    system = fed(tmp_path, capability_dir, source, version, simulation={"estimator": estimator})
    result = simulate(system, in_process=True)
    assert result["sum.x"] == pytest.approx(INTEGRALS[source](result.time), abs=2e-4)
    assert f"drive.{source}" in result  # it is a result as an output is


@pytest.mark.parametrize("slave", [{"state": "fork"}, {"state": "replay"}, {"input_substeps": 2}])
def test_it_is_read_however_states_are_saved(
    tmp_path: Path, capability_dir: Path, slave: dict[str, Any]
) -> None:
    """Both sources give one solution."""
    result = simulate(fed(tmp_path, capability_dir, "s", **slave), in_process=True)
    assert result["sum.x"] == pytest.approx(INTEGRALS["s"](result.time), abs=2e-3)


def test_the_same_bits_over_the_bus(
    tmp_path: Path, capability_dir: Path, no_process_left: None
) -> None:
    """A slave process reads the same variables."""
    system = fed(tmp_path, capability_dir, "flow")
    here, bus = (simulate(system, in_process=in_process) for in_process in (True, False))
    assert here.outputs.tobytes() == bus.outputs.tobytes()


def test_local_sources_are_warned_of_and_calculated_ones_are_not(
    tmp_path: Path, capability_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Once, with the name and what FMI says."""
    simulate(fed(tmp_path, capability_dir, "total"), in_process=True)
    assert "local variables" not in caplog.text
    simulate(fed(tmp_path, capability_dir, "flow"), in_process=True)
    told = "drive: inputs are fed by its local variables 'flow': FMI means only outputs"
    assert caplog.text.count(told) == 1


def test_a_discrete_one_feeds_a_discrete_input(tmp_path: Path, capability_dir: Path) -> None:
    """A Boolean and a text of one FMU are the inputs of another from the first step on."""
    system = fed(tmp_path, capability_dir, "s")
    system = system._with(
        slaves={**system.slaves, "device": {"model": str(capability_dir / "all_types2.fmu")}},
        connections=[
            ("drive.is_moving", "device.boolean_in"),
            ("drive.label", "device.string_in"),
        ],
    )
    result = simulate(system, in_process=True)
    assert not result["device.boolean_out"][1:].any()  # it gives the opposite of its input
    assert set(result["device.string_out"][1:].tolist()) == {"got forward"}


def test_states_of_python_models_feed_inputs(tmp_path: Path, capability_dir: Path) -> None:
    """A model without outputs, in a loop with one that has some; nothing to warn of."""
    fed(tmp_path, capability_dir, "s")
    system = System(
        simulation={"stop_time": 2.0, "relative_tolerance": 1e-6, "absolute_tolerance": 1e-6},
        slaves={"lag": {"model": "lag.py:Lag"}, "sum": {"model": "lag.py:Integrator"}},
        connections=[
            {"from": "lag.x", "to": "sum.u", "factor": -2.0},
            {"from": "sum.x", "to": "lag.u"},
        ],
        base=tmp_path,
    )
    result = simulate(system, in_process=True)
    a, w = 0.5, np.sqrt(1.75)  # x'' + x' + 2 x = 0, x(0) = 1, x'(0) = -1
    t = result.time
    x = np.exp(-a * t) * (np.cos(w * t) - (a / w) * np.sin(w * t))
    assert result["lag.x"] == pytest.approx(x, abs=1e-4)


@pytest.mark.parametrize("source", ["gain", "u", "n"])
def test_what_a_model_does_not_compute_is_no_source(
    tmp_path: Path, capability_dir: Path, source: str
) -> None:
    """Parameters and inputs; the outputs are named."""
    with pytest.raises(ConfigurationError, match=r"is not an output but of causality .*'y'"):
        simulate(fed(tmp_path, capability_dir, source), in_process=True)


def test_a_package_keeps_them(tmp_path: Path, capability_dir: Path) -> None:
    """Their connectors have their own kinds; what is read again gives the same bits."""
    fmu = str(capability_dir / "drive2.fmu")
    system = System(
        simulation={"stop_time": 0.5},
        slaves={"a": {"model": fmu}, "b": {"model": fmu}, "c": {"model": fmu}},
        connections=[("a.s", "b.u"), ("a.total", "c.u")],
        inputs={"a.u": 1.0},
    )
    file = tmp_path / "a.toml"
    file.write_text(
        "[simulation]\nstop_time = 0.5\n"
        + "".join(
            f'[slaves.{name}]\nmodel = "{fmu}"\nparameters = {{ u = 1.0 }}\n' for name in "abc"
        )
        + '[[connections]]\nfrom = "a.s"\nto = "b.u"\n'
        + '[[connections]]\nfrom = "a.total"\nto = "c.u"\n',
        encoding="utf-8",
    )
    export_system(file, tmp_path / "a.ssp")
    with open_system(tmp_path / "a.ssp") as read:
        there = simulate(read, in_process=True)
    here = simulate(load_system(file), in_process=True)
    assert isinstance(here, Result)
    assert system.connections == load_system(file).connections
    for name in here.names:
        assert here[name].tobytes() == there[name].tobytes(), name
