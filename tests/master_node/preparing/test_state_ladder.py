"""Way of saving states: who chooses it, and what is said of it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from master_node import System, load_system, simulate
from master_node.cli.app import main
from master_node.preparing.configuring import configure
from master_node.slaves.link import LocalSlave
from protocol.calls import Configure, Describe
from protocol.description import SlaveDescription, StateKind
from protocol.errors import ModelError, SlaveError
from slave_node.execution.executor import Executor
from slave_node.loading import describe_model, load_executor
from slave_node.states.ladder import choose
from tests.support.quarter_car_case import CHASSIS, DISPLACEMENT, EXAMPLES, WHEEL, car, run_slaves
from tests.support.state_programs import MODELS, begin, loaded

NATIVE = SlaveDescription("m", "test", (), state_kind=StateKind.NATIVE)
NOT_NATIVE = SlaveDescription("m", "test", (), state_kind=StateKind.NONE)
UNABLE = replace(NOT_NATIVE, state_reason="FMI 1.0 knows no saved states")


@pytest.mark.parametrize(
    ("description", "wanted", "can_fork", "kind", "reason"),
    [
        (NATIVE, "", True, "native", ""),
        (NATIVE, "native", False, "native", ""),
        (NOT_NATIVE, "", True, "fork", "canGetAndSetFMUstate = false"),
        (UNABLE, "", True, "fork", "FMI 1.0 knows no saved states"),
        (NOT_NATIVE, "", False, "replay", "canGetAndSetFMUstate = false; .* cannot fork"),
        (NATIVE, "fork", True, "fork", "the configuration asks for it"),
        (NOT_NATIVE, "replay", True, "replay", "asks for it; .*canGetAndSetFMUstate = false"),
        (NATIVE, "none", True, "none", "the configuration asks for it"),
    ],
)
def test_the_best_that_model_and_host_allow_or_what_is_asked_for(
    description: SlaveDescription, wanted: str, *, can_fork: bool, kind: str, reason: str
) -> None:
    """Native, fork, replay in this order; the reason names the model's lack or the wish."""
    choice = choose(description, wanted, can_fork=can_fork)
    assert choice.kind == kind
    assert bool(choice.reason) == bool(reason)
    assert re.search(reason, choice.reason)


@pytest.mark.parametrize(
    ("description", "wanted", "can_fork", "message"),
    [
        (NOT_NATIVE, "native", True, "saved by native: .*canGetAndSetFMUstate = false"),
        (NATIVE, "fork", False, "saved by fork: .* cannot fork processes"),
        (NATIVE, "forc", True, "by 'forc'; did you mean 'fork'"),
    ],
)
def test_what_cannot_be_is_refused(
    description: SlaveDescription, wanted: str, *, can_fork: bool, message: str
) -> None:
    """Impossible ways to save states are errors of the configuration, before anything runs."""
    with pytest.raises(ModelError, match=message):
        choose(description, wanted, can_fork=can_fork)


def test_models_and_their_ways(fmu_dir: Path, capability_dir: Path) -> None:
    """`inspect` and the loaded slave say the same; capabilities stay what the model declares."""
    best = "fork" if sys.platform == "linux" else "replay"
    for model, kind in (
        (fmu_dir / "wheel.fmu", "native"),
        (EXAMPLES / "quarter_car.py:Wheel", "native"),
        (capability_dir / "wheel_no_state.fmu", best),
    ):
        described = describe_model(str(model), Path())
        assert described.state_kind == kind
        assert described.capabilities.can_get_and_set_state == (kind == "native")
        assert bool(described.state_reason) == (kind != "native")
        with loaded(model, "") as slave:
            assert slave.description.state_kind == kind
            assert slave.description.state_reason == described.state_reason
            assert slave.description.capabilities == described.capabilities


def test_python_models_can_be_forked_and_replayed(tmp_path: Path) -> None:
    """With the bits that they have natively."""
    ends = []
    for kind in ("native", "fork", "replay"):
        with loaded(f"{MODELS}:Fragile", kind, inputs=("u",), outputs=("y",)) as slave:
            slave.set_inputs(np.array([[0.5]]))
            slave.do_step(0.0, 0.1, False)
            state = slave.get_state()
            slave.do_step(0.1, 0.1, False)
            slave.set_state(state)
            slave.do_step(0.1, 0.1, False)
            ends.append(slave.get_outputs(0).tobytes())
    assert len(set(ends)) == 1


def test_a_state_that_is_not_to_be_saved_is_not(fmu_dir: Path) -> None:
    """Although the model could; all else goes on."""
    with loaded(fmu_dir / "wheel.fmu", "none", inputs=("x_c", "v_c"), outputs=("x",)) as slave:
        assert slave.description.state_kind is StateKind.NONE
        assert slave.description.capabilities.can_get_and_set_state
        with pytest.raises(SlaveError, match="is not saved: the configuration asks for it"):
            slave.get_state()
        slave.set_inputs(np.zeros((1, 2)))
        slave.do_step(0.0, 0.01, True)
        assert slave.get_outputs(0)[0, 0] != 0.0
        slave.reset()
        begin(slave, (), ("x",))
        assert slave.get_outputs(0)[0, 0] == 0.0


# ---- Who chooses --------------------------------------------------------------------------------


def executor(model: Path, tmp_path: Path, **options: str) -> Executor:
    """Executor of a model, as a worker has it."""
    loaded_executor = load_executor(str(model), Path(), "x", tmp_path, **options)
    assert isinstance(loaded_executor, Executor)
    return loaded_executor


def kind_of(executor: Executor) -> str:
    """Kind of saved states that the slave declares."""
    (description,) = executor.execute([Describe()]).results
    assert isinstance(description, SlaveDescription)
    return description.state_kind


def test_a_served_default_holds_until_a_master_asks_for_another(
    fmu_dir: Path, tmp_path: Path
) -> None:
    """And holds again for a master who asks for nothing."""
    slave = executor(fmu_dir / "wheel.fmu", tmp_path, state_kind="replay")
    assert kind_of(slave) == "replay"
    for wish, kind in (("native", "native"), ("", "replay"), ("none", "none")):
        assert slave.execute([Configure(wish)]).error is None
        assert kind_of(slave) == kind
    slave.close()


def test_the_master_tells_all_slaves_and_so_undoes_what_the_last_one_told(
    fmu_dir: Path, tmp_path: Path
) -> None:
    """The system file's word for one slave, the default for the other."""
    system = System(
        simulation={"stop_time": 1.0},
        slaves={
            "chassis": {"model": "chassis.fmu", "state": "replay"},
            "wheel": {"model": "wheel.fmu"},
        },
        connections=DISPLACEMENT,
        base=fmu_dir,
    )
    executors = {}
    for name in system.slaves:
        scratch = tmp_path / name
        scratch.mkdir()
        executors[name] = executor(fmu_dir / f"{name}.fmu", scratch)
    executors["wheel"].execute([Configure("none")])
    links = {name: LocalSlave(each) for name, each in executors.items()}
    loaded = {name: each.description for name, each in executors.items()}
    descriptions = configure(links, system, loaded)
    assert {n: d.state_kind for n, d in descriptions.items()} == {
        "chassis": StateKind.REPLAY,
        "wheel": StateKind.NATIVE,
    }
    for each in executors.values():
        each.close()


def test_a_wish_that_cannot_be_met_names_the_slave(capability_dir: Path) -> None:
    """And the lack."""
    system = System(
        simulation={"stop_time": 0.1},
        slaves={
            "chassis": {"model": "chassis_bare.fmu"},
            "wheel": {"model": "wheel_bare.fmu", "state": "native"},
        },
        connections=DISPLACEMENT,
        base=capability_dir,
    )
    with pytest.raises(ModelError, match=r"wheel: .*by native: .*does not declare"):
        simulate(system, in_process=True)


def test_without_states_nothing_is_taken_back() -> None:
    """The master hears it from the slaves, and controls the steps in another way."""
    summary = simulate(car(stop_time=0.1).with_slaves(state="none"), in_process=True).summary
    assert set(summary["state_kind"].values()) == {"none"}
    assert set(summary["rollbacks"].values()) == {0}


@pytest.mark.slow
def test_the_command_line_chooses_for_all_slaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`--state`, with the choice in the summary of each slave; a wrong one names what there is."""
    file = tmp_path / "system.toml"
    file.write_text(
        (EXAMPLES / "displacement_python.toml")
        .read_text(encoding="utf-8")
        .replace('"quarter_car.py', f'"{EXAMPLES}/quarter_car.py')
        .replace("[slaves.wheel]", '[slaves.wheel]\nstate = "native"')
    )
    assert load_system(file).slaves["wheel"].state == "native"
    words = ["master-node", "run", str(file), "--in-process", "--quiet", "--no-plot"]
    output = tmp_path / "results"
    monkeypatch.setattr(
        sys,
        "argv",
        [*words, "--stop-time", "0.05", "--state", "replay", "--output", str(output)],
    )
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 0
    summary = json.loads((output / "summary.json").read_text())
    assert {m["state_kind"] for m in summary["settings"]["models"].values()} == {"replay"}
    assert {s["state"] for s in summary["settings"]["slaves"].values()} == {"replay"}
    monkeypatch.setattr(sys, "argv", [*words, "--state", "forc"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
def test_inspect_says_how_and_why(capability_dir: Path) -> None:
    """For a model that cannot save its state itself."""
    command = [sys.executable, "-m", "slave_node", "inspect"]
    text = subprocess.run(
        [*command, str(capability_dir / "wheel_bare.fmu")],
        capture_output=True,
        encoding="utf-8",
        check=True,
        env={**os.environ, "COLUMNS": "300", "PYTHONUTF8": "1"},
    ).stdout
    assert "saved by forking the process that holds the model" in text
    assert "does not declare that it can save its state" in text


# ---- No needless states -------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", ["mod", "rich"])
def test_no_more_states_are_saved_than_there_are_uses(estimator: str) -> None:
    """A double step saves the point that it starts from, and EST_mod the middle until it is back
    there: over the old one, two at most, and one between double steps.
    """
    between = []

    class Watch:
        def started(self, _: object) -> None:
            pass

        def attempted(self, _: object) -> None:
            between.extend(len(slave.saved) for slave in slaves.values())

        def ended(self, _: object) -> None:
            pass

    slaves = {"chassis": CHASSIS.slave(), "wheel": WHEEL.slave()}
    system = car(stop_time=0.5, estimator=estimator, largest_step_size=0.01)
    run = run_slaves(system, slaves, [Watch()])
    assert run.error is None
    assert {slave.most_saved for slave in slaves.values()} == {2}
    assert set(between) == {1}
    assert [slave.saved for slave in slaves.values()] == [[], []]
