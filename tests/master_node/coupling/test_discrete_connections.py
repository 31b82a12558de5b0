"""Connections that are not continuous, events within steps, units and arrays: with real FMUs."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_node import Result, System, load_system, simulate
from protocol.errors import ConfigurationError, SlaveError
from slave_node.fmu.description import describe_fmu
from tests.conftest import EXAMPLES
from tests.support.places import SUPPORT
from tests.support.slow import quick_at


def clock_and_device(folder: Path, **simulation: Any) -> System:
    """The system of the example, with the FMUs in ``folder``."""
    system = load_system(EXAMPLES / "discrete" / "discrete.toml")
    slaves = {name: {"model": str(folder / "all_types2.fmu")} for name in system.slaves}
    return System(
        simulation=system.simulation.model_dump(exclude_unset=True) | simulation,
        slaves=slaves,
        connections=system.connections,
    )


def switched_lag(times: np.ndarray) -> np.ndarray:
    """The solution of y' = u - y, where u is 0 up to 0.25 s, then 1, and changes every 0.25 s."""
    y, values, begin = 0.0, np.zeros_like(times), 0.0
    for number in range(5):
        u = float(number % 2)
        inside = (times >= begin) & (times <= begin + 0.25)
        values[inside] = u + (y - u) * np.exp(-(times[inside] - begin))
        y = u + (y - u) * np.exp(-0.25)
        begin += 0.25
    return values


@pytest.mark.parametrize("estimator", ["mod", "rich"])
def test_discrete_outputs_switch_other_slaves(capability_dir: Path, estimator: str) -> None:
    """Effects of a change on continuous variables are within the tolerance; each is an event."""
    result = simulate(clock_and_device(capability_dir), in_process=True, estimator=estimator)
    error = np.abs(result["device.real_continuous_out"] - switched_lag(result.time))
    assert error.max() < 1e-3
    changes = np.flatnonzero(np.diff(result["clock.counter_out"]))
    assert len(changes) == 4
    assert result.summary["discontinuities"] == 4
    assert result["clock.counter_out"].dtype == np.int64
    assert result["clock.toggle_out"].dtype == np.bool_


def thermostat(folder: Path, state: str | None = None, stop_time: float = 2.0) -> System:
    """A room that a relay FMU for model exchange keeps between 292.15 and 294.15 K."""
    return System(
        simulation={
            "stop_time": stop_time,
            "relative_tolerance": 1e-6,
            "absolute_tolerance": 1e-6,
        },
        slaves={
            "room": {"model": "driven_models.py:Room"},
            "relay": {"model": str(folder / "relay_me2.fmu"), "state": state},
        },
        connections=[("room.T", "relay.u"), ("relay.is_on", "room.on")],
        base=SUPPORT,
    )


def test_a_thermostat_switches_when_theory_says_so(capability_dir: Path) -> None:
    """The temperature is c + d exp(-t/2) between the limits; each switch is an event."""
    result = simulate(thermostat(capability_dir), in_process=True)
    warming, cooling = 2.0 * np.log(21.0 / 19.0), 2.0 * np.log(11.0 / 9.0)
    cycle = [warming, cooling, warming, cooling, warming]
    expected = 2.0 * np.log(10.0 / 9.0) + np.cumsum([0.0, *cycle])
    changes = np.flatnonzero(np.diff(result["relay.is_on"].astype(int)))
    np.testing.assert_allclose(result.time[changes + 1], expected, rtol=0.0, atol=1e-6)
    assert (np.diff(result.time) > 0.0).all()
    assert result["relay.changes"][-1] == len(expected)


@pytest.mark.parametrize("state", quick_at(["fork"], ["fork", "replay"]))
def test_events_are_the_same_however_states_are_saved(capability_dir: Path, state: str) -> None:
    """A slave that was taken back from an event forgets that it told of it: bit for bit."""
    native = simulate(thermostat(capability_dir, stop_time=0.22), in_process=True)
    other = simulate(thermostat(capability_dir, state, stop_time=0.22), in_process=True)
    assert native["relay.changes"][-1] == 1
    assert other.time.tobytes() == native.time.tobytes()
    assert other.outputs.tobytes() == native.outputs.tobytes()
    np.testing.assert_array_equal(other["relay.changes"], native["relay.changes"])


@pytest.mark.parametrize("estimator", ["mod", "rich"])
@pytest.mark.parametrize(
    ("rules", "smallest", "delay"),
    [
        ({"step_multiple": 0.01}, 0.01, 0.0),
        ({"step_multiple": 0.004}, 0.004, 0.004),
        ({"smallest_step_size": 0.01, "largest_step_size": 0.06}, 0.01, 0.01),
    ],
)
def test_changes_are_found_where_steps_have_rules(
    capability_dir: Path, estimator: str, rules: dict[str, float], smallest: float, delay: float
) -> None:
    """A change is handed over at the first point that the rules allow, on grids too.

    So what it does is late by no more than the smallest H, and exact where it is on the grid. That
    H could not be smaller is counted.
    """
    system = clock_and_device(capability_dir).with_slave("clock", **rules)
    result = simulate(system, in_process=True, estimator=estimator)
    error = np.abs(result["device.real_continuous_out"] - switched_lag(result.time))
    assert error.max() <= 1.01 * delay + 1e-9
    assert result.summary["discontinuities"] == 4
    assert result.summary["changes_at_smallest_step_size"] == 4
    steps = result.steps["step_size"]
    assert steps.min() >= smallest - 1e-9
    assert steps.max() >= 2.0 * smallest


def test_values_are_held_and_handed_on(capability_dir: Path) -> None:
    """At every point each output of the device belongs to the clock's value one point before."""
    result = simulate(clock_and_device(capability_dir), in_process=True)
    counter, toggle = result["clock.counter_out"], result["clock.toggle_out"]
    assert (result["device.integer_out"][1:] == counter[:-1] + 1).all()
    assert (result["device.boolean_out"][1:] == ~toggle[:-1]).all()
    assert set(result["device.string_out"]) == {"got got "}
    assert set(result["device.enumeration_out"]) == {3}


def test_a_smaller_tolerance_sees_a_change_earlier(capability_dir: Path) -> None:
    """The error that comes from handing changes over late falls with the tolerance."""
    errors = []
    for tolerance in (1e-2, 1e-3, 1e-4, 1e-5):
        result = simulate(
            clock_and_device(capability_dir),
            in_process=True,
            relative_tolerance=tolerance,
            absolute_tolerance=tolerance,
        )
        exact = switched_lag(result.time)
        errors.append(float(np.abs(result["device.real_continuous_out"] - exact).max()))
    assert all(fine < coarse for coarse, fine in pairwise(errors))
    assert errors[-1] < 1e-4


def test_the_same_bits_over_zenoh(capability_dir: Path, tmp_path: Path) -> None:
    """Values of all types come through the processes as they are."""
    system = clock_and_device(capability_dir)
    for name, in_process in (("here", True), ("there", False)):
        simulate(system, in_process=in_process, output=tmp_path / name)
    here, there = ((tmp_path / name / "results.csv").read_bytes() for name in ("here", "there"))
    assert here == there


def test_discrete_results_on_a_grid(capability_dir: Path) -> None:
    """Between communication points a discrete value is what it was before."""
    system = clock_and_device(capability_dir).with_simulation(largest_step_size=0.5)
    result = simulate(system, in_process=True, output_interval=0.1)
    assert result["clock.counter_out"].tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 3, 3, 4]


def test_a_fixed_step_hands_discrete_values_on(capability_dir: Path) -> None:
    """Without an estimator too; the change is seen at the end of its step."""
    result = simulate(
        clock_and_device(capability_dir), in_process=True, estimator="none", initial_step_size=0.05
    )
    assert result["clock.counter_out"].tolist() == [int(i * 0.05 / 0.25 + 1e-9) for i in range(21)]
    assert (result["device.integer_out"][1:] == result["clock.counter_out"][:-1] + 1).all()


@pytest.mark.parametrize("in_process", [True, False])
def test_an_early_return_is_an_event(capability_dir: Path, in_process: bool) -> None:
    """A step that would pass over an event is repeated to end there; the event is where it is."""
    system = System(
        simulation={"stop_time": 1.0, "relative_tolerance": 1e-5, "absolute_tolerance": 1e-5},
        slaves={"model": {"model": str(capability_dir / "event_mode3.fmu")}},
    )
    result = simulate(system, in_process=in_process)
    for event in (0.35, 0.70):
        assert np.abs(result.time - event).min() <= 2e-16
    exact, level, begin = 1.0, 0.0, 0.0
    at = {0.0: 1.0}
    for event in (0.35, 0.7, 1.0):
        exact = level + (exact - level) * np.exp(-(event - begin) / 0.5)
        at[event] = exact
        level, begin = level + 1.0, event
    for event, y in at.items():
        index = int(np.abs(result.time - event).argmin())
        assert result["model.y"][index] == pytest.approx(y, abs=1e-7)
    assert result.summary["discontinuities"] == 2
    assert result["model.level"].max() == 2


@pytest.mark.parametrize("estimator", ["mod", "rich"])
def test_an_early_return_that_does_not_repeat_is_no_event(
    capability_dir: Path, estimator: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Saved states that lack the past of the event indicators: the first step after a restore
    returns early, once, at T_n as well as halfway. It is taken again, and the run is that of an FMU
    without this fault, step by step: history, order and H are kept. The user is told once.
    """
    results = [
        simulate(
            System(
                simulation={"stop_time": 1.0, "estimator": estimator},
                slaves={"model": {"model": str(capability_dir / f"{fmu}.fmu")}},
            ),
            in_process=True,
        )
        for fmu in ("event_mode3", "loses_indicators3")
    ]
    right, faulty = results
    assert right.summary["discontinuities"] == faulty.summary["discontinuities"] == 2
    assert np.array_equal(right.time, faulty.time)
    assert np.array_equal(right["model.y"], faulty["model.y"])
    rejected = faulty.steps[~faulty.steps["accepted"]]
    assert "model: early_return after a restore" in rejected["limiting_variable"].tolist()
    told = [r.getMessage() for r in caplog.records if "returned early" in r.getMessage()]
    assert len(told) == 1
    assert 'state = "fork"' in told[0]


def mapped(folder: Path, source: str, target: str, mapping: dict[Any, Any], **more: Any) -> System:
    """The counter of one FMU drives another one through a mapping; four changes in a second."""
    model = {"model": str(folder / "all_types2.fmu")}
    return System(
        simulation={"stop_time": 1.0, "smallest_step_size": 1e-7},
        slaves={"clock": model, "device": model},
        connections=[{"from": source, "to": target, "mapping": mapping, **more}],
    )


def test_values_are_mapped_by_a_table(capability_dir: Path) -> None:
    """Values with an entry become its target, all others are handed on unchanged."""
    ends = ("clock.counter_out", "device.integer_in")
    result = simulate(mapped(capability_dir, *ends, {0: 10, 2: -7}), in_process=True)
    table = np.array([10, 1, -7, 3, 4])
    device = result["device.integer_out"]
    assert (device[1:] == table[result["clock.counter_out"][:-1]] + 1).all()
    ends = ("clock.toggle_out", "device.boolean_in")
    result = simulate(mapped(capability_dir, *ends, {True: False, False: True}), in_process=True)
    assert (result["device.boolean_out"][1:] == result["clock.toggle_out"][:-1]).all()


def test_a_mapping_opens_a_way_between_types(capability_dir: Path) -> None:
    """An integer becomes an enumeration; a value that has no entry, and is no item's number, ends
    the run, with its place.
    """
    ends = ("clock.counter_out", "device.enumeration_in")
    whole = {0: 3, 1: 2, 2: 1, 3: 2, 4: 3}
    result = simulate(mapped(capability_dir, *ends, whole), in_process=True)
    assert set(result["device.enumeration_out"]) == {1, 2, 3}
    result = simulate(mapped(capability_dir, *ends, {0: 3}), in_process=True)
    assert set(result["device.enumeration_out"]) == {1, 2, 3}
    with pytest.raises(SlaveError, match="'enumeration_in' has no entry for the value 0") as caught:
        simulate(mapped(capability_dir, *ends, {1: 2}), in_process=True)
    assert (caught.value.slave, caught.value.time) == ("device", 0.0)
    assert "add the value to the mapping" in str(caught.value)


def test_items_are_mapped_by_name(capability_dir: Path) -> None:
    """Names of items say what their numbers say; a wrong one is told with the items."""
    ends = ("clock.counter_out", "device.enumeration_in")
    description = describe_fmu(capability_dir / "all_types2.fmu")
    items = description.variable("enumeration_in").items
    names = {number: name for name, number in items.items()}
    numbers = {0: 3, 1: 2, 2: 1, 3: 2, 4: 3}
    named = {str(count): names[number] for count, number in numbers.items()}
    both = [
        simulate(mapped(capability_dir, *ends, each), in_process=True) for each in (numbers, named)
    ]
    assert np.array_equal(*(one["device.enumeration_out"] for one in both))
    with pytest.raises(ConfigurationError, match=f"has no item 'x'; there is '{names[1]}'"):
        simulate(mapped(capability_dir, *ends, {1: "x"}), in_process=True)


@pytest.mark.parametrize(
    ("target", "mapping", "more", "told"),
    [
        ("integer_in", {0: True}, {}, "write { false = true, … } or { 1 = 2, … }"),
        ("integer_in", {"x": 1}, {}, "and has no item 'x'"),
        ("integer_in", {"true": "x"}, {}, "write { false = true, … } or { 1 = 2, … }"),
        ("integer_in", {}, {}, "write { false = true, … } or { 1 = 2, … }"),
        ("integer_in", {"1": 1, "01": 2}, {}, "01 is there twice"),
        ("integer_in", {1: 1}, {"factor": 2.0}, "cannot stand beside factor"),
        ("integer_in", {1: 2**31}, {}, "the mapping is not from the one to the other"),
        ("boolean_in", {1: 2}, {}, "the mapping is not from the one to the other"),
        ("integer_in", {False: True}, {}, "the mapping is not from the one to the other"),
        ("real_continuous_in", {1: 2}, {}, "the mapping is not from the one to the other"),
    ],
)
def test_mappings_that_fit_nothing_are_refused(
    capability_dir: Path, target: str, mapping: dict[Any, Any], more: dict[str, Any], told: str
) -> None:
    """Before anything starts, with the number of the connection."""
    with pytest.raises(ConfigurationError, match="number 1") as caught:
        simulate(
            mapped(capability_dir, "clock.counter_out", f"device.{target}", mapping, **more),
            in_process=True,
        )
    assert told in str(caught.value)


def lags(folder: Path, source: str, target: str, **connection: Any) -> System:
    """Two lags of the same model family, the one driving the other."""
    return System(
        simulation={"stop_time": 1.0},
        slaves={
            "a": {"model": str(folder / f"{source}.fmu")},
            "b": {"model": str(folder / f"{target}.fmu")},
        },
        connections=[{"from": "a.y", "to": "b.u", **connection}],
    )


def test_units_of_fmus_are_converted(capability_dir: Path) -> None:
    """A lag driven in millimetres by one in metres does what it does driven in its own unit."""
    folder = capability_dir
    converted = simulate(lags(folder, "units_metres", "units_millimetres"), in_process=True)
    given = lags(folder, "units_metres", "units_millimetres", factor=1e3)
    assert (simulate(given, in_process=True)["b.y"] == converted["b.y"]).all()
    as_it_is = lags(folder, "units_metres", "units_millimetres", ignore_units=True)
    assert last(simulate(as_it_is, in_process=True), "b.y") != last(converted, "b.y")


def test_units_of_other_dimensions_are_refused(capability_dir: Path) -> None:
    """Both ends and both dimensions are named."""
    system = System(
        simulation={"stop_time": 1.0},
        slaves={
            "a": {"model": str(capability_dir / "units_metres.fmu")},
            "b": {"model": str(capability_dir / "units_millimetres.fmu")},
        },
        connections=[{"from": "a.y", "to": "b.theta_in"}],
    )
    with pytest.raises(ConfigurationError, match=r"a\.y and b\.theta_in .* is m, .* is K"):
        simulate(system, in_process=True)


def arrays(folder: Path, **slave: Any) -> System:
    """Two FMUs whose arrays are connected."""
    model = {"model": str(folder / "all_types3.fmu"), **slave}
    return System(
        simulation={"stop_time": 1.0},
        slaves={"a": model, "b": model},
        connections=[("a.matrix_out", "b.matrix_in"), ("a.vector_out", "b.vector_in")],
    )


def last(result: Result, name: str) -> float:
    """The last value of a variable."""
    return float(result[name][-1])


def test_arrays_are_connected_by_their_names(capability_dir: Path) -> None:
    """Each element goes to the element of the same indices; start values come in rows."""
    system = arrays(capability_dir, parameters={"matrix_in": ((1, 2, 3), (4, 5, 6))})
    result = simulate(system, in_process=True, estimator="none", initial_step_size=0.1)
    for row in (1, 2):
        for column in (1, 2, 3):
            element = f"matrix_out[{row},{column}]"
            start = 3 * (row - 1) + column
            assert last(result, f"a.{element}") == 2.0 * start
            assert last(result, f"b.{element}") == 4.0 * start


def test_structural_parameters_size_arrays(capability_dir: Path) -> None:
    """They are set in configuration mode, before anything else is known of the slave."""
    system = arrays(capability_dir, parameters={"n": 5})
    result = simulate(system, in_process=True, estimator="none", initial_step_size=0.1)
    assert "a.vector_out[5]" in result.names
    assert "a.vector_out[6]" not in result.names
    assert last(result, "b.vector_out[5]") == 2.0
