"""Slaves without rollback: stepped last and once, their coupling controlled by input defects."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from master_node import Result, System, load_system, simulate
from master_node.numerics.defect_control import TARGET, foreseen_step_size, largest_between
from master_node.numerics.error_estimators import node_polynomial
from master_node.numerics.initial_step_size import untried_step_size
from master_node.numerics.step_size_limits import SlaveLimits, StepSizeLimits
from master_node.observing.observers import Attempt, RunEnd, RunStart
from master_node.observing.progress import summary_table
from protocol.calls import StepResult, StepStatus
from protocol.description import Capabilities
from protocol.errors import (
    ConfigurationError,
    InterruptedRunError,
    SlaveError,
    StepRejectedError,
)
from protocol.slave import Slave
from tests.laws.test_convergence import AT_REST, RAMP, RAMP_WHEEL, exact_end
from tests.support.quarter_car_case import (
    ALL,
    CHASSIS,
    FORCE,
    STATES,
    WHEEL,
    LinearSlave,
    LinearSystem,
    Run,
    car,
    exact_solution,
    global_errors,
    run_slaves,
)
from tests.support.slow import quick_at

SEQUENCES = ("jacobi", "gauss-seidel")
NO_STATE = Capabilities(can_interpolate_inputs=True, can_handle_variable_step_size=True)
SLOPES = 1


class OneWay(LinearSlave):
    """A slave without rollback that does not bear a call for its state, nor a step back."""

    def __init__(
        self, system: LinearSystem, x: Sequence[float] = (0.0, 0.0), slopes: int = 0
    ) -> None:
        can = replace(NO_STATE, max_output_derivative_order=slopes)
        super().__init__(system, np.array(x, dtype=float), can)
        self.description = replace(self.description, state_kind="none")
        self.steps: list[tuple[float, float]] = []

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        if self.steps:
            last, size = self.steps[-1]
            assert communication_point == pytest.approx(last + size, rel=1e-14)
        self.steps.append((communication_point, step_size))
        return super().do_step(communication_point, step_size, prior)

    def get_state(self) -> object:
        """See `Slave`."""
        raise NotImplementedError

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        raise NotImplementedError

    def free_state(self, state: object) -> None:
        """See `Slave`."""
        raise NotImplementedError


def slave(system: LinearSystem, x: Sequence[float], *, rollback: bool, slopes: int = 0) -> Slave:
    """With rollback or without."""
    if not rollback:
        return OneWay(system, x, slopes)
    return system.slave(x, capabilities=replace(ALL, max_output_derivative_order=slopes))


def mixed_car(without: Collection[str], slopes: int = 0) -> dict[str, Slave]:
    """The exact quarter car; the slaves ``without`` rollback are `OneWay`."""
    return {
        name: slave(system, (0.0, 0.0), rollback=name not in without, slopes=slopes)
        for name, system in (("chassis", CHASSIS), ("wheel", WHEEL))
    }


def completed(run: Run) -> Result:
    """The result of a run that came to its end."""
    if run.error is not None:
        raise run.error
    assert run.result.summary["outcome"] == "completed"
    return run.result


def assert_went_once(result: Result, slaves: Mapping[str, Slave]) -> None:
    """Each slave without rollback took exactly the accepted steps, one after the other."""
    for name, one in slaves.items():
        if not isinstance(one, OneWay):
            continue
        assert [begin for begin, _ in one.steps] == result.time[:-1].tolist()
        assert sum(size for _, size in one.steps) == pytest.approx(result.time[-1])
        assert result.summary["do_steps"][name] == result.summary["communication_steps"]
        assert result.summary["rollbacks"][name] == 0


# ---- Four masses in a row: all kinds of coupling ------------------------------------------------

NAMES = ("a", "b", "c", "d")
STIFFNESS, DAMPING = 40.0, 0.4


def mass(*neighbours: str) -> LinearSystem:
    """A mass of 1 kg between two springs, at each a neighbour or a wall."""
    n = len(neighbours)
    return LinearSystem(
        a=np.array([[0.0, 1.0], [-2.0 * STIFFNESS, -2.0 * DAMPING]]),
        b=np.array([[0.0, 0.0] * n, [STIFFNESS, DAMPING] * n]),
        c=np.zeros(2),
        inputs=tuple(f"{q}_{side}" for side in neighbours for q in "xv"),
        outputs=("x", "v"),
    )


MASSES = {
    "a": mass("right"),
    "b": mass("left", "right"),
    "c": mass("left", "right"),
    "d": mass("left"),
}
CONNECTIONS = tuple(
    (f"{source}.{q}", f"{target}.{q}_{side}")
    for left, right in pairwise(NAMES)
    for source, target, side in ((left, right, "left"), (right, left, "right"))
    for q in "xv"
)


def row(without: Collection[str], slopes: int = 0) -> dict[str, Slave]:
    """The four slaves; the first one is displaced."""
    return {
        name: slave(
            MASSES[name],
            (0.1 if name == "a" else 0.0, 0.0),
            rollback=name not in without,
            slopes=slopes,
        )
        for name in NAMES
    }


def row_system(**simulation: Any) -> System:
    """Their system."""
    return System(
        simulation={"stop_time": 1.0, **simulation},
        slaves={name: {} for name in NAMES},
        connections=CONNECTIONS,
    )


def row_errors(result: Result) -> np.ndarray:
    """Largest error of the eight states at each communication point, shape (n,)."""
    a = np.zeros((8, 8))
    for i in range(4):
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = MASSES["a"].a
        for j in (i - 1, i + 1):
            if 0 <= j < 4:
                a[2 * i + 1, 2 * j : 2 * j + 2] = STIFFNESS, DAMPING
    values, vectors = np.linalg.eig(a)
    start = np.linalg.solve(vectors, np.eye(8)[0] * 0.1)
    exact = (vectors @ (np.exp(np.outer(values, result.time)) * start[:, np.newaxis])).real.T
    names = [f"{name}.{q}" for name in NAMES for q in "xv"]
    got = np.stack([result[name] for name in names], axis=1)
    return np.asarray(np.abs(got - exact).max(axis=1))


MIXTURES = [("b",), ("a", "c"), ("c", "d"), ("b", "c", "d"), NAMES]


@pytest.mark.parametrize("without", MIXTURES, ids="".join)
@pytest.mark.parametrize(
    ("estimator", "sequence", "slopes"),
    [("mod", "jacobi", 0), ("rich", "jacobi", SLOPES), ("mod", "gauss-seidel", SLOPES)],
)
def test_slaves_without_rollback_are_stepped_once(
    without: Collection[str], estimator: str, sequence: str, slopes: int
) -> None:
    """Law: whatever the mixture, no call for a state, no step twice, and the error is controlled.

    Couplings among those with rollback, among those without, and both ways between them; first
    slave, last slave, some, all.
    """
    slaves = row(without, slopes)
    system = row_system(estimator=estimator, sequence=sequence)
    result = completed(run_slaves(system, slaves))
    assert_went_once(result, slaves)
    assert row_errors(result).max() < 20e-4
    assert result.summary["discontinuities"] == 0


def test_a_rejection_leaves_slaves_without_rollback_where_they_are() -> None:
    """A first step that is much too long is taken back by the others before these have begun."""
    slaves = row(("d",))
    result = completed(run_slaves(row_system(initial_step_size=0.2), slaves))
    assert not result.steps["accepted"][0]
    assert result.summary["rollbacks"]["a"] > 0
    assert_went_once(result, slaves)


@pytest.mark.parametrize("without", MIXTURES, ids="".join)
@pytest.mark.parametrize("order", quick_at(["auto"], ["auto", 2]))
def test_the_tolerance_controls_the_error(without: Collection[str], order: Any) -> None:
    """Law: over three decades a tolerance ten times smaller makes the error several times smaller.

    And it stays near the tolerance, though nothing can be taken back.
    """
    errors = []
    for tolerance in (1e-3, 1e-4, 1e-5, 1e-6):
        system = row_system(
            order=order,
            stop_time=0.5,
            relative_tolerance=tolerance,
            absolute_tolerance=tolerance,
        )
        errors.append(row_errors(completed(run_slaves(system, row(without)))).max())
        assert errors[-1] < 30.0 * tolerance
    assert all(3.0 < larger / smaller < 40.0 for larger, smaller in pairwise(errors))


@pytest.mark.parametrize("without", [("chassis",), ("wheel",), ("chassis", "wheel")])
@pytest.mark.parametrize("slopes", quick_at([0], [0, SLOPES]))
def test_the_quarter_car_is_within_its_tolerance(without: Collection[str], slopes: int) -> None:
    """The paper's benchmark: an error below that with rollback in both, for more steps."""
    options = {"order": "auto", "initial_step_size": None}
    both = completed(run_slaves(car(**options), mixed_car((), slopes)))
    slaves = mixed_car(without, slopes)
    result = completed(run_slaves(car(**options), slaves))
    assert_went_once(result, slaves)
    assert global_errors(result).mean() < global_errors(both).mean()
    assert global_errors(result).max() < 3e-4
    steps = result.summary["communication_steps"]
    assert steps < 4 * both.summary["communication_steps"]
    assert result.summary["steps_above_tolerance"] < 0.1 * steps


# ---- Order --------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", quick_at([1, 3], range(4)))
@pytest.mark.parametrize("without", [("chassis",), ("wheel",), ("chassis", "wheel")])
def test_the_global_order_is_k_plus_1(without: Collection[str], k: int) -> None:
    """Law: with a fixed H, an exact start and polynomials of degree k the error falls as H^(k+1).

    The smooth ramp of ``test_convergence.py``; H is fixed by the rules of the slaves.
    """
    errors = []
    for step_size in (RAMP / 400, RAMP / 800):
        system = System(
            simulation={
                "stop_time": RAMP,
                "order": k,
                "initial_step_size": step_size,
                "relative_tolerance": 0.0,
                "absolute_tolerance": 1e3,
            },
            slaves={name: {"step_size": step_size} for name in ("chassis", "wheel")},
            connections=car().connections,
        )
        slaves = {
            "chassis": slave(CHASSIS, (0.0, 0.0), rollback="chassis" not in without),
            "wheel": slave(RAMP_WHEEL, AT_REST, rollback="wheel" not in without),
        }
        result = completed(run_slaves(system, slaves))
        assert result.summary["smallest_step_size"] == pytest.approx(step_size)
        states = [result[name][-1] for name in STATES]
        errors.append(np.linalg.norm(states - exact_end()))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(k + 1, abs=0.35)


# ---- The defects --------------------------------------------------------------------------------


class Course(OneWay):
    """An output that is a function of time; no inputs."""

    def __init__(self, course: Any) -> None:
        self.course = course
        self.time = 0.0
        empty = LinearSystem(np.zeros((1, 1)), np.zeros((1, 0)), np.zeros(1), (), ("y",))
        super().__init__(empty, (0.0,))

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.time = communication_point + step_size
        return super().do_step(communication_point, step_size, prior)

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        return np.array([[self.course(self.time)]])


FILTER = LinearSystem(a=-np.eye(1), b=np.ones((1, 1)), c=np.zeros(1), inputs=("u",), outputs=("x",))


def driven(course: Any, *, rollback: bool, **simulation: Any) -> tuple[System, dict[str, Slave]]:
    """A filter, x' = u - x, driven by a slave without rollback."""
    system = System(
        simulation={"stop_time": 2.0, **simulation},
        slaves={"source": {}, "filter": {}},
        connections=[("source.y", "filter.u")],
    )
    return system, {"source": Course(course), "filter": slave(FILTER, (0.0,), rollback=rollback)}


@pytest.mark.parametrize("rollback", [True, False])
@pytest.mark.parametrize("k", range(4))
def test_the_defect_that_was_foreseen_comes_true(k: int, rollback: bool) -> None:
    """Law: where u^(k+1) is constant the defect of a step is what its H was chosen for, exactly.

    On any grid: H grows at first, and is made for each next step from the nodes as they are.
    """
    system, slaves = driven(
        lambda t: t ** (k + 1),
        rollback=rollback,
        order=k,
        relative_tolerance=0.0,
        absolute_tolerance=(1e-2, 1e-5, 1e-6, 1e-6)[k],
        initial_history="none",
        initial_step_size=1e-4,
    )
    result = completed(run_slaves(system, slaves))
    steps = result.steps[: -4 if rollback else -3]  # H of the last ones comes from the stop time
    settled = steps[steps["time"] > 0.5]
    assert len(settled) > 3
    assert settled["error_norm"] == pytest.approx(TARGET, rel=1e-2)
    assert set(settled["limiting_variable"]) == {"source.y"}


@pytest.mark.parametrize("without", [("wheel",), ("chassis", "wheel")])
def test_a_step_beyond_the_tolerance_is_taken_counted_and_followed_by_smaller_ones(
    without: Collection[str],
) -> None:
    """No rejection is possible: a first step that is too long stands, with its ERR."""
    slaves = mixed_car(without)
    result = completed(run_slaves(car(initial_step_size=0.05, stop_time=1.0), slaves))
    first, second = result.steps[:2]
    assert first["accepted"]
    assert first["error_norm"] > 1.0
    assert second["step_size"] < first["step_size"]
    norms = result.steps["error_norm"]
    assert result.summary["steps_above_tolerance"] == np.count_nonzero(norms > 1.0)
    assert result.summary["rejected_double_steps"] == 0
    assert_went_once(result, slaves)


def step_at_1(t: float) -> float:
    """A jump at t = 1 s."""
    return float(t >= 1.0)


def filtered(t: np.ndarray, jump: float) -> np.ndarray:
    """The filter's answer to a jump."""
    return np.asarray(np.where(t > jump, 1.0 - np.exp(-(t - jump)), 0.0))


@pytest.mark.parametrize("rollback", [True, False])
def test_a_jump_is_seen_and_begun_anew_behind(rollback: bool) -> None:
    """Nothing can be taken back, but the defect shows it: the history is cut, and H small."""
    system, slaves = driven(step_at_1, rollback=rollback, largest_step_size=0.05)
    result = completed(run_slaves(system, slaves))
    assert result.summary["discontinuities"] == 1
    (index,) = np.flatnonzero(result.steps["limiting_variable"] == "source.y jumps")
    at, behind = result.steps[index], result.steps[index + 1]
    assert at["time"] < 1.0 <= behind["time"]
    assert at["accepted"]
    assert at["error_norm"] > 1.0
    assert behind["step_size"] < 0.1 * at["step_size"]
    reached = result.time[np.argmax(result["source.y"] > 0.5)]
    latest = np.abs(result["filter.x"] - filtered(result.time, 1.0)).max()
    assert latest <= 1.5 * (reached - 1.0) + 2.0 * at["step_size"]


@pytest.mark.parametrize("rollback", [True, False])
def test_events_are_met_and_crossed(rollback: bool) -> None:
    """A declared jump costs two steps of the smallest size, and no error."""
    options = {"events": [1.0], "smallest_step_size": 1e-6}
    system, slaves = driven(step_at_1, rollback=rollback, **options)
    result = completed(run_slaves(system, slaves))
    assert 1.0 in result.time
    assert result.summary["discontinuities"] == 1
    assert "event" in result.steps["limiting_variable"]
    assert_went_once(result, slaves)
    error = np.abs(result["filter.x"] - filtered(result.time, 1.0))
    assert error.max() < 2e-4


# ---- All without rollback -----------------------------------------------------------------------


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_a_system_without_any_rollback_adapts_its_steps(sequence: str) -> None:
    """One round trip for each step (a slave each with Gauss-Seidel), no rejection, and few steps
    where the motion has died out.
    """
    slaves = mixed_car(("chassis", "wheel"), SLOPES)
    system = car(sequence=sequence, order="auto", initial_step_size=None)
    result = completed(run_slaves(system, slaves))
    assert_went_once(result, slaves)
    assert result.steps["accepted"].all()
    steps = result.summary["communication_steps"]
    assert result.summary["round_trips"] == steps * (1 if sequence == "jacobi" else 2)
    early = np.count_nonzero(result.time < 1.0)
    late = np.count_nonzero(result.time > 3.0)
    assert late < 0.5 * early
    assert len(set(result.steps["order"].tolist())) > 1


def test_steps_follow_the_rules_of_the_slaves() -> None:
    """Multiples of a clock, also without any rollback."""
    system, slaves = driven(math.sin, rollback=False)
    system = System(
        simulation=system.simulation,
        slaves={"source": {"step_multiple": 0.01}, "filter": {}},
        connections=system.connections,
    )
    result = completed(run_slaves(system, slaves))
    assert result.time.tolist() == [round(t / 0.01) / 100 for t in result.time]
    assert len(set(np.rint(np.diff(result.time) / 0.01))) > 1
    assert result.time[-1] == 2.0


# ---- What slaves refuse -------------------------------------------------------------------------


class Refuses(OneWay):
    """From t = 0.5 s on: discards, fails, gives NaN, or ends the simulation."""

    def __init__(self, system: LinearSystem, how: str) -> None:
        self.how = how
        self.reached = 0.0
        super().__init__(system)

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.reached = communication_point + step_size
        if self.reached > 0.5:
            if self.how == "discard":
                return StepResult(StepStatus.DISCARD, 0.5)
            if self.how == "error":
                raise StepRejectedError("fmi2DoStep returned fmi2Error")
            if self.how == "terminated":
                return StepResult(StepStatus.TERMINATED, communication_point)
        return super().do_step(communication_point, step_size, prior)

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        y = super().get_outputs(order)
        if self.how == "nan" and self.reached > 0.5:
            y[0, 0] = math.nan
        return y


@pytest.mark.parametrize("without", [("wheel",), ("chassis", "wheel")])
@pytest.mark.parametrize(
    ("how", "cause"),
    [
        ("discard", r"fmi2Discard: the step was completed only up to t=0\.5"),
        ("error", "fmi2DoStep returned fmi2Error"),
        ("nan", r"wheel\.x is not finite"),
    ],
)
def test_a_step_that_is_not_completed_ends_the_run(
    without: Collection[str], how: str, cause: str
) -> None:
    """It cannot be taken back: an error with slave, t, H and remedy; results up to there."""
    slaves = {**mixed_car(without), "wheel": Refuses(WHEEL, how)}
    run = run_slaves(car(order="auto"), slaves)
    assert isinstance(run.error, SlaveError)
    assert run.error.exit_code == 4
    text = str(run.error)
    assert "cannot be taken back" in text
    assert "largest_step_size" in text
    assert 'state = "fork"' in text
    if how != "nan":
        assert run.error.slave == "wheel"
    assert re.search(cause, text)
    assert run.error.time is not None
    assert run.error.step_size is not None
    assert run.error.time <= 0.5 < run.error.time + 2.0 * run.error.step_size + 1e-12
    assert run.result.summary["outcome"] == "failed"
    assert 0.3 < run.result.time[-1] <= 0.5
    assert np.isfinite(run.result.outputs).all()


@pytest.mark.parametrize("without", [("wheel",), ("chassis", "wheel")])
def test_a_slave_without_rollback_may_end_the_simulation(without: Collection[str]) -> None:
    """fmi2Terminated is an orderly end."""
    slaves = {**mixed_car(without), "wheel": Refuses(WHEEL, "terminated")}
    run = run_slaves(car(order="auto"), slaves)
    assert run.error is None
    assert run.result.summary["outcome"] == "terminated by a slave"
    assert run.result.summary["message"].startswith("wheel ended the simulation after t=0.4")


class LimitedStep(LinearSlave):
    """Discards steps longer than 2 ms."""

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        if step_size > 2e-3:
            return StepResult(StepStatus.DISCARD, communication_point + 2e-3)
        return super().do_step(communication_point, step_size, prior)


def test_a_discard_of_a_slave_with_rollback_is_a_rejection() -> None:
    """The others have not begun: they never notice."""
    slaves = {"chassis": LimitedStep(CHASSIS, np.zeros(2)), "wheel": OneWay(WHEEL)}
    result = completed(run_slaves(car(initial_step_size=8e-3, stop_time=0.2), slaves))
    assert result.steps["limiting_variable"][0] == "chassis: discard"
    assert result.summary["rejected_double_steps"] > 1
    assert_went_once(result, slaves)


class Interrupts:
    """Ctrl-C at the tenth attempt."""

    def __init__(self) -> None:
        self.left = 10

    def started(self, start: RunStart) -> None:
        """See `Observer`."""

    def attempted(self, attempt: Attempt) -> None:
        """See `Observer`."""
        self.left -= 1
        if not self.left:
            raise KeyboardInterrupt

    def ended(self, end: RunEnd) -> None:
        """See `Observer`."""


@pytest.mark.parametrize("without", [("wheel",), ("chassis", "wheel")])
def test_an_interrupted_run_keeps_its_results(without: Collection[str]) -> None:
    """Accepted steps stay in the results."""
    run = run_slaves(car(order="auto"), mixed_car(without), [Interrupts()])
    assert isinstance(run.error, InterruptedRunError)
    assert run.result.summary["outcome"] == "interrupted"
    assert len(run.result.steps) == 10
    assert len(run.result.time) == 1 + 10 * (2 if len(without) == 1 else 1)


# ---- What is said -------------------------------------------------------------------------------


def test_evaluated_outputs_and_slaves_without_rollback_exclude_each_other() -> None:
    """The others' outputs would be evaluated before these have theirs: said before the run."""
    slaves = {
        "chassis": OneWay(replace(CHASSIS, inputs=("F",), b=np.array([[0.0], [1.0]]))),
        "wheel": WHEEL.slave(),
    }
    system = System(
        simulation={"stop_time": 1.0, "evaluate_outputs": True},
        slaves={"chassis": {}, "wheel": {}},
        connections=[FORCE[0]],
    )
    with pytest.raises(ConfigurationError, match=r"^chassis: .*leave out evaluate_outputs"):
        run_slaves(system, slaves)


@pytest.mark.parametrize(
    ("without", "double_step", "input_defects"),
    [
        ((), NAMES, ""),
        (("d",), "abc", "cd"),
        (("b", "c"), "ad", "abcd"),
        (NAMES, "", NAMES),
    ],
)
def test_the_summary_says_which_outputs_are_controlled_how(
    without: Collection[str], double_step: Sequence[str], input_defects: Sequence[str]
) -> None:
    """Those with rollback by double steps; all that touch a slave without by input defects."""
    result = completed(run_slaves(row_system(stop_time=0.1), row(without)))
    summary = result.summary
    assert summary["controlled_by"] == {
        "double_step": [f"{name}.{q}" for name in double_step for q in "xv"],
        "input_defects": [f"{name}.{q}" for name in input_defects for q in "xv"],
    }
    assert summary["state_kind"] == {n: "none" if n in without else "native" for n in NAMES}
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(summary_table(summary))
    assert ("controlled by input defects" in console.export_text()) == bool(without)
    fixed = completed(run_slaves(row_system(stop_time=0.1, estimator="none"), row(without)))
    assert fixed.summary["controlled_by"] == {"double_step": [], "input_defects": []}


# ---- Real processes and FMUs --------------------------------------------------------------------


@pytest.mark.usefixtures("no_process_left")
@pytest.mark.parametrize(
    ("file", "without"),
    [("wheel_without_state.toml", ("wheel",)), ("nothing_saved.toml", ("chassis", "wheel"))],
)
def test_fmus_without_saved_states_run_under_error_control(
    file: str, without: Collection[str], no_rollback_dir: Path, tmp_path: Path
) -> None:
    """The examples, with real FMUs in processes of their own, over Zenoh, and the same bits in this
    process.
    """
    system = load_system(no_rollback_dir / file)
    result = simulate(system, output=tmp_path / "results")
    assert global_errors(result).max() < 3e-4
    summary = json.loads((tmp_path / "results" / "summary.json").read_text())
    for name in without:
        assert summary["state_kind"][name] == "none"
        assert summary["rollbacks"][name] == 0
        assert summary["do_steps"][name] == summary["communication_steps"]
    assert summary["settings"]["models"]["wheel"]["state_kind"] == "none"
    assert "wheel.x" in summary["controlled_by"]["input_defects"]
    local = simulate(system, in_process=True)
    assert local.time.tobytes() == result.time.tobytes()
    assert local.outputs.tobytes() == result.outputs.tobytes()
    assert result["wheel.x"][-1] == pytest.approx(exact_solution(4.0)[0, 2], abs=2e-4)


# ---- The numerics alone -------------------------------------------------------------------------


@given(st.lists(st.floats(-3.0, 0.0), min_size=1, max_size=4), st.floats(0.1, 2.0))
def test_the_largest_product_of_distances(nodes: list[float], step_size: float) -> None:
    """Not above what a hundred times as many points find, and hardly below."""
    fine = max(
        abs(node_polynomial((step_size, *nodes[1:]), s)) for s in np.linspace(0.0, step_size, 801)
    )
    found = largest_between((step_size, *nodes[1:]), 0.0, step_size)
    assert 0.97 * fine <= found <= fine * (1.0 + 1e-12)


@given(st.floats(1e-6, 1e6), st.integers(1, 4), st.floats(1e-3, 1.0), st.floats(1.0, 1e3))
def test_the_foreseen_step_size(size: float, power: int, smallest: float, largest: float) -> None:
    """The H for which the norm is the target, within its bounds."""

    def norm(step_size: float) -> float:
        return size * step_size**power

    found = foreseen_step_size(norm, smallest, largest)
    wanted = (TARGET / size) ** (1.0 / power)
    assert found == pytest.approx(min(largest, max(smallest, wanted)), rel=1e-3)
    if smallest < found < largest:
        assert norm(found) <= TARGET


def test_a_norm_that_is_not_a_number_gives_the_smallest_step() -> None:
    """NaN never passes."""
    assert foreseen_step_size(lambda _: math.nan, 1e-3, 1.0) == 1e-3


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_in_two_untried_steps_outputs_change_by_their_tolerance_at_most(
    slope: float, tolerance: float
) -> None:
    """The first step cannot be taken back."""
    step_size = untried_step_size(
        np.array([1.0]), np.array([slope]), np.array([tolerance]), duration=1.0
    )
    assert 2.0 * step_size * slope <= tolerance * (1.0 + 1e-12)


@given(st.floats(-5.0, 5.0), st.floats(0.05, 20.0), st.floats(1e-3, 5.0))
def test_single_steps_end_exactly_on_their_target(
    begin: float, duration: float, step_size: float
) -> None:
    """However far it is: no step larger than wanted, none after the target, no sliver."""
    target, time, sizes = begin + duration, begin, []
    limits = StepSizeLimits.of([], 1e-6, 10.0, long_step=False)
    wanted = min(step_size, limits.largest)
    while time < target:
        time, size = limits.step(begin, time, wanted, target)
        sizes.append(size)
        assert size <= wanted
    assert time == target
    assert min(sizes) >= min(wanted, duration) / 2.0 * (1.0 - 1e-9)


@given(st.integers(1, 400), st.integers(1, 50))
def test_single_steps_on_a_grid_are_multiples_of_it(number: int, units: int) -> None:
    """In the decimal digits that were given."""
    limits = StepSizeLimits.of([SlaveLimits("a", step_multiple=0.01)], 1e-6, 10.0, long_step=False)
    target, time = number / 100, 0.0
    while time < target:
        time, size = limits.step(0.0, time, units * 0.01, target)
        assert size == pytest.approx(round(size / 0.01) * 0.01, rel=1e-12)
        assert time == round(time / 0.01) / 100
    assert time == target
