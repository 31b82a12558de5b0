"""Discrete inputs driven from outside: tables whose values hold, and functions of time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from master_node import InputSettings, Result, System, simulate
from master_node.inputs.discrete import legal_value
from protocol.calls import Initialize
from protocol.description import StateKind
from protocol.errors import ConfigurationError, SlaveError
from protocol.variables import Causality, StartValue, Variable, VariableType
from tests.support.quarter_car_case import ALL, LinearSlave, LinearSystem, Run, run_slaves

STOP = 2.0
KINDS = ["mod", "rich", "none", "no rollback"]
SLOPES = replace(ALL, max_output_derivative_order=1)
LAG = LinearSystem(
    a=np.array([[-1.0]]), b=np.zeros((1, 0)), c=np.zeros(1), inputs=(), outputs=("x",)
)
INPUTS = {
    "level": VariableType.INTEGER,
    "enabled": VariableType.BOOLEAN,
    "mode": VariableType.ENUMERATION,
    "text": VariableType.STRING,
    "gain": VariableType.FLOAT64,
}


class Switched(LinearSlave):
    """x' = level - x, propagated exactly; notes what it is told and when."""

    def __init__(self, *, rollback: bool = True) -> None:
        super().__init__(LAG, np.zeros(1), SLOPES)
        self.description = replace(
            self.description,
            variables=(
                *(
                    Variable(name, Causality.INPUT, type_, "discrete")
                    for name, type_ in INPUTS.items()
                ),
                *self.description.variables,
            ),
            state_kind=StateKind.NATIVE if rollback else StateKind.NONE,
        )
        self.told: list[tuple[float, tuple[StartValue, ...]]] = []

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        self.names = experiment.discrete_inputs

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`."""
        self.values = dict(zip(self.names, values, strict=True))

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> Any:
        """See `Slave`."""
        self.told.append((communication_point, tuple(self.values.values())))
        self.system = replace(LAG, c=np.array([float(self.values.get("level", 0))]), propagators={})
        return super().do_step(communication_point, step_size, prior)


def attempted(kind: str, base: Path = Path(), **inputs: Any) -> tuple[Run, Switched]:
    """A run of one slave, controlled in one way or another, and that slave."""
    slave = Switched(rollback=kind != "no rollback")
    simulation = {"stop_time": STOP, "relative_tolerance": 1e-4, "absolute_tolerance": 1e-4}
    if kind == "none":
        simulation |= {"initial_step_size": 0.05}
    system = System(
        simulation={**simulation, "estimator": "mod" if kind == "no rollback" else kind},
        slaves={"slave": {}},
        inputs={f"slave.{name}": signal for name, signal in inputs.items()},
        base=base,
    )
    return run_slaves(system, {"slave": slave}), slave


def driven(kind: str, **inputs: Any) -> tuple[Result, Switched]:
    """Result and slave of a run as by `attempted`; raises its error."""
    run, slave = attempted(kind, **inputs)
    if run.error is not None:
        raise run.error
    return run.result, slave


def rows(times: Sequence[float], values: Any) -> InputSettings:
    """A hold table."""
    return InputSettings(table=(times, values), interpolation="hold")


def motion(times: np.ndarray, changes: Sequence[float], levels: Sequence[float]) -> np.ndarray:
    """X from rest where the level changes to the next one at each of the times."""
    x, found = 0.0, np.zeros_like(times)
    for begin, end, level in zip(changes, (*changes[1:], math.inf), levels, strict=True):
        inside = (times > begin) & (times <= end)
        found[inside] = level + (x - level) * np.exp(-(times[inside] - begin))
        x = level + (x - level) * math.exp(-(min(end, 1e3) - begin))
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_values_of_tables_hold_and_their_changes_are_events(kind: str) -> None:
    """At each change there is a communication point, and the values of all types are those of then.

    So the solution is exact behind each of them.
    """
    changes, levels = (0.0, 0.3, 0.35, 1.2), (0, 2, -3, 1)
    result, slave = driven(
        kind,
        level=rows(changes, levels),
        enabled=rows((0.0, 1.2), np.array([False, True])),
        mode=rows((0.0, 0.3), (1.0, 2.0)),
        text=rows((0.0, 0.35), ("off", "on")),
        gain=rows((0.0, 1.2), (0.5, 1.5)),
    )
    assert np.abs(result["slave.x"] - motion(result.time, changes, levels)).max() < 1e-12
    assert all(np.abs(result.time - change).min() < 1e-15 for change in changes)
    for time, told in dict(slave.told).items():  # behind the comparison solution of EST_mod
        now = time + 1e-12
        level = levels[int(np.searchsorted(changes, now)) - 1]
        assert told == (
            level,
            now > 1.2,
            2 if now > 0.3 else 1,
            "on" if now > 0.35 else "off",
            1.5 if now > 1.2 else 0.5,
        )
        assert [type(value) for value in told] == [int, bool, int, str, float]
    if kind != "none":
        assert result.summary["discontinuities"] == 3


@pytest.mark.parametrize("kind", KINDS)
def test_functions_are_asked_at_communication_points(kind: str) -> None:
    """Breakpoints are met, and what is behind them counts there."""
    function = InputSettings(function=lambda t: 3 if t >= 0.7 else 1, breakpoints=(0.7,))
    result, _ = driven(kind, level=function)
    assert np.abs(result["slave.x"] - motion(result.time, (0.0, 0.7), (1, 3))).max() < 1e-12
    assert np.abs(result.time - 0.7).min() < 1e-12


@pytest.mark.parametrize("kind", ["mod", "rich"])
def test_undeclared_changes_of_functions_are_searched(kind: str) -> None:
    """Undeclared changes are searched, as of discrete outputs, until within the tolerance."""
    result, _ = driven(kind, level=lambda t: 3 if t >= 0.7 else 1)
    error = result["slave.x"] - motion(result.time, (0.0, 0.7), (1, 3))
    assert np.abs(error).max() < 1e-3
    assert result.summary["discontinuities"] == 1


@pytest.mark.parametrize("kind", ["mod", "rich", "no rollback"])
def test_changes_nearer_than_the_smallest_step_are_all_told(kind: str) -> None:
    """Those that cannot be events of their own are late by two of the smallest H at most."""
    near = 1e-9 * STOP
    changes = (0.0, 0.4 * near, 0.5, 0.5 + 1.6 * near, 0.5 + 1.9 * near)
    levels = (1, 2, 5, 7, -4)
    result, _ = driven(kind, level=rows(changes, levels))
    error = result["slave.x"] - motion(result.time, changes, levels)
    assert np.abs(error).max() < 100.0 * near


@pytest.mark.parametrize("kind", ["mod", "none"])
def test_files_hold_values_of_all_types(kind: str, tmp_path: Path) -> None:
    """CSV as texts, NumPy as arrays; only the columns that are used have to fit."""
    (tmp_path / "gear.csv").write_text(
        't,level,enabled,mode,text\n0,1,true,2,idle\n0.5,-2,FALSE,3,"go, now"\n', encoding="utf-8"
    )
    np.savez(
        tmp_path / "gear.npz", t=[0.0, 0.5], gain=[1.0, 2.0], text=np.array(["idle", "go, now"])
    )
    told = []
    for file in ("gear.csv", "gear.npz"):
        names = ("level", "enabled", "mode", "text") if file == "gear.csv" else ("gain", "text")
        run, slave = attempted(
            kind,
            tmp_path,
            **{name: {"table": file, "column": name, "interpolation": "hold"} for name in names},
        )
        assert run.error is None
        told += [slave.told[0][1], slave.told[-1][1]]
    assert told == [
        (1, True, 2, "idle"),
        (-2, False, 3, "go, now"),
        ("idle", 1.0),
        ("go, now", 2.0),
    ]


def test_values_of_an_fmu(capability_dir: Path) -> None:
    """A real FMU gets each value from its time on, through a slave process too."""
    outputs = {}
    for in_process in (True, False):
        result = simulate(
            System(
                simulation={"stop_time": 1.0},
                slaves={"device": {"model": str(capability_dir / "all_types2.fmu")}},
                inputs={
                    "device.integer_in": rows((0.0, 0.3), (4, 6)),
                    "device.boolean_in": rows((0.0, 0.6), (0, 1)),
                    "device.string_in": rows((0.0, 0.3), ("a", "b")),
                },
            ),
            in_process=in_process,
        )
        later = result.time[1:] > 0.3 + 1e-12
        assert (result["device.integer_out"][1:] == np.where(later, 7, 5)).all()
        assert (result["device.boolean_out"][1:] == (result.time[1:] <= 0.6 + 1e-12)).all()
        assert {0.3, 0.6} <= set(result.time.tolist())
        outputs[in_process] = result.outputs.tobytes()
    assert outputs[True] == outputs[False]


@pytest.mark.parametrize(
    ("name", "signal", "told"),
    [
        ("level", rows((0.0, 1.0), (1, 2.5)), "row 2: it is of type Integer.*cannot be 2.5"),
        ("level", rows((0.0,), (2**31,)), "of type Integer.*cannot be 2147483648"),
        ("level", rows((0.0,), (True,)), "of type Integer.*cannot be True"),
        ("level", rows((0.0,), ("x",)), "of type Integer.*cannot be 'x'"),
        ("enabled", rows((0.0,), (2,)), "of type Boolean.*cannot be 2"),
        ("enabled", rows((0.0,), ("yes",)), "of type Boolean.*cannot be 'yes'"),
        ("text", rows((0.0,), (1,)), "of type String.*cannot be 1"),
        ("gain", rows((0.0,), ("nan",)), "value is nan"),
        ("level", ((0.0, 2.0), (1, 2)), 'rows of its table; say interpolation = "hold"'),
        ("level", rows((0.0, 0.0), (1, 2)), "row 2: the time 0.0 s is not above"),
        ("text", rows((0.5,), ("late",)), "do not cover the simulated time"),
        ("level", lambda t: 0.5, "slave.level is of type Integer.*cannot be 0.5"),
        ("text", lambda t: 1.0, "slave.text is of type String.*cannot be 1.0"),
        (
            "x",
            rows((0.0,), (1,)),
            "slave.x is neither an input nor a tunable parameter but of causality output",
        ),
    ],
)
def test_values_that_are_none_are_told_before_the_first_step(
    name: str, signal: Any, told: str
) -> None:
    """With the input, the row, the type and the value."""
    with pytest.raises(ConfigurationError, match=told) as caught:
        attempted("mod", **{name: signal})
    assert f"slave.{name}" in str(caught.value)


@pytest.mark.parametrize(
    ("function", "told"),
    [
        (
            lambda t: 1 if t < 0.7 else 0.5,
            "slave.level is of type Integer, -2147483648 to 2147483647; it cannot be 0.5",
        ),
        (lambda t: 1 if t < 0.7 else math.nan, "cannot be nan"),
        (lambda t: {True: 1}[t < 0.7], "the function of slave.level failed: KeyError"),
    ],
)
def test_a_function_that_fails_later_ends_the_run(
    function: Callable[[float], Any], told: str
) -> None:
    """The error says slave, time and cause; nothing but an integer ever gets to the slave."""
    run, slave = attempted("mod", level=function)
    assert isinstance(run.error, SlaveError)
    assert told in str(run.error)
    assert str(run.error).startswith("slave: external input at t=0.7") or "t=" in str(run.error)
    assert {type(value) for _, (value,) in slave.told} == {int}


@given(
    st.sampled_from([t for t in VariableType if t is not VariableType.CLOCK]),
    st.one_of(
        st.integers(), st.floats(), st.booleans(), st.text(max_size=5), st.integers().map(str)
    ),
)
def test_what_is_legal_is_of_the_type(type_: VariableType, given_value: StartValue) -> None:
    """Law: a value is taken as it is, or refused; never rounded, cut or wrapped."""
    variable = Variable("v", Causality.INPUT, type_, "discrete")
    try:
        value = legal_value(variable, given_value)
    except ValueError:
        return
    if type_.integer_range is not None:
        smallest, largest = type_.integer_range
        assert type(value) is int
        assert smallest <= value <= largest
        assert value == (Decimal(given_value) if isinstance(given_value, str) else given_value)
    elif type_.is_real:
        assert type(value) is float
        assert math.isfinite(value)
    else:
        kinds = {VariableType.BOOLEAN: bool, VariableType.STRING: str, VariableType.BINARY: bytes}
        assert type(value) is kinds[type_]


@pytest.mark.parametrize("kind", ["mod", "rich"])
def test_changes_on_a_grid_are_told_at_its_next_point(kind: str) -> None:
    """Steps are multiples of 0.04 s; 0.3 s is none, and the double step over it ends at 0.32 s."""
    slave = Switched()
    system = System(
        simulation={"stop_time": STOP, "estimator": kind},
        slaves={"slave": {"step_multiple": 0.04, "largest_step_size": 0.2}},
        inputs={"slave.level": rows((0.0, 0.3), (1, 4))},
    )
    run = run_slaves(system, {"slave": slave})
    assert run.error is None
    exact = motion(run.result.time, (0.0, 0.32), (1, 4))
    assert np.abs(run.result["slave.x"] - exact).max() < 1e-12
    assert run.result.summary["discontinuities"] == 1
