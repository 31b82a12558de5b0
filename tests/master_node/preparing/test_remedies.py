"""Remedies of the master for findings of trial steps: before the run, named, no more."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_node import System, simulate
from master_node.coupling.step_sizes import with_fixed_steps
from master_node.preparing.configuring import configure
from master_node.preparing.preparation import Prepared, prepare
from master_node.simulation import run
from master_node.slaves.group import SlaveGroup
from master_node.slaves.link import LocalSlave, SlaveLink
from master_node.slaves.restorable import RestorableSlave
from protocol.calls import Configure, Reply, StepResult
from protocol.description import Examination, InputDerivatives, StateKind, StateVerdict
from protocol.errors import (
    ConfigurationError,
    ModelError,
    SlaveCrashedError,
    SlaveError,
    StepSizeError,
)
from protocol.slave import Slave
from slave_node.execution.executor import Executor
from slave_node.substeps.slave import with_substeps
from tests.support.quarter_car_case import (
    ALL,
    CHASSIS,
    DISPLACEMENT,
    STATES,
    WHEEL,
    car,
    run_slaves,
)
from tests.support.trial_slaves import (
    BrokenSlave,
    ClockedSlave,
    EulerSlave,
    LosingSlave,
    NotRepeatingSlave,
    RestartingSlave,
    TimedSlave,
    described,
)

Make = Callable[[], TimedSlave]
HELD = replace(ALL, can_interpolate_inputs=False)


class CrashingSlave(TimedSlave):
    """Takes its process along when its state is to be saved."""

    def get_state(self) -> object:
        """See `Slave`."""
        raise SlaveCrashedError("died by SIGSEGV")


class MortalLink(LocalSlave):
    """Behind a crash there is nobody any more."""

    _has_crashed = False

    def finish(self) -> Reply:
        """See `SlaveLink`."""
        if self._has_crashed:
            return Reply([], SlaveCrashedError("the process that held the model is gone"), 0.0)
        reply = super().finish()
        self._has_crashed = isinstance(reply.error, SlaveCrashedError)
        return reply


class Workshop:
    """Loads slaves in any configuration, as slave nodes do, and counts what happens to them.

    Args:
        faulty: a chassis for each kind of saved states that its model has.
    """

    def __init__(self, faulty: Mapping[str, Make], **simulation: Any) -> None:
        self.faulty = faulty
        self.loaded: list[Configure] = []
        self.resets = 0
        self.system = System(
            simulation={"stop_time": 1.0, "initial_step_size": 4e-3, **simulation},
            slaves={"chassis": {}, "wheel": {}},
            connections=DISPLACEMENT,
        )
        wheel = TimedSlave(WHEEL, (0.0, 0.1))
        self.executors = {
            "chassis": Executor(self.load(Configure()), self.load),
            "wheel": Executor(wheel),
        }
        self.links: dict[str, SlaveLink] = {
            name: LocalSlave(executor) for name, executor in self.executors.items()
        }
        self.group = SlaveGroup(self.links)

    def load(self, configuration: Configure) -> Slave:
        """The chassis in this configuration."""
        self.loaded.append(configuration)
        kind = configuration.state_kind or next(iter(self.faulty))
        if kind not in self.faulty:
            raise ModelError(f"no states by {kind}")
        slave = self.faulty[kind]()
        described(slave, state_kind=StateKind(kind))
        reset = slave.reset

        def counted() -> None:
            self.resets += 1
            reset()

        slave.reset = counted  # type: ignore[method-assign]
        return with_substeps(slave, configuration)

    def prepare(self) -> Prepared:
        """Prepares a system as a run does."""
        loaded = {name: link.description for name, link in self.executors.items()}
        descriptions = configure(self.links, self.system, loaded)
        return prepare(self.group, self.system, descriptions, {})


def test_exact_slaves_stay_where_they_are() -> None:
    """No reset, nothing loaded anew, and the outputs at T_0 are handed on."""
    workshop = Workshop({"native": TimedSlave})
    prepared = workshop.prepare()
    assert prepared.outputs is not None
    assert workshop.resets == 0
    assert workshop.loaded == [Configure()]
    assert prepared.system is workshop.system
    assert not prepared.warnings
    assert {e.state_verdict for e in prepared.examinations.values()} == {StateVerdict.EXACT}
    assert set(prepared.examinations) == {"chassis", "wheel"}


@pytest.mark.parametrize(
    ("faulty", "kind", "loaded"),
    [
        ({"native": NotRepeatingSlave, "fork": TimedSlave}, "fork", ["fork"]),
        ({"native": BrokenSlave, "fork": TimedSlave}, "fork", ["fork"]),
        ({"native": LosingSlave, "fork": TimedSlave}, "fork", ["fork"]),
        ({"native": BrokenSlave, "replay": TimedSlave}, "replay", ["fork", "", "replay"]),
        (
            {"native": BrokenSlave, "fork": BrokenSlave, "replay": TimedSlave},
            "replay",
            ["fork", "replay"],
        ),
        ({"fork": NotRepeatingSlave, "replay": TimedSlave}, "replay", ["replay"]),
        (
            dict.fromkeys(("native", "fork", "replay", "none"), NotRepeatingSlave),
            "none",
            ["fork", "replay", "none"],
        ),
    ],
)
def test_states_that_cannot_be_trusted_are_saved_in_another_way(
    faulty: dict[str, Make], kind: str, loaded: list[str]
) -> None:
    """Native -> fork -> replay -> none, with what the model allows; a refused one is left as it
    was. The user is told, and the slaves are to be initialized again.
    """
    workshop = Workshop(faulty)
    prepared = workshop.prepare()
    assert prepared.descriptions["chassis"].state_kind == kind
    assert [c.state_kind for c in workshop.loaded[1:]] == loaded
    assert prepared.warnings[0].startswith("chassis: its saved states (")
    last = prepared.examinations["chassis"].state_verdict
    assert prepared.outputs is not None
    if kind == "none":
        assert last is StateVerdict.NOT_TESTED  # it takes no trial steps any more
        assert prepared.warnings[-1].endswith("steps cannot be taken back")
    else:
        assert last is StateVerdict.EXACT


@pytest.mark.parametrize("recovers", [True, False])
def test_a_crash_on_trial(recovers: bool) -> None:
    """Where the slave can be started again, the next way to save its states is taken; else the
    crash is the error, and not what cannot be done afterwards.
    """
    workshop = Workshop({"native": CrashingSlave, "fork": TimedSlave})
    crashed = workshop.executors["chassis"]

    def restart() -> LocalSlave:
        return LocalSlave(Executor(workshop.load(Configure()), workshop.load))

    workshop.links["chassis"] = RestorableSlave(
        "chassis", MortalLink(crashed), crashed.description, restart if recovers else None
    )
    workshop.group = SlaveGroup(workshop.links)
    if recovers:
        prepared = workshop.prepare()
        assert prepared.descriptions["chassis"].state_kind == "fork"
        (warning,) = prepared.warnings
        assert "cannot be trusted: get_state: died by SIGSEGV; fork instead" in warning
    else:
        with pytest.raises(SlaveCrashedError, match=r"^chassis: get_state.*: died by SIGSEGV$"):
            workshop.prepare()


def test_a_solver_that_restarts_is_named_and_accepted() -> None:
    """The slaves are reset, so that the run begins as one without trial steps."""
    workshop = Workshop({"native": RestartingSlave})
    prepared = workshop.prepare()
    (warning,) = prepared.warnings
    assert warning.startswith("chassis: going back to a saved state restarts the model's solver")
    assert workshop.resets == 1
    assert prepared.outputs is not None
    assert len(workshop.loaded) == 1


def test_a_clock_puts_h_on_its_grid() -> None:
    """By a rule for that slave, and for nobody else."""
    workshop = Workshop({"native": lambda: ClockedSlave(0.01)})
    prepared = workshop.prepare()
    assert prepared.system.slaves["chassis"].step_multiple == 0.01
    assert prepared.system.slaves["wheel"].step_multiple is None
    assert prepared.warnings == (
        "chassis: its outputs move only at multiples of 0.01 s; its communication steps are now "
        "multiples of that",
    )
    assert prepared.outputs is not None


def test_with_emulated_inputs_substeps_are_on_the_grid_of_the_clock_too() -> None:
    """The slave is loaded anew for that, and told of it once."""
    workshop = Workshop({"native": lambda: ClockedSlave(0.01, capabilities=HELD)})
    prepared = workshop.prepare()
    assert prepared.system.slaves["chassis"].step_multiple == 0.01
    assert workshop.loaded[1:] == [Configure(largest_substep=0.01)]
    assert len(prepared.warnings) == 1


@pytest.mark.parametrize("rule", [{"step_size": 0.02}, {"step_multiple": 0.005}])
def test_what_the_user_says_wins(rule: dict[str, float]) -> None:
    """The clock is reported, and the rule stays."""
    workshop = Workshop({"native": lambda: ClockedSlave(0.01)}, estimator="mod")
    workshop.system = workshop.system.with_slave("chassis", **rule)
    prepared = workshop.prepare()
    assert prepared.system is workshop.system
    assert prepared.examinations["chassis"].internal_clock == 0.01
    assert prepared.warnings[0].endswith("its step sizes are left as they are given")


def test_a_clock_that_does_not_fit_the_run_is_only_reported() -> None:
    """From 0 s to 1 s there is no even number of steps of 0.03 s: an error before the run for a
    rule of the user, but no reason to refuse a run that he did not restrict.
    """
    workshop = Workshop({"native": lambda: ClockedSlave(0.03)})
    prepared = workshop.prepare()
    assert prepared.system is workshop.system
    (warning,) = prepared.warnings
    assert "its outputs move only at multiples of 0.03 s, but" in warning
    assert "even number of steps" in warning


def test_one_euler_step_per_do_step_is_split_into_substeps() -> None:
    """Substeps are as short as the trial steps showed, rounded down to two digits."""
    workshop = Workshop({"native": EulerSlave})
    prepared = workshop.prepare()
    largest = workshop.loaded[-1].largest_substep
    assert largest is not None
    assert largest == float(f"{largest:.1e}")
    held, warning = prepared.warnings
    assert "its input derivatives are emulated" in held  # it takes the values only
    assert f"substeps of {largest!r} s at most; up to 0.1 of the tolerance" in warning
    assert prepared.examinations["chassis"].step_dependence < 1.0  # as it is now


def test_input_derivatives_that_are_refused_are_emulated() -> None:
    """A model may declare them, and take some orders only (FMI 2.0 cannot say that). Those that it
    takes stay in use.
    """

    class SomeOrders(TimedSlave):
        highest = 1

        def set_inputs(self, derivatives: np.ndarray) -> None:
            if len(derivatives) > self.highest + 1:
                raise SlaveError(f"orders 1 to {self.highest} are supported")
            super().set_inputs(derivatives)

    class NoOrder(SomeOrders):
        highest = 0

    for faulty, highest, text in (
        (SomeOrders, 1, "it makes use of input derivatives up to order 1 only"),
        (NoOrder, 0, "its input derivatives are emulated, as it makes no use of any"),
    ):
        workshop = Workshop({"native": faulty})
        prepared = workshop.prepare()
        assert prepared.descriptions["chassis"].input_derivatives is InputDerivatives.EMULATED
        assert text in prepared.warnings[0]
        assert workshop.loaded[1:] == [Configure(max_input_order=highest)]
        assert prepared.examinations["chassis"].state_verdict is StateVerdict.EXACT
    assert Workshop({"native": SomeOrders}, order=1).prepare().warnings == ()


@pytest.mark.parametrize("settings", [{"estimator": "none"}, {"examine": False}])
def test_no_trial_steps_where_nothing_hangs_on_them(settings: dict[str, Any]) -> None:
    """Without an estimator nobody goes back; and the user can leave them out."""
    workshop = Workshop({"native": BrokenSlave}, **settings)
    prepared = workshop.prepare()
    assert not prepared.examinations
    assert prepared.outputs is None
    assert len(workshop.loaded) == 1


class Unresettable(RestartingSlave):
    """Some tools have no fmi2Reset."""

    is_ready = False

    def reset(self) -> None:
        """See `Slave`."""
        if self.is_ready:
            raise SlaveError("fmi2Reset is not supported")
        super().reset()
        self.is_ready = True


class Unrefreshed(RestartingSlave):
    """After a reset it begins elsewhere."""

    initializations = 0

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""
        super().exit_initialization_mode()
        self.x = self.x + 0.5 * self.initializations
        self.initializations += 1


@pytest.mark.parametrize(
    ("faulty", "reason"),
    [
        (Unresettable, "fmi2Reset is not supported"),
        (Unrefreshed, "its outputs at the start are others than before"),
    ],
)
def test_a_slave_whose_reset_is_broken_is_loaded_anew(faulty: Make, reason: str) -> None:
    """And that is said. Where it cannot be loaded, the run ends with a remedy."""
    workshop = Workshop({"native": faulty})
    prepared = workshop.prepare()
    assert f"chassis: its reset is broken: {reason}; it is loaded anew" in prepared.warnings[-1]
    assert len(workshop.loaded) == 2
    assert prepared.outputs is not None
    assert prepared.outputs.y[0].tolist() == [0.1, 0.0, 0.0, 0.1]
    workshop = Workshop({"native": faulty})
    workshop.executors["chassis"]._load = None
    with pytest.raises(SlaveError, match=r"(not supported|loaded anew); leave the trial steps out"):
        workshop.prepare()


# ---- Runs ---------------------------------------------------------------------------------------


def lags(base: Path, first: str, second: str = "execution_tool", **simulation: Any) -> System:
    """Two lags that follow each other: x' = 2 (y - x), y' = 2 (x - y), x(0) = 1, y(0) = 0."""
    return System(
        simulation={"stop_time": 2.0, "order": 1, **simulation},
        slaves={
            "a": {"model": f"{first}.fmu"},
            "b": {"model": f"{second}.fmu", "parameters": {"x_start": 0.0}},
        },
        connections=(("a.y", "b.u"), ("b.y", "a.u")),
        base=base,
    )


def lag_error(system: System) -> tuple[float, dict[str, Any]]:
    """The largest error at a communication point, and the summary."""
    result = simulate(system, in_process=True)
    half = 0.5 * np.exp(-4.0 * result.time)
    error = np.abs([result["a.y"] - 0.5 - half, result["b.y"] - 0.5 + half]).max()
    return float(error), dict(result.summary)


def test_examined_fmus_give_the_same_bytes(fmu_dir: Path, tmp_path: Path) -> None:
    """The trial steps of exact FMUs leave no trace in results, steps or counters; the summary tells
    of them.
    """
    directories = []
    for is_examined in (True, False):
        system = car("chassis.fmu", "wheel.fmu", base=fmu_dir, order="auto", examine=is_examined)
        directories.append(tmp_path / str(is_examined))
        run(system, directories[-1], in_process=True)
    for name in ("results.csv", "steps.csv"):
        contents = [(directory / name).read_bytes() for directory in directories]
        assert contents[0] == contents[1]
    summaries = [json.loads((directory / "summary.json").read_text()) for directory in directories]
    for counter in ("do_steps", "rollbacks", "round_trips", "requests", "communication_steps"):
        assert summaries[0][counter] == summaries[1][counter]
    examinations = [summary["settings"]["examinations"] for summary in summaries]
    assert examinations[1] == {}
    assert set(examinations[0]) == {"chassis", "wheel"}
    assert examinations[0]["wheel"]["state_verdict"] == "exact"
    assert set(examinations[0]["wheel"]) == set(Examination.__dataclass_fields__)


@pytest.mark.usefixtures("no_process_left")
@pytest.mark.slow
def test_slaves_over_the_bus_are_examined_too(
    capability_dir: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Trial steps and a new configuration in another process, with the results of one process."""
    system = lags(capability_dir, "euler_per_step", relative_tolerance=1e-3)
    with caplog.at_level(logging.WARNING, "master_node"):
        run(system, tmp_path / "bus")
    assert any("substeps of" in record.getMessage() for record in caplog.records)
    run(system, tmp_path / "here", in_process=True)
    results = [(tmp_path / where / "results.csv").read_bytes() for where in ("bus", "here")]
    assert results[0] == results[1]


def test_a_clock_without_its_grid_costs_steps_and_accuracy(capability_dir: Path) -> None:
    """Below the step of the clock the estimate is noise, and looks like jumps."""
    tolerances = {"relative_tolerance": 1e-3, "absolute_tolerance": 1e-3}
    error, summary = lag_error(lags(capability_dir, "internal_clock", **tolerances))
    blind, blind_summary = lag_error(
        lags(capability_dir, "internal_clock", examine=False, **tolerances)
    )
    assert error < 3e-3  # of the Euler steps of 10 ms
    assert blind > 3.0 * error
    assert summary["communication_steps"] < 0.1 * blind_summary["communication_steps"]


def test_what_is_left_of_euler_steps_is_told_and_its_remedy_helps(
    capability_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """More than ten tolerances are left, no estimate sees them, and shorter substeps leave less."""
    tolerances = {"relative_tolerance": 1e-6, "absolute_tolerance": 1e-6}
    system = lags(capability_dir, "euler_per_step", **tolerances)
    error, _ = lag_error(system)
    (told,) = {r.getMessage() for r in caplog.records if "adds up unseen" in r.getMessage()}
    assert error > 1e-5
    substep = float(told.partition("substeps of ")[2].split()[0])
    finer = system.with_slave("a", largest_substep=substep / 8.0)
    assert lag_error(finer)[0] < 0.5 * error  # the rest is that of the coupling


def test_a_clock_too_slow_for_the_tolerance_is_said_so(capability_dir: Path) -> None:
    """The error of steps as short as the clock allows is what it is."""
    with pytest.raises(StepSizeError, match=r"step sizes are multiples of 0\.01 s"):
        simulate(lags(capability_dir, "internal_clock"), in_process=True)


def test_euler_steps_are_invisible_to_est_mod_and_made_short_enough(capability_dir: Path) -> None:
    """Shorter Euler steps give equal communication steps and a smaller error."""
    error, summary = lag_error(lags(capability_dir, "euler_per_step"))
    blind, blind_summary = lag_error(lags(capability_dir, "euler_per_step", examine=False))
    assert error < 0.3 * blind
    assert summary["communication_steps"] == pytest.approx(
        blind_summary["communication_steps"], rel=0.1
    )


def test_an_fmu_that_takes_first_derivatives_only_runs_with_any_order(capability_dir: Path) -> None:
    """Emulated, where it would else end the run at the first polynomial of degree 2."""
    error, _ = lag_error(lags(capability_dir, "plain_lag", order=3))
    assert error < 1e-3
    with pytest.raises(SlaveError, match="orders 1 to 1 are supported"):
        simulate(lags(capability_dir, "plain_lag", order=3, examine=False), in_process=True)


def test_largest_substep_in_the_system_file(capability_dir: Path) -> None:
    """Given by hand it is taken, and the trial steps find nothing to say."""
    free = lags(capability_dir, "euler_per_step", examine=False)
    given = free.with_slave("a", largest_substep=1e-3)
    assert lag_error(given)[0] < 0.2 * lag_error(free)[0]


# ---- Fixed steps --------------------------------------------------------------------------------


def test_a_model_with_fixed_steps_is_driven_by_multiples_of_them() -> None:
    """Communication steps are controlled as ever, and the model sees its own step size only."""

    class Fixed(TimedSlave):
        def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
            assert step_size == pytest.approx(0.002, abs=2.0 * math.ulp(time))
            return super().advance(time, step_size, no_set_state_prior)

    chassis = described(Fixed(CHASSIS, (0.0, 0.0)), fixed_step_size=0.002)
    slaves: dict[str, Slave] = {"chassis": with_substeps(chassis), "wheel": WHEEL.slave()}
    loose = {"relative_tolerance": 1e-2, "absolute_tolerance": 1e-2, "stop_time": 0.4}
    system = with_fixed_steps(
        car(initial_step_size=0.002, **loose), {n: s.description for n, s in slaves.items()}
    )
    assert system.slaves["chassis"].step_multiple == 0.002
    found = run_slaves(system, slaves)
    assert found.error is None
    sizes = np.diff(found.result.time)
    assert sizes / 0.002 == pytest.approx(np.round(sizes / 0.002), rel=1e-9)
    assert sizes.max() > 0.003
    assert all(name in found.result for name in STATES)


@pytest.mark.parametrize("rule", [{"step_size": 0.01}, {"step_multiple": 0.01}])
def test_rules_of_the_user_stand_before_fixed_steps(rule: dict[str, float]) -> None:
    """He may know better."""
    system = car().with_slave("chassis", **rule)
    slave = described(TimedSlave(), fixed_step_size=0.002)
    assert with_fixed_steps(system, {"chassis": slave.description}) is system


@pytest.mark.parametrize("settings", [{"input_substeps": -1}, {"largest_substep": 0.0}])
def test_nonsense_in_the_system_file(settings: dict[str, Any]) -> None:
    """Refused before anything starts."""
    with pytest.raises(ConfigurationError, match=next(iter(settings))):
        car().with_slave("chassis", **settings)
