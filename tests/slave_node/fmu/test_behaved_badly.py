"""FMUs that behave as badly as those that people export: the right result, and the true reason.

Two lags follow each other, x' = 2 (y - x), y' = 2 (x - y); one of them has a fault.
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from master_node import System, simulate
from master_node.observing.observers import Attempt
from master_node.results import Result
from master_node.simulation import resume, run
from protocol.errors import SlaveError

TOLERANCE = 1e-4
ENOUGH = 10.0 * TOLERANCE


def lags(base: Path, faulty: str, *, more: Mapping[str, Any] = {}, **simulation: Any) -> System:
    """The faulty lag is ``a``, x(0) = 1; the other one ``b`` is strict and right, y(0) = 0."""
    return System(
        simulation={"stop_time": 2.0, **simulation},
        slaves={
            "a": {"model": f"{faulty}.fmu", **more},
            "b": {"model": "plain_lag.fmu", "parameters": {"x_start": 0.0}},
        },
        connections=(("a.y", "b.u"), ("b.y", "a.u")),
        base=base,
    )


def error_of(result: Result) -> float:
    """The largest one at a communication point."""
    half = 0.5 * np.exp(-4.0 * result.time)
    return float(np.abs([result["a.y"] - 0.5 - half, result["b.y"] - 0.5 + half]).max())


class Said:
    """Warnings about slave ``a``, but for those about every lag."""

    def __init__(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.WARNING, "master_node")
        self._caplog = caplog

    @property
    def lines(self) -> list[str]:
        """The warnings."""
        messages = [record.getMessage() for record in self._caplog.records]
        usual = "a: it makes use of input derivatives up to order"
        return [m for m in messages if m.startswith("a: ") and not m.startswith(usual)]


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture) -> Said:
    """See `Said`."""
    return Said(caplog)


# ---- Output derivatives -------------------------------------------------------------------------


def derivative_points(result: Result) -> list[int]:
    """Derivative points of the accepted steps, in order."""
    steps = result.steps
    return list(steps["derivative_points"][steps["accepted"]].tolist())


@pytest.mark.parametrize(
    ("faulty", "reason", "used"),
    [
        ("slopes_nan", "those of y are not finite", ["c"]),
        ("slopes_infinite", "those of c are not finite", ["y"]),
        ("slopes_thousandfold", "those of y are nowhere near the change of the output", ["c"]),
        ("slopes_differences", "those of y are differences over the last step", ["c"]),
        ("slopes_noise", "those of y, c are others when the same step is taken again", []),
    ],
)
def test_output_derivatives_that_are_none_are_not_used(
    faulty: str, reason: str, used: list[str], capability_dir: Path, said: Said
) -> None:
    """One warning with the reason, and the run of an FMU without those derivatives, row for row.

    ``summary.json`` tells which are used, and why others are not.
    """
    result = simulate(lags(capability_dir, faulty), in_process=True)
    (warning,) = said.lines
    assert reason in warning
    assert error_of(result) < ENOUGH
    assert result.summary["settings"]["slaves"]["a"]["output_derivatives"] == used
    poor = result.summary["settings"]["examinations"]["a"]["poor_derivatives"]
    assert set(poor) == {"y", "c"} - set(used)
    named = lags(
        capability_dir,
        "slopes_infinite",
        more={"output_derivatives": [n for n in used if n == "y"]},
    )
    same = simulate(named, in_process=True)
    assert np.array_equal(result.time, same.time)
    assert np.array_equal(result["a.y"], same["a.y"])


def test_a_derivative_that_is_not_finite_is_none_at_its_point(
    capability_dir: Path, said: Said
) -> None:
    """Before the first step there is none, so that the first polynomials meet values only; behind
    it there is, and it is used. The user is told once.
    """
    result = simulate(lags(capability_dir, "slopes_nan_at_first"), in_process=True)
    (warning,) = said.lines
    assert "the derivatives of a.y are not finite at t=0.0 s" in warning
    points = derivative_points(result)
    assert points[0] == 0
    assert min(points[1:]) == 1
    assert max(points) == 2
    assert error_of(result) < ENOUGH
    assert result.summary["settings"]["slaves"]["a"]["output_derivatives"] is None


class Interrupt:
    """Ends the run at its third attempt."""

    def __init__(self) -> None:
        self.attempts = 0

    def started(self, start: object) -> None:
        """See `Observer`."""

    def attempted(self, attempt: Attempt) -> None:
        """See `Observer`."""
        self.attempts += 1
        if self.attempts == 3:
            raise RuntimeError

    def ended(self, end: object) -> None:
        """See `Observer`."""


@pytest.mark.parametrize("faulty", ["slopes_nan", "slopes_nan_at_first"])
@pytest.mark.parametrize(
    ("simulation", "slaves"),
    [
        ({"examine": False, "order": 1}, {}),
        ({"examine": False, "order": 1, "estimator": "rich"}, {}),
        ({"examine": False, "order": 1, "derivative_points": 1}, {}),
        ({"examine": False, "order": 1, "derivative_points": 1, "initial_history": "none"}, {}),
        ({"estimator": "none", "order": 1, "derivative_points": 1, "initial_step_size": 1e-3}, {}),
        ({"order": 1, "derivative_points": 1, "output_interval": 0.01}, {}),
        ({"order": 1, "derivative_points": 1}, {"state": "none"}),
        ({"order": 1, "derivative_points": 1}, {"state": "none", "both": True}),
        ({"sequence": "gauss-seidel", "order": 1, "derivative_points": 1}, {}),
    ],
)
def test_no_kind_of_run_passes_such_a_derivative_on(
    faulty: str, simulation: dict[str, Any], slaves: dict[str, Any], capability_dir: Path
) -> None:
    """With and without trial steps, with every kind of control: no NaN in any result, and the
    accuracy that was asked for.
    """
    state = {"state": slaves["state"]} if "state" in slaves else {}
    system = lags(capability_dir, faulty, more=state, **simulation)
    system = system.with_slave("b", output_derivatives=())
    if slaves.get("both"):
        system = system.with_slave("b", state="none")
    result = simulate(system, in_process=True)
    assert error_of(result) < ENOUGH
    assert np.isfinite([result["a.y"], result["b.y"]]).all()
    if faulty == "slopes_nan":
        assert not any(derivative_points(result))


def test_values_that_are_not_finite_stay_what_they_are(capability_dir: Path) -> None:
    """They are refused, whatever the derivatives are."""
    with pytest.raises(SlaveError, match=r"a\.y is not finite"):
        simulate(lags(capability_dir, "not_finite"), in_process=True)


@pytest.mark.parametrize(
    ("faulty", "kind", "text"),
    [
        ("slopes_nan", "native", "not finite"),
        ("clocks", "native", "tell of the computation"),
        ("loses_state", "fork", "its saved states (native) cannot be trusted"),
    ],
)
def test_trial_steps_go_on_without_derivatives(
    faulty: str, kind: str, text: str, capability_dir: Path, said: Said
) -> None:
    """Derivatives that are NaN, or refused, hide neither clocks nor bad states."""
    result = simulate(lags(capability_dir, faulty), in_process=True)
    assert result.summary["settings"]["examinations"]["a"]["state_verdict"] == "exact"
    assert result.summary["state_kind"]["a"] == kind
    assert any(text in line for line in said.lines)


@pytest.mark.slow
def test_a_run_with_missing_derivatives_is_resumed_bit_for_bit(
    capability_dir: Path, tmp_path: Path
) -> None:
    """Also from the point that has none."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    system = lags(capability_dir, "slopes_nan_at_first", checkpoint_interval=1e-9)
    run(system, whole, in_process=True)

    with pytest.raises(RuntimeError):
        run(system, broken, in_process=True, observers=[Interrupt()])
    resume(broken)
    for name in ("results.csv", "steps.csv"):
        assert (broken / name).read_bytes() == (whole / name).read_bytes()


# ---- Input derivatives --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("faulty", "order", "reason"),
    [
        ("second_order", 2, "fmi2SetRealInputDerivatives of order 3 returned fmi2Error"),
        ("counts_inputs", 2, "fmi2SetRealInputDerivatives of order 3 returned fmi2Error"),
        ("ignores_second_order", 1, "those of order 2 change nothing"),
        ("ignores_derivatives", 0, "those of order 1 change nothing"),
    ],
)
def test_input_derivatives_of_some_orders(
    faulty: str, order: int, reason: str, capability_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Those that are refused, or change nothing, leave the lower ones in use, whether states are
    saved natively or by forking; that fork is trusted. An FMU that counts the value references of a
    call against its inputs is called once for each order.
    """
    for state in ("native", "fork"):
        caplog.clear()
        with caplog.at_level(logging.WARNING, "master_node"):
            result = simulate(lags(capability_dir, faulty, more={"state": state}), in_process=True)
        messages = [r.getMessage() for r in caplog.records if r.getMessage().startswith("a: ")]
        (warning,) = messages
        assert reason in warning
        assert (f"up to order {order} only" if order else "are emulated") in warning
        assert result.summary["settings"]["examinations"]["a"]["state_verdict"] == "exact"
        assert result.summary["state_kind"]["a"] == state
        assert error_of(result) < ENOUGH


def test_orders_that_change_nothing_are_not_relied_on(capability_dir: Path) -> None:
    """The run of an FMU that ignores second derivatives is as accurate as that of one that takes
    them.
    """
    errors = [
        error_of(simulate(lags(capability_dir, faulty, order=3), in_process=True))
        for faulty in ("second_order", "ignores_second_order")
    ]
    assert errors[1] < 2.0 * errors[0]


# ---- Outputs that do not repeat -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("faulty", "kind", "named"),
    [
        ("clocks", "native", ["cpu_time", "steps", "number"]),
        ("clocks_no_state", "fork", ["cpu_time", "steps", "number"]),
    ],
)
def test_clocks_among_the_outputs_take_no_rollback(
    faulty: str, kind: str, named: list[str], capability_dir: Path, said: Said
) -> None:
    """They are named, kept out of ERR, and compared with nothing; the run is that of a lag without
    them, row for row.
    """
    result = simulate(lags(capability_dir, faulty), in_process=True)
    text = "\n".join(said.lines)
    assert "tell of the computation" in text
    assert "kept out of ERR" in text
    assert all(name in text for name in named)
    summary = result.summary
    assert summary["state_kind"]["a"] == kind
    assert summary["settings"]["examinations"]["a"]["state_verdict"] == "exact"
    assert set(summary["settings"]["examinations"]["a"]["not_repeating"]) == set(named)
    assert summary["controlled_by"]["double_step"] == ["a.y", "b.y"]
    plain = lags(capability_dir, "plain_lag", more={"output_derivatives": []})
    same = simulate(plain, in_process=True)
    assert np.array_equal(result.time, same.time)
    assert np.array_equal(result["a.y"], same["a.y"])


def test_clocks_are_in_the_error_norm_where_they_are_asked_for(
    capability_dir: Path, said: Said
) -> None:
    """By tolerances of their own: a large one leaves the run as it is."""
    more = {"tolerances": {"steps": {"absolute": 1e9, "relative": 0.0}}}
    result = simulate(lags(capability_dir, "clocks", more=more), in_process=True)
    assert "those that have tolerances of their own stay in it" in said.lines[-1]
    assert result.summary["controlled_by"]["double_step"] == ["a.y", "a.steps", "b.y"]
    assert error_of(result) < ENOUGH


def test_a_connected_clock_cannot_be_gone_back_from(capability_dir: Path, said: Said) -> None:
    """An output that other slaves depend on has to repeat: no saved state does that to a clock."""
    system = System(
        simulation={"stop_time": 0.1, "initial_step_size": 1e-2, "smallest_step_size": 1e-2},
        slaves={"a": {"model": "clocks.fmu"}, "b": {"model": "plain_lag.fmu"}},
        connections=(("a.cpu_time", "b.u"), ("b.y", "a.u")),
        base=capability_dir,
    )
    result = simulate(system, in_process=True)
    assert result.summary["state_kind"]["a"] == "none"
    assert "steps cannot be taken back" in said.lines[-1]


class Kill:
    """Ends the process of slave ``a`` once, beyond 0.2 s."""

    def __init__(self) -> None:
        self.is_done = False

    def started(self, start: object) -> None:
        """See `Observer`."""

    def attempted(self, attempt: Attempt) -> None:
        """See `Observer`."""
        if self.is_done or attempt.time < 0.2:
            return
        for process in psutil.Process().children():
            words = process.cmdline()
            if "--name" in words and words[words.index("--name") + 1] == "a":
                process.kill()
                self.is_done = True

    def ended(self, end: object) -> None:
        """See `Observer`."""


@pytest.mark.usefixtures("no_process_left")
@pytest.mark.slow
def test_a_slave_with_clocks_is_restored_after_a_kill(capability_dir: Path, tmp_path: Path) -> None:
    """Outputs that do not repeat are not compared when a process takes the place of another."""
    system = lags(capability_dir, "clocks")
    kill = Kill()
    columns = []
    for name, observers in (("plain", []), ("killed", [kill])):
        run(system, tmp_path / name, observers=observers)
        with (tmp_path / name / "results.csv").open() as file:
            rows = list(csv.DictReader(file))
        columns.append([(row["time"], row["a.y"], row["b.y"]) for row in rows])
    assert kill.is_done
    assert columns[0] == columns[1]


# ---- Steps that depend on their size ------------------------------------------------------------


def test_single_euler_steps_are_found_whatever_the_stop_time_is(
    capability_dir: Path, said: Said
) -> None:
    """A controller with a limit and a fast filter: with steps that are not small its output is at
    the limit, or there at once, whatever the size of the step. So small ones are tried, the same
    for all stop times, and tell the same.
    """
    for stop_time in (0.5, 2.0, 10.0):
        system = System(
            simulation={"stop_time": stop_time},
            slaves={
                "a": {"model": "saturated_controller.fmu"},
                "b": {"model": "plain_lag.fmu", "parameters": {"x_start": 0.0}},
            },
            connections=(
                ("a.y", "b.u"),
                {"from": "b.y", "to": "a.u", "factor": -1.0, "offset": 0.5},
            ),
            base=capability_dir,
        )
        with pytest.raises(RuntimeError):
            simulate(system, in_process=True, observers=[Interrupt()])
    warnings = [line for line in said.lines if "one long step differs" in line]
    assert len(warnings) == 3
    assert "its steps are split into substeps of" in warnings[0]
    assert len(set(warnings)) == 1
