"""Inputs driven from outside: constants, tables and functions of time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from master_node import InputSettings, Result, System, load_system, simulate
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.input_tables import InputTableError, TableGroup, make_table
from master_node.numerics.landing_points import LandingPoints
from master_node.numerics.step_polynomials import Quadrature, step_polynomial
from protocol.errors import ConfigurationError, DoublestepError, SlaveError, StepSizeError
from protocol.signals import InputSignal
from tests.support.places import ROOT, SUPPORT
from tests.support.quarter_car_case import ALL, LinearSystem, Run, run_slaves
from tests.support.slow import quick_at

EXAMPLE = ROOT / "examples" / "external_inputs"
STOP = 3.0
ESTIMATORS = ["mod", "rich"]
SLOPES = replace(ALL, max_output_derivative_order=1)
HELD = replace(SLOPES, can_interpolate_inputs=False)

OSCILLATOR = LinearSystem(
    a=np.array([[0.0, 1.0], [-30.0, -1.0]]),
    b=np.array([[0.0], [30.0]]),
    c=np.zeros(2),
    inputs=("u",),
    outputs=("x", "v"),
)
"""x'' = 30 (u - x) - x', propagated exactly: what is wrong comes from the input alone."""

Rows = tuple[Sequence[float], Sequence[float]]


def attempted(signal: Any, capabilities: Any = SLOPES, **simulation: Any) -> Run:
    """A run of the oscillator with its input driven by a signal."""
    system = System(
        simulation={"stop_time": STOP, **simulation},
        slaves={"oscillator": {}},
        inputs={"oscillator.u": signal},
    )
    return run_slaves(system, {"oscillator": OSCILLATOR.slave(capabilities=capabilities)})


def driven(signal: Any, capabilities: Any = SLOPES, **simulation: Any) -> Result:
    """The result of such a run."""
    run = attempted(signal, capabilities, **simulation)
    if run.error is not None:
        raise run.error
    return run.result


def polynomial_motion(times: np.ndarray, derivatives: Sequence[float]) -> np.ndarray:
    """The oscillator from rest under a polynomial around t = 0, shape (n, 2)."""
    rows = np.array(derivatives, dtype=float)[:, np.newaxis]
    return np.array([OSCILLATOR.propagate(np.zeros(2), rows, t) for t in times.tolist()])


def table_motion(times: np.ndarray, rows: Rows, *, hold: bool = False) -> np.ndarray:
    """The oscillator from rest at the first row, piece by piece between the rows, shape (n, 2)."""
    x = np.zeros(2)
    motion = np.zeros((len(times), 2))
    for (begin, u), (end, following) in pairwise(zip(*rows, strict=True)):
        if begin == end:
            continue
        slope = 0.0 if hold else (following - u) / (end - begin)
        signal = np.array([[u], [slope]])
        for i in np.flatnonzero((times > begin) & (times <= end)):
            motion[i] = OSCILLATOR.propagate(x, signal, float(times[i] - begin))
        x = OSCILLATOR.propagate(x, signal, end - begin)
    return motion


def function_motion(times: np.ndarray, function: Callable[[float], float]) -> np.ndarray:
    """The oscillator from rest under a smooth function, nearly exactly, shape (n, 2)."""
    solution = solve_ivp(
        lambda t, x: OSCILLATOR.a @ x + OSCILLATOR.b[:, 0] * function(t),
        (0.0, float(times[-1])),
        np.zeros(2),
        t_eval=times,
        method="DOP853",
        rtol=1e-12,
        atol=1e-14,
    )
    motion: np.ndarray = solution.y.T
    return motion


def states(result: Result) -> np.ndarray:
    """Displacement and velocity, shape (n, 2)."""
    return np.column_stack([result["oscillator.x"], result["oscillator.v"]])


def largest(difference: np.ndarray) -> float:
    """In absolute value."""
    return float(np.abs(difference).max())


# ---- The polynomial of a step -------------------------------------------------------------------

NUMBERS = st.floats(-10.0, 10.0)


@given(st.lists(NUMBERS, min_size=1, max_size=4), st.floats(1e-3, 10.0), st.floats(-100.0, 100.0))
def test_a_polynomial_up_to_its_degree_stands_for_itself(
    coefficients: list[float], step_size: float, begin: float
) -> None:
    """Law: of degree 1, 2 and 3; a constant has derivatives that are exactly 0."""
    degree = len(coefficients) - 1
    signal = np.polynomial.Polynomial([c / step_size**i for i, c in enumerate(coefficients)])
    quadrature = Quadrature.over(begin, np.empty(0), begin + step_size)
    first, last = signal(0.0), signal(step_size)
    values = signal(quadrature.times - begin) - first
    deviations = [np.array([(w * values).sum()]) for w in (quadrature.mean, quadrature.moment)]
    rows = step_polynomial(
        np.array([first]), np.array([last]), (deviations[0], deviations[1]), step_size, degree
    )
    places = np.linspace(0.0, step_size, 7)
    got = [InputSignal(rows).at(float(s))[0] for s in places]
    assert got == pytest.approx(signal(places), rel=1e-9, abs=1e-8)
    if degree == 0:
        assert not rows[1:].any()


@pytest.mark.parametrize("degree", [0, 2, 3])
@pytest.mark.parametrize("step_size", [1.0, 0.02])
def test_mean_and_first_moment_are_kept_over_a_jump(degree: int, step_size: float) -> None:
    """Law: the impulse has its size, and with degree 3 its place, wherever the jump is."""
    jump = 2.0 + 0.3 * step_size
    quadrature = Quadrature.over(2.0, np.array([jump]), 2.0 + step_size)
    values = (quadrature.times > jump).astype(float)
    mean, moment = (np.array([(w * values).sum()]) for w in (quadrature.mean, quadrature.moment))
    rows = step_polynomial(np.zeros(1), np.ones(1), (mean, moment), step_size, degree)
    fine = Quadrature.over(0.0, step_size * np.linspace(0.0, 1.0, 50)[1:-1], step_size)
    u = np.array([[InputSignal(rows).at(float(t))[0] for t in line] for line in fine.times])
    assert (fine.mean * u).sum() == pytest.approx(0.7)
    if degree == 3:
        assert (fine.moment * u).sum() == pytest.approx(0.3 * 0.7 / 2.0)


@pytest.mark.parametrize("kind", ["linear", "hold", "spline"])
def test_a_table_says_what_its_rows_say(kind: str) -> None:
    """Values at the rows from both sides, between them as the interpolation has it."""
    times, values = np.array([0.0, 1.0, 3.0, 4.0]), np.array([1.0, 2.0, -1.0, 5.0])
    table = make_table(times, values, kind, (0.0, 4.0), extrapolates=False)
    group = TableGroup([table, table], 3)
    assert group.at(1.0) == pytest.approx([2.0, 2.0])
    before = {"linear": 2.0, "hold": 1.0, "spline": 2.0}[kind]
    rows, end = group.over(0.5, 1.0)
    assert end == pytest.approx([before] * 2)
    assert InputSignal(rows).at(0.5) == pytest.approx([before] * 2)
    rows, _ = group.over(1.0, 1.25)
    assert rows[0] == pytest.approx([2.0] * 2)
    assert table.jumps[:, 0].tolist() == (times[1:].tolist() if kind == "hold" else [])
    assert table.kinks.tolist() == ([1.0, 3.0] if kind == "linear" else [])


def test_an_end_within_rounding_of_a_jump_is_on_its_side() -> None:
    """0.1 + 0.2 is no double step beyond 0.3."""
    times, values = np.array([0.0, 0.3, 1.0]), np.array([0.0, 1.0, 0.0])
    group = TableGroup([make_table(times, values, "hold", (0.0, 1.0), extrapolates=False)], 3)
    assert 0.1 + 0.2 > 0.3
    rows, end = group.over(0.1, 0.1 + 0.2)
    assert (rows[0, 0], rows[1:].any(), end[0]) == (0.0, False, 0.0)
    rows, end = group.over(0.3 - 1e-17, 0.5)
    assert (rows[0, 0], rows[1:].any(), end[0]) == (1.0, False, 1.0)


@pytest.mark.parametrize(
    ("times", "values", "kind", "told"),
    [
        ([0, 2, 1, 3], [0] * 4, "linear", "row 3: the time 1.0 s is not above"),
        ([0, 1, 1, 1, 3], [0] * 5, "linear", "row 4: the time 1.0 s is not above"),
        ([0, 0, 0, 3], [0] * 4, "linear", "row 3: the time 0.0 s is not above"),
        ([1, 1], [0, 1], "linear", "all its rows have the same time"),
        ([0, 1, 1, 3], [0] * 4, "hold", "row 3: the time 1.0 s is not above"),
        ([0, 1, 1, 3], [0] * 4, "spline", "row 3: the time 1.0 s is not above"),
        ([0, 1, math.nan], [0] * 3, "linear", "row 3: the time is nan"),
        ([0, 1, 3], [0, math.inf, 0], "spline", "row 2: the value is inf"),
        ([0], [0], "linear", "1 rows are too few"),
        ([], [], "hold", "0 rows are too few"),
        ([1, 3], [0, 0], "linear", "from 1.0 s to 3.0 s do not cover the simulated time from 0.0"),
        ([0, 2], [0, 0], "spline", "do not cover the simulated time from 0.0 s to 3.0 s"),
        ([1, 2], [0, 0], "hold", "do not cover"),
    ],
)
def test_rows_that_are_no_table(times: Any, values: Any, kind: str, told: str) -> None:
    """Each mistake is told with its row."""
    rows = (np.array(times, float), np.array(values, float))
    with pytest.raises(InputTableError, match=told):
        make_table(*rows, kind, (0.0, STOP), extrapolates=False)


def test_double_steps_end_on_the_last_point_in_reach() -> None:
    """Or on the first one, after a rejection; never nearer than the smallest H allows."""
    points = LandingPoints([1.0, 1.2, 1.4, 3.0], 1e-3)
    assert points.target(0.9, 0.2, 9.0, first=False) == 1.2
    assert points.target(0.9, 0.2, 9.0, first=True) == 1.0
    assert points.target(0.9, 0.01, 9.0, first=False) == 9.0
    assert points.target(0.9, 0.04, 9.0, first=False) == 1.0, "two double steps share the way"
    assert points.target(0.9, 0.2, 1.1, first=False) == 1.0
    assert points.target(0.9999, 0.05, 9.0, first=False) == 9.0
    assert points.target(2.0, 5.0, 3.0005, first=False) == 3.0005


def test_a_point_inside_a_double_step_is_the_first_that_it_could_end_on() -> None:
    """Neither one at its end nor one nearer than the smallest H allows; none behind the last."""
    points = LandingPoints([1.0, 1.2, 1.4], 1e-3)

    def inside(begin: float, step_size: float) -> float | None:
        return points.inside(DoubleStepTimes.from_step_size(begin, step_size))

    assert inside(0.5, 0.4) == 1.0
    assert inside(0.5, 0.25) is None, "it ends there"
    assert inside(0.999, 0.15) == 1.2, "1.0 is too near"
    assert inside(1.0, 0.05) is None
    assert inside(1.3, 0.5) == 1.4
    assert inside(1.4, 0.5) is None
    assert inside(2.0, 0.5) is None


# ---- What drives a slave ------------------------------------------------------------------------


@settings(max_examples=25)
@given(
    st.lists(NUMBERS, min_size=1, max_size=4),
    st.sampled_from([*ESTIMATORS, "none"]),
    st.sampled_from([0.01, 0.3, 1.0]),
)
def test_a_polynomial_is_exact_whatever_the_step_size(
    coefficients: list[float], estimator: str, step_size: float
) -> None:
    """Law: an input that is a polynomial of degree 3 or less leaves no error and no rejection."""
    signal = np.polynomial.Polynomial(coefficients)
    result = driven(lambda t: float(signal(t)), estimator=estimator, initial_step_size=step_size)
    factorials = [1.0, 1.0, 2.0, 6.0]
    derivatives = [c * f for c, f in zip(coefficients, factorials, strict=False)]
    exact = polynomial_motion(result.time, derivatives)
    assert largest(states(result) - exact) < 1e-10 * max(1.0, largest(exact))
    assert result.summary["rejected_double_steps"] == 0


@pytest.mark.parametrize("kind", ["linear", "spline"])
def test_a_spline_of_a_cubic_is_the_cubic(kind: str) -> None:
    """Two different signals out of the same rows; that of the spline is exact."""
    times = np.linspace(0.0, STOP, 7)
    table = InputSettings(table=(times, times**3), interpolation=kind)
    result = driven(table, estimator="none", initial_step_size=0.1)
    deviation = largest(states(result) - polynomial_motion(result.time, [0.0, 0.0, 0.0, 6.0]))
    assert (deviation < 1e-9) == (kind == "spline")


@pytest.mark.parametrize(("order", "power"), [(0, 2), (1, 2), (2, 4), (3, 6)])
def test_the_order_of_a_function(order: int, power: int) -> None:
    """Law: with fixed H the error of the states falls as H^2, H^2, H^4, H^6."""
    signal = InputSettings(function=lambda t: math.sin(4.0 * t), order=order)
    errors = []
    for step_size in (0.1, 0.05):
        result = driven(signal, estimator="none", initial_step_size=step_size)
        exact = function_motion(result.time, lambda t: math.sin(4.0 * t))
        errors.append(largest(states(result) - exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(power, abs=0.4)


@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
def test_a_slave_without_interpolation_gets_means(estimator: str) -> None:
    """It is told constants only, and the states are of second order all the same."""
    errors = []
    for step_size in (0.02, 0.01):
        limits = {} if estimator == "none" else {"largest_step_size": step_size}
        run = attempted(
            lambda t: math.sin(4.0 * t),
            HELD,
            estimator=estimator,
            initial_step_size=step_size,
            relative_tolerance=1e-1,
            absolute_tolerance=1.0,
            **limits,
        )
        assert run.error is None
        assert run.warnings == [
            "oscillator cannot interpolate inputs (canInterpolateInputs): its external inputs are "
            "held at their mean in each step"
        ]
        exact = function_motion(run.result.time, lambda t: math.sin(4.0 * t))
        errors.append(largest(states(run.result) - exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize("estimator", quick_at(["mod"], ESTIMATORS))
@pytest.mark.parametrize("capabilities", [SLOPES, HELD])
def test_what_polynomials_leave_of_a_function_is_controlled(
    estimator: str, capabilities: Any
) -> None:
    """Law: nothing is coupled here, and yet tighter tolerances give smaller steps and errors."""
    errors, steps = [], []
    for tolerance in (1e-2, 1e-4):
        options = {"relative_tolerance": tolerance, "absolute_tolerance": tolerance}
        result = driven(lambda t: math.sin(40.0 * t), capabilities, estimator=estimator, **options)
        exact = function_motion(result.time, lambda t: math.sin(40.0 * t))
        errors.append(largest(states(result) - exact) / tolerance)
        steps.append(result.summary["communication_steps"])
    assert max(errors) < 100.0
    assert steps[0] < steps[1]


# ---- Jumps and kinks ----------------------------------------------------------------------------

STAIRS = ([0.0, 0.7071, 0.9, 1.7, 2.5], [0.0, 1.0, 0.5, 0.5, -2.0])


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("capabilities", [SLOPES, HELD])
def test_jumps_of_a_table_are_met_exactly(estimator: str, capabilities: Any) -> None:
    """Law: a communication point at each, nothing smeared over two steps, the history cut."""
    table = InputSettings(table=STAIRS, interpolation="hold")
    result = driven(table, capabilities, estimator=estimator)
    jumps = [0.7071, 0.9, 2.5]
    assert set(jumps) <= set(result.time.tolist())
    exact = table_motion(result.time, ([*STAIRS[0], STOP], [*STAIRS[1], 0.0]), hold=True)
    assert largest(states(result) - exact) < 1e-12
    assert result.summary["discontinuities"] == len(jumps)
    crossings = result.steps[result.steps["limiting_variable"] == "oscillator.u jumps"]
    assert (crossings["time"] + crossings["step_size"]).tolist() == pytest.approx(jumps, abs=1e-15)


def test_a_jump_within_the_tolerance_is_none() -> None:
    """It is passed as a kink is; the table in steps of 1e-6 costs no crossing."""
    times, values = np.linspace(0.0, STOP, 301), 1e-6 * np.arange(301)
    table = InputSettings(table=(times, values), interpolation="hold")
    result = driven(table)
    assert result.summary["discontinuities"] == 0
    assert result.summary["communication_steps"] < 300
    assert (
        largest(states(result) - table_motion(result.time, (times, 1e-6 * np.arange(301)))) < 1e-5
    )


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_two_rows_of_one_time_are_a_jump_of_a_linear_table(estimator: str) -> None:
    """Two rows of one time are a jump, as in Modelica's tables."""
    rows = ([0.0, 1.1, 1.1, STOP], [0.0, 1.0, -1.0, 0.0])
    result = driven(rows, estimator=estimator)
    assert 1.1 in result.time
    assert result.summary["discontinuities"] == 1
    assert largest(states(result) - table_motion(result.time, rows)) < 1e-11


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_breakpoints_of_a_function_are_jumps(estimator: str) -> None:
    """The value on the left holds before, that on the right behind, on which side it is closed.

    Those that are not within the simulated time say nothing.
    """
    for function in (lambda t: float(t >= 0.8), lambda t: float(t > 0.8)):
        signal = InputSettings(function=function, breakpoints=[STOP, 9.0, 0.8, -1.0, 0.0])
        result = driven(signal, estimator=estimator)
        assert 0.8 in result.time
        exact = table_motion(result.time, ([0.0, 0.8, STOP], [0.0, 1.0, 1.0]), hold=True)
        assert largest(states(result) - exact) < 1e-12


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_kinks_of_a_table_are_met_exactly(estimator: str) -> None:
    """Law: where the kinks are farther apart than the steps, all steps are smooth: no error."""
    rows = ([0.0, 1.1, 1.6, 1.61, STOP], [0.0, 0.0, 1.0, 0.2, 0.3])
    result = driven(rows, estimator=estimator)
    assert set(rows[0]) <= set(result.time.tolist())
    assert result.summary["discontinuities"] == 0
    assert result.summary["rejected_double_steps"] <= 3
    assert largest(states(result) - table_motion(result.time, rows)) < 1e-11


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("noise", [1e-2, 1e-4])
def test_rows_closer_than_the_accuracy_asks_for_are_passed_over(
    estimator: str, noise: float
) -> None:
    """Law: a table of 3001 rows costs what its effect on the slave asks for, not a step each."""
    times = np.linspace(0.0, STOP, 3001)
    values = np.sin(3.0 * times) + noise * np.random.default_rng(1).standard_normal(3001)
    result = driven((times, values), estimator=estimator)
    assert result.summary["communication_steps"] < 0.2 * len(times)
    rows = (times.tolist(), values.tolist())
    assert largest(states(result) - table_motion(result.time, rows)) < 1e-3


@pytest.mark.parametrize("step_size", [0.1, 0.07])
def test_fixed_steps_over_a_jump(step_size: float) -> None:
    """A jump on the grid is exact, also where T_0 + n H is not its time to the last bit.

    Beside the grid the error is that of a step of the right mean, and a warning says so.
    """
    table = InputSettings(table=([0.0, 0.3], [0.0, 1.0]), interpolation="hold")
    run = attempted(table, estimator="none", initial_step_size=step_size)
    assert run.error is None
    exact = table_motion(run.result.time, ([0.0, 0.3, STOP], [0.0, 1.0, 1.0]), hold=True)
    deviation = largest(states(run.result) - exact)
    if step_size == 0.1:
        assert run.warnings == []
        assert deviation < 1e-12
    else:
        assert run.warnings[0].startswith(
            "1 jumps of external inputs are not at communication points, the first one is that of "
            "oscillator.u at t=0.3 s"
        )
        assert 1e-9 < deviation < 2e-3


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_jumps_that_cannot_be_crossed_one_by_one_are_passed_over(estimator: str) -> None:
    """A slave that takes multiples of 0.05 s, and a table with rows each 0.01 s: right means."""
    times = np.linspace(0.0, STOP, 301)
    values = np.sin(3.0 * times)
    system = System(
        simulation={"stop_time": STOP, "estimator": estimator, "absolute_tolerance": 1e-2},
        slaves={"oscillator": {"step_multiple": 0.05}},
        inputs={"oscillator.u": InputSettings(table=(times, values), interpolation="hold")},
    )
    run = run_slaves(system, {"oscillator": OSCILLATOR.slave(capabilities=SLOPES)})
    assert run.error is None
    exact = table_motion(run.result.time, (times.tolist(), values.tolist()), hold=True)
    assert largest(states(run.result) - exact) < 1e-2


def test_events_and_jumps_at_one_time_are_one() -> None:
    """An event that the file names as well."""
    table = InputSettings(table=STAIRS, interpolation="hold")
    result = driven(table, events=[0.9, 1.3])
    assert {0.7071, 0.9, 1.3, 2.5} <= set(result.time.tolist())
    assert result.summary["discontinuities"] == 4


# ---- In a system --------------------------------------------------------------------------------

SUM, MODEL = "driven_models.py:Sum", "driven_models.py:Oscillator"


def test_outputs_at_t_0_are_consistent_with_external_inputs() -> None:
    """Law: through two levels of feed-through, in any order of the slaves, start values unused.

    An input that nobody drives keeps its start value, 70.
    """
    slaves = {name: {"model": SUM} for name in ("last", "first")}
    system = System(
        simulation={"stop_time": 1.0, "evaluate_outputs": True},
        slaves=slaves,
        connections=[("first.y", "last.u")],
        inputs={"first.u": lambda t: 2.0 + t, "first.w": 3, "last.w": ([0.0, 1.0], [5.0, 6.0])},
        base=SUPPORT,
    )
    result = simulate(system, in_process=True)
    t = result.time
    assert (result["first.y"][0], result["last.y"][0]) == (5.0, 10.0)
    assert result["first.y"] == pytest.approx(5.0 + t, rel=1e-14)
    assert result["last.y"] == pytest.approx(10.0 + 2.0 * t, rel=1e-14)
    system = System(
        simulation={"stop_time": 1.0},
        slaves={"s": {"model": SUM}},
        inputs={"s.u": 1.0},
        base=SUPPORT,
    )
    assert set(simulate(system, in_process=True)["s.y"].tolist()) == {71.0}


@pytest.mark.parametrize("evaluates", [False, True])
def test_outputs_that_contain_a_held_input(evaluates: bool) -> None:
    """Without interpolation they contain its mean; evaluated again, its value at that time."""
    gain = LinearSystem(
        a=-np.eye(1),
        b=np.zeros((1, 1)),
        c=np.zeros(1),
        inputs=("u",),
        outputs=("y",),
        of_states=np.zeros((1, 1)),
        of_inputs=np.eye(1),
    )
    system = System(
        simulation={"stop_time": 1.0, "evaluate_outputs": evaluates, "largest_step_size": 0.1},
        slaves={"gain": {"outputs_follow_inputs": True}},
        inputs={"gain.u": math.sin},
    )
    run = run_slaves(system, {"gain": gain.slave((0.0,), capabilities=HELD)})
    assert run.error is None
    deviation = largest(run.result["gain.y"] - np.sin(run.result.time))
    assert (deviation < 1e-15) == evaluates


@pytest.mark.parametrize("sequence", ["jacobi", "gauss-seidel"])
@pytest.mark.parametrize("estimator", quick_at(["mod", "none"], [*ESTIMATORS, "none"]))
def test_connected_and_external_inputs_of_one_slave(
    oscillator_dir: Path, sequence: str, estimator: str
) -> None:
    """The example with real FMUs: a bump, and a load at t = 3 s, against the exact motion."""
    system = load_system(EXAMPLE / "bump.toml")
    options: dict[str, Any] = {"sequence": sequence, "estimator": estimator, "stop_time": 4.0}
    if estimator == "none":
        options |= {"initial_step_size": 1e-3, "order": 2, "derivative_points": 1}
    system = with_models(system, oscillator_dir).with_simulation(**options)
    result = simulate(system, in_process=True)
    assert {1.05, 1.25, 1.3, 3.0} <= {round(t, 12) for t in result.time.tolist()}
    y = np.column_stack([result[f"{name}.{s}"] for name in ("wheel", "chassis") for s in "xv"])
    assert largest(y - bump_motion(result.time)) < 2e-3


def with_models(system: System, folder: Path) -> System:
    """``system`` with its FMUs in ``folder``."""
    slaves = {
        name: slave.model_copy(update={"model": str(folder / Path(str(slave.model)).name)})
        for name, slave in system.slaves.items()
    }
    return System(
        simulation=system.simulation,
        slaves=slaves,
        connections=system.connections,
        inputs=system.inputs,
        base=system.base,
    )


def bump_motion(times: np.ndarray) -> np.ndarray:
    """The whole car of the example, propagated exactly between the breakpoints, shape (n, 4)."""
    m_w, m_c, tyre, k, d = 40.0, 400.0, 150000.0, 15000.0, 1000.0
    car = LinearSystem(
        a=np.array(
            [
                [0.0, 1.0, 0.0, 0.0],
                [-(tyre + k) / m_w, -d / m_w, k / m_w, d / m_w],
                [0.0, 0.0, 0.0, 1.0],
                [k / m_c, d / m_c, -(k + 1.0) / m_c, -d / m_c],
            ]
        ),
        b=np.array([[0.0, 0.0], [tyre / m_w, 0.0], [0.0, 0.0], [0.0, 1.0 / m_c]]),
        c=np.zeros(4),
        inputs=(),
        outputs=(),
    )
    road = np.loadtxt(EXAMPLE / "road.csv", delimiter=",", skiprows=1)
    edges = sorted({*road[:, 0].tolist(), 3.0})
    x, motion = np.zeros(4), np.zeros((len(times), 4))
    for begin, end in pairwise(edges):
        z = np.interp([begin, end], road[:, 0], road[:, 1])
        force = 0.0 if begin < 3.0 else -1500.0
        u = np.array([[z[0], force], [(z[1] - z[0]) / (end - begin), 0.0]])
        for i in np.flatnonzero((times > begin) & (times <= end)):
            motion[i] = car.propagate(x, u, float(times[i] - begin))
        x = car.propagate(x, u, end - begin)
    return motion


def test_in_process_and_over_zenoh_the_same_bits(
    oscillator_dir: Path, no_process_left: None
) -> None:
    """Real FMU processes, driven by a table and a function; the load jumps within."""
    system = with_models(load_system(EXAMPLE / "bump.toml"), oscillator_dir)
    near = simulate(system, in_process=True, stop_time=3.5)
    far = simulate(system, stop_time=3.5)
    assert near.time.tobytes() == far.time.tobytes()
    assert near.outputs.tobytes() == far.outputs.tobytes()
    assert near.summary["discontinuities"] == 1


def test_a_python_model_takes_what_an_exact_slave_takes() -> None:
    """A function by name drives a Python model to the reference of the exact slave."""
    system = System(
        simulation={"stop_time": STOP, "slave_tolerance": 1e-10},
        slaves={"oscillator": {"model": MODEL}},
        inputs={"oscillator.u": {"function": "math:sin"}},
        base=SUPPORT,
    )
    result = simulate(system, in_process=True)
    assert largest(states(result) - function_motion(result.time, math.sin)) < 1e-4
    assert result.summary["settings"]["inputs"] == {"oscillator.u": {"function": "math:sin"}}


@pytest.mark.parametrize("suffix", ["csv", "npy", "npz", "structured.npy"])
def test_all_kinds_of_files_hold_the_same_table(suffix: str, tmp_path: Path) -> None:
    """Law: the same numbers give the same bits, whatever they come from."""
    t, z = np.linspace(0.0, STOP, 12), np.linspace(0.0, STOP, 12) ** 2 / 7.0
    path = tmp_path / f"table.{suffix}"
    if suffix == "csv":
        lines = [f"{a!r},9,{b!r}" for a, b in zip(t.tolist(), z.tolist(), strict=True)]
        path.write_text("\ufefftime, other, z\n" + "\n".join(lines) + "\n\n", encoding="utf-8")
    elif suffix == "npy":
        np.save(path, np.column_stack([t, z]))
    elif suffix == "npz":
        np.savez(path, time=t, z=z)
    else:
        np.save(path, np.rec.fromarrays([t, z], names="time,z"))
    setting = {"table": str(path), "interpolation": "spline"}
    if suffix == "csv":
        setting |= {"column": "z", "time": "time"}
    expected = driven(InputSettings(table=(t, z), interpolation="spline"))
    assert driven(setting).outputs.tobytes() == expected.outputs.tobytes()


def test_beyond_its_rows_a_table_can_hold() -> None:
    """With ``extrapolate = "hold"``: the first value before, the last one behind."""
    rows = ([0.5, 1.5], [1.0, -1.0])
    result = driven(InputSettings(table=rows, extrapolate="hold"))
    whole = ([0.0, 0.5, 1.5, STOP], [1.0, 1.0, -1.0, -1.0])
    assert largest(states(result) - table_motion(result.time, whole)) < 1e-11


# ---- Mistakes -----------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Files with mistakes, and one without."""
    texts = {
        "good.csv": "time,z,w\n0,0,1\n3,2,3\n",
        "short.csv": "time,z\n0,0\n1,2\n",
        "word.csv": "time,z\n0,0\n3,x\n",
        "back.csv": "time,z\n0,0\n2,1\n1,1\n",
        "bare.csv": "0,0\n3,1\n",
        "ragged.csv": "time,z\n0,0\n3\n",
        "twice.csv": "time,z,z\n0,0,0\n3,1,1\n",
        "empty.csv": "",
        "text.npy": "no array",
        "functions.py": "text = 'f'\ndef f(t): return t\ndef g(t): return 'x'\n"
        "def h(t): return float('nan')\n",
        "broken.py": "import no_such_module\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "three.npy", np.zeros((3, 3)))
    np.savez(tmp_path / "uneven.npz", t=np.zeros(2), z=np.zeros(3))
    with (tmp_path / "endless.npy").open("wb") as file:
        head = {"descr": "<f8", "fortran_order": False, "shape": (10**14, 2)}
        np.lib.format.write_array_header_1_0(file, head)
    return tmp_path


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ({"table": "good.csv"}, "good.csv has 2 columns beside the times; say which"),
        (
            {"table": "good.csv", "column": "Z"},
            "column = 'Z': good.csv has no such column; there is 'time', 'z'",
        ),
        ({"table": "good.csv", "column": "z", "time": "t"}, "time = 't': good.csv has no such"),
        ({"table": "god.csv"}, "no file .*god.csv; did you mean 'good.csv'"),
        ({"table": "good.doc"}, "good.doc: a table is a file .csv, .dat, .npy, .npz, .tsv, .txt"),
        ({"table": "short.csv"}, 'do not cover .* extrapolate = "hold" would'),
        ({"table": "word.csv"}, "word.csv: row 2: z = 'x' is not a number"),
        ({"table": "back.csv"}, "row 3: the time 1.0 s is not above"),
        ({"table": "bare.csv"}, "bare.csv: the first line must name the columns"),
        ({"table": "ragged.csv"}, "ragged.csv: row 2 has 1 values for 2 columns"),
        ({"table": "twice.csv"}, "twice.csv: two columns of one name"),
        ({"table": "empty.csv"}, "empty.csv: is empty"),
        ({"table": "text.npy"}, "text.npy: not a NumPy file of numbers"),
        ({"table": "objects.npy"}, "objects.npy: not a NumPy file of numbers"),
        ({"table": "endless.npy"}, "endless.npy: not a NumPy file of numbers"),
        ({"table": "three.npy"}, r"an array of shape \(3, 3\) is neither structured"),
        ({"table": "uneven.npz"}, "2 times in 't' and 3 values in 'z'"),
        ({"table": ([0.0, 1.0], [1.0])}, r"times of shape \(2,\) and values of shape \(1,\)"),
        ({"table": "good.csv", "order": 1}, "order is for functions, and this is a table"),
        ({"function": "functions.py:f", "time": "t"}, "time is for tables, and this is a function"),
        ({"table": "good.csv", "function": "f.py:f"}, "give either table or function"),
        ({"colum": "z"}, "unknown key 'colum'; did you mean 'column'"),
        ({"function": "functions"}, "'functions' does not name a function; write package.module"),
        ({"function": "functions.py:k"}, "no function 'k' there"),
        ({"function": "functions.py:text"}, "no function 'text' there"),
        ({"function": "function.py:f"}, "no file .*function.py; did you mean 'functions.py'"),
        ({"function": "broken.py:f"}, "import of .*broken.py failed: ModuleNotFoundError"),
        ({"function": "no.such:f"}, "no module 'no'; install its package"),
        ({"function": "functions.py:g"}, "oscillator.u is of type Real; it cannot be 'x'"),
        ({"function": "functions.py:h"}, "the function is nan at t=0.0 s"),
        ({"function": "functions.py:f", "breakpoints": [math.inf]}, "must be finite"),
        (True, "oscillator.u is of type Real; it cannot be True"),
        ("high", "oscillator.u is of type Real; it cannot be 'high'"),
        (math.nan, "oscillator.u = nan: must be finite"),
        ([1.0, 2.0], "must be a table"),
    ],
)
def test_mistakes_are_told_before_anything_starts(setting: Any, told: str, folder: Path) -> None:
    """Each names the input and what is wrong with it."""
    with pytest.raises(ConfigurationError, match=told) as caught:
        run_slaves(
            System(
                simulation={"stop_time": STOP},
                slaves={"oscillator": {}},
                inputs={"oscillator.u": setting},
                base=folder,
                source="system.toml",
            ),
            {"oscillator": OSCILLATOR.slave()},
        )
    assert "system.toml: [inputs" in str(caught.value)
    assert "oscillator.u" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("oscillator.w", "oscillator has no variable 'w'; there is 'u'"),
        ("oscilator.u", "no slave 'oscilator'; did you mean 'oscillator'"),
        (
            "oscillator.x",
            "oscillator.x is neither an input nor a tunable parameter but of causality output",
        ),
        ("oscillator.stiffness", "oscillator.stiffness is a fixed parameter, and only inputs and"),
        ("oscillator", "write slave.variable"),
        ("second.u", "second.u is driven twice: by oscillator.x and from here"),
    ],
)
def test_only_inputs_that_nothing_else_drives_can_be_driven(name: str, told: str) -> None:
    """Names are checked against the slaves, with the nearest ones in the message."""
    with pytest.raises(ConfigurationError, match=told):
        simulate(
            System(
                simulation={"stop_time": STOP},
                slaves={"oscillator": {"model": MODEL}, "second": {"model": MODEL}},
                connections=[("oscillator.x", "second.u")],
                inputs={name: 1.0},
                base=SUPPORT,
            ),
            in_process=True,
        )


def undefined(t: float) -> float:
    """No number from t = 0.7 s on."""
    return 1.0 if t < 0.7 else math.nan


@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
@pytest.mark.parametrize("function", [undefined, lambda t: math.sqrt(0.7 - t)])
def test_what_is_no_number_never_gets_to_a_slave(
    estimator: str, function: Callable[[float], float]
) -> None:
    """Law: such steps are rejected up to the smallest H; the error names input, time and cause."""
    run = attempted(function, estimator=estimator, smallest_step_size=1e-6, initial_step_size=1e-2)
    assert isinstance(run.error, StepSizeError if estimator != "none" else SlaveError)
    assert "oscillator.u" in str(run.error)
    assert "t=0.7" in str(run.error)
    assert np.isfinite(run.result.outputs).all()
    if estimator != "none":
        assert run.result.time[-1] == pytest.approx(0.7, abs=1e-5)


def test_a_function_that_fails_ends_the_run() -> None:
    """A smaller step would not help: the error says slave, time and cause at once."""
    run = attempted(lambda t: {0.0: 1.0}[t])
    assert isinstance(run.error, DoublestepError)
    assert str(run.error).startswith("oscillator: external input at t=0.0 s, H=")
    assert "the function of oscillator.u failed at t=" in str(run.error)
    assert "KeyError" in str(run.error)
