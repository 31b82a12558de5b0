"""Sessions: runs that are stepped, asked, changed and branched from Python."""

from __future__ import annotations

import gc
import importlib.util
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_node import InputSettings, Result, Session, System, load_system, open_run, simulate
from master_node.observing.observers import Attempt
from master_node.simulation import resume
from protocol.errors import DoublestepError, InterruptedRunError, ResultsError, SteeringError
from tests.support.quarter_car_case import EXAMPLES
from tests.support.slow import quick_at

STOP = 0.5
FILES = ("results.csv", "steps.csv")

METHODS: Mapping[str, Mapping[str, Any]] = {
    "default": {},
    "mod": {"estimator": "mod", "order": 2},
    "paper": {"preset": "paper"},
    "gauss-seidel": {"sequence": "gauss-seidel"},
    "implicit": {"coupling": "implicit"},
    "grid of results": {"output_interval": 0.03},
    "fixed": {"estimator": "none", "initial_step_size": 0.01},
}


def car(**simulation: Any) -> System:
    """The quarter car of two Python models."""
    system = load_system(EXAMPLES / "displacement_python.toml")
    return system.with_simulation(stop_time=STOP, **simulation)


def drive(folder: Path, version: int = 2, **slave: Any) -> System:
    """A drive with an input that nothing drives, and tunable parameters: y' = gain mode u."""
    model = {"model": str(folder / f"drive{version}.fmu"), **slave}
    return System(
        simulation={"stop_time": 1.0, "largest_step_size": 0.05},
        slaves={"drive": model},
        results={"locals": ["drive.gain", "drive.total"]},
    )


def files(folder: Path) -> list[bytes]:
    """The results and the steps of a run, byte by byte."""
    return [(folder / name).read_bytes() for name in FILES]


def many_steps(run: Session, number: int) -> None:
    """So many accepted steps."""
    for _ in range(number):
        assert run.step()


@pytest.fixture
def session() -> Iterator[Session]:
    """A session of the quarter car at T_0."""
    with open_run(car(), in_process=True) as run:
        yield run


# ---- Forward ------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", METHODS.values(), ids=METHODS)
def test_a_session_writes_the_files_of_one_call(
    tmp_path: Path, settings: Mapping[str, Any]
) -> None:
    """Byte for byte: by single steps, by iteration, and to the stop time at once."""
    system = car(**settings)
    simulate(system, output=tmp_path / "call", in_process=True)
    with open_run(system, output=tmp_path / "step", in_process=True) as run:
        while run.step():
            pass
    with open_run(system, output=tmp_path / "iterate", in_process=True) as run:
        times = [point.time for point in run]
        assert run.is_ended
        assert times == sorted(times)
        assert times[-1] == STOP
    with open_run(system, output=tmp_path / "until", in_process=True) as run:
        assert run.until(STOP).time == STOP
    expected = files(tmp_path / "call")
    for name in ("step", "iterate", "until"):
        assert files(tmp_path / name) == expected
        assert Result.load(tmp_path / name).summary["outcome"] == "completed"


@pytest.mark.parametrize("mode", [{"state": "none"}, {}], ids=["no rollback", "mixed"])
def test_slaves_without_rollback_are_stepped(tmp_path: Path, mode: Mapping[str, Any]) -> None:
    """A session with slaves that cannot go back writes the files of one call."""
    system = car().with_slave("wheel", state="none").with_slave("chassis", **mode)
    simulate(system, output=tmp_path / "call", in_process=True)
    with open_run(system, output=tmp_path / "session", in_process=True) as run:
        many_steps(run, 3)
        with pytest.raises(SteeringError, match=r"state cannot be saved.*fork"):
            run.save()
        for _ in run:
            pass
    assert files(tmp_path / "call") == files(tmp_path / "session")


@pytest.mark.parametrize("time", [0.1, 1 / 3, 0.4999])
def test_until_makes_a_communication_point(session: Session, time: float) -> None:
    """The run stands there but for rounding, and goes on to its end."""
    point = session.until(time)
    assert point.time == session.time == pytest.approx(time, abs=1e-12)
    assert not session.is_ended
    session.until(STOP)
    assert session.is_ended
    assert not session.step()
    times = session.result().time
    assert np.abs(times - time).min() < 1e-12


def test_until_meets_points_of_a_grid_only() -> None:
    """Where H is on a grid other points are refused, with those beside them."""
    system = car(relative_tolerance=0.01, absolute_tolerance=0.01)
    system = system.with_slave("wheel", step_multiple=0.005)
    fixed = car(estimator="none", initial_step_size=0.01)
    for one, beside in ((system, "t=0.1 s or t=0.11"), (fixed, "t=0.1 s or t=0.11")):
        with open_run(one, in_process=True) as run:
            run.until(0.05)
            with pytest.raises(SteeringError, match=r"t=0.103 s is no communication point") as got:
                run.until(0.103)
            assert beside in str(got.value.remedy)
            assert run.until(0.1).time == pytest.approx(0.1, abs=1e-12)


def test_times_that_cannot_be_reached() -> None:
    """Behind, beyond the stop time, and nearer than a step: refused, and the run goes on."""
    with open_run(car(smallest_step_size=1e-4), in_process=True) as run:
        run.until(0.2)
        for time, words in ((0.1, "before"), (0.6, "behind the stop time"), (0.20015, "nearer")):
            with pytest.raises(SteeringError, match=words):
                run.until(time)
        run.until(0.3)


def test_all_variables_are_read(session: Session) -> None:
    """Outputs, connected inputs and parameters where the run stands; points keep their values."""
    session.until(0.1)
    before = session.point
    assert session["wheel.x_c"] == session["chassis.x"] == before["chassis.x"]
    assert session["chassis.m"] == 400.0
    assert {"chassis.x", "wheel.x_c", "chassis.m"} <= set(before)
    session.until(0.2)
    assert session["chassis.x"] != before["chassis.x"]
    last = session.result()
    assert session["wheel.v"] == last["wheel.v"][-1]
    with pytest.raises(SteeringError, match=r"no variable 'chassis.y'.*chassis.x"):
        _ = session["chassis.y"]


# ---- Branches -----------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", METHODS.values(), ids=METHODS)
def test_an_excursion_leaves_no_trace(tmp_path: Path, settings: Mapping[str, Any]) -> None:
    """Files and counters are those of a run without it; marks can be restored again and again."""
    system = car(**settings)
    simulate(system, output=tmp_path / "call", in_process=True)
    with open_run(system, output=tmp_path / "session", in_process=True) as run:
        many_steps(run, 4)
        mark = run.save()
        for _ in range(2):
            many_steps(run, 3)
            run.override({"wheel.x_c": 0.5})
            many_steps(run, 4)
            run.restore(mark)
            assert run.time == mark.time
            assert not run.overridden
        run.forget(mark)
        for _ in run:
            pass
        run.result()
        end = run.save()
    assert files(tmp_path / "call") == files(tmp_path / "session")
    one, other = (Result.load(tmp_path / name).summary for name in ("call", "session"))
    for name in ("communication_steps", "rejected_double_steps", "discontinuities", "outcome"):
        assert one[name] == other[name]
    assert run.result()["wheel.x"].tobytes() == Result.load(tmp_path / "call")["wheel.x"].tobytes()
    with pytest.raises(SteeringError, match="closed"):
        run.restore(end)


def test_a_branch_from_the_end(session: Session) -> None:
    """A run that has ended goes on from a mark before its end."""
    session.until(0.4)
    mark = session.save()
    session.until(STOP)
    assert session.is_ended
    first = session["wheel.x"]
    session.restore(mark)
    assert not session.is_ended
    session.until(STOP)
    assert session["wheel.x"] == first


def test_marks_belong_to_their_run_and_are_bounded(session: Session) -> None:
    """Marks of another run and forgotten ones are refused; there are a hundred at a time."""
    with open_run(car(), in_process=True) as other:
        foreign = other.save()
        for call in (session.restore, session.forget):
            with pytest.raises(SteeringError, match="no mark of this run"):
                call(foreign)
    marks = [session.save() for _ in range(100)]
    with pytest.raises(SteeringError, match="100 marks"):
        session.save()
    session.forget(marks[7])
    with pytest.raises(SteeringError, match="forgotten"):
        session.restore(marks[7])
    session.step()
    session.restore(session.save())


# ---- Changes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", quick_at([3], [2, 3]))
@pytest.mark.parametrize("slave", [{}, {"state": "fork"}, {"state": "replay"}, {"state": "none"}])
def test_what_is_set_holds_from_there_on(
    capability_dir: Path, version: int, slave: Mapping[str, Any]
) -> None:
    """The output is exact: inputs and parameters change at the point, and what depends on them."""
    with open_run(drive(capability_dir, version, **slave), in_process=True) as run:
        run.set({"drive.u": 2.0})
        run.until(0.25)
        run.set({"drive.gain": np.float64(4.0)})
        assert run["drive.gain"] == 4.0
        assert run["drive.total"] == 12.0
        assert run["drive.u"] == 2.0
        run.until(0.5)
        run.set({"drive.u": -1, "drive.gain": 1.0})
        run.until(1.0)
    result = run.result()
    start = result["drive.gain"][0]
    t = result.time
    expected = 2.0 * start * np.minimum(t, 0.25)
    expected += 8.0 * np.clip(t - 0.25, 0.0, 0.25) - np.clip(t - 0.5, 0.0, None)
    np.testing.assert_allclose(result["drive.y"], expected, rtol=0.0, atol=1e-12)
    assert result.summary["discontinuities"] == 3


def test_branches_with_other_parameters(capability_dir: Path) -> None:
    """Values set in a branch belong to it: a mark brings back the values that held there."""
    with open_run(drive(capability_dir), in_process=True) as run:
        run.set({"drive.u": 1.0, "drive.gain": 1.0})
        run.until(0.5)
        mark = run.save()
        ends = []
        for gain in (1.0, 3.0):
            run.restore(mark)
            assert run["drive.gain"] == 1.0
            run.set({"drive.gain": gain})
            run.until(1.0)
            ends.append(run["drive.y"])
    np.testing.assert_allclose(ends, [1.0, 2.0], atol=1e-12)


def test_an_input_of_a_python_model_is_set() -> None:
    """An input that nothing drives keeps its value, with other inputs connected."""
    system = System(
        simulation={"stop_time": STOP},
        slaves={
            "chassis": {"model": str(EXAMPLES / "quarter_car.py:Chassis")},
            "wheel": {"model": str(EXAMPLES / "quarter_car.py:Wheel")},
        },
        connections=[("chassis.x", "wheel.x_c"), ("wheel.x", "chassis.x_w")],
    )
    with open_run(system, in_process=True) as run:
        run.until(0.1)
        run.set({"wheel.v_c": 0.3})
        run.until(0.3)
        assert run["wheel.v_c"] == 0.3
        pushed = run["wheel.v"]
    with open_run(system, in_process=True) as run:
        run.until(0.3)
        assert run["wheel.v"] != pushed


@pytest.mark.parametrize("kind", ["python", "fmu"])
def test_a_spring_is_exchanged_and_the_branch_undone(
    fmu_dir: Path, tmp_path: Path, kind: str
) -> None:
    """A tunable parameter of a Python model and of an FMU: the motion follows it, and a mark goes
    back to the old one; over checkpoints too.
    """
    system = car(checkpoint_interval=1e-9).with_simulation(stop_time=1.0)
    if kind == "fmu":
        for name in ("chassis", "wheel"):
            system = system.with_slave(name, model=str(fmu_dir / f"{name}.fmu"))
    simulate(system, output=tmp_path / "call", in_process=True)
    with open_run(system, output=tmp_path / "session", in_process=True) as run:
        many_steps(run, 6)
        mark = run.save()
        run.set({"chassis.k": 3e4, "wheel.k_c": 3e4})
        run.until(1.0)
        other = run["chassis.x"]
        run.restore(mark)
        run.until(1.0)
        assert run["chassis.x"] != pytest.approx(other, rel=1e-3)
    assert files(tmp_path / "call") == files(tmp_path / "session")
    stiff = system.with_slave("chassis", parameters={"k": 3e4})
    stiff = stiff.with_slave("wheel", parameters={"z": 0.1, "k_c": 3e4})
    expected = simulate(stiff, in_process=True)["chassis.x"][-1]
    with open_run(system, output=tmp_path / "stiff", in_process=True) as run:
        run.set({"chassis.k": 3e4, "wheel.k_c": 3e4})
        many_steps(run, 5)
    resume(tmp_path / "stiff")
    reached = Result.load(tmp_path / "stiff")["chassis.x"][-1]
    assert reached == pytest.approx(expected, abs=1e-3)


def test_an_overridden_input_is_cut_from_its_source() -> None:
    """It is as if the input had been a constant all along, and follows again when released."""
    with open_run(car(), in_process=True) as run:
        run.override({"wheel.x_c": 0.02, "wheel.v_c": 0.0})
        assert run.overridden == {"wheel.x_c": 0.02, "wheel.v_c": 0.0}
        run.until(0.3)
        assert run["wheel.x_c"] == 0.02
        cut = run["wheel.x"]
        run.release("wheel.x_c")
        assert run["wheel.x_c"] == run["chassis.x"]
        assert run.overridden == {"wheel.v_c": 0.0}
        run.release()
        run.until(STOP)
        assert not run.overridden
    connections = [("wheel.x", "chassis.x_w"), ("wheel.v", "chassis.v_w")]
    alone = car().with_simulation(stop_time=0.3)
    alone = System(
        simulation=alone.simulation,
        slaves=alone.slaves,
        connections=connections,
        inputs={"wheel.x_c": 0.02, "wheel.v_c": 0.0},
        base=EXAMPLES,
    )
    result = simulate(alone, in_process=True)
    assert result["wheel.x"][-1] == pytest.approx(cut, abs=2e-4)


def test_mistakes_name_variable_and_remedy(capability_dir: Path) -> None:
    """Each is refused before anything is changed, and the run goes on."""
    system = drive(capability_dir).with_simulation(stop_time=1.0)
    with open_run(system, in_process=True) as run:
        for values, words in (
            ({"drive.nothing": 1.0}, r"no variable 'drive.nothing'"),
            ({"drive.y": 1.0}, r"drive.y cannot be set.*output"),
            ({"drive.u": "fast"}, r"drive.u .*fast"),
            ({"drive.u": float("nan")}, r"drive.u "),
            ({"drive.u": 1.0, "drive.gain": 1e9}, r"drive.gain .*(max|above|10)"),
        ):
            with pytest.raises(SteeringError, match=words):
                run.set(values)
        assert run["drive.u"] == 0.0
        with pytest.raises(SteeringError, match=r"no connected input.*use set"):
            run.override({"drive.u": 1.0})
        run.until(0.1)
    with open_run(car(), in_process=True) as run:
        with pytest.raises(SteeringError, match=r"wheel.x_c is connected to chassis.x.*override"):
            run.set({"wheel.x_c": 1.0})
        with pytest.raises(SteeringError, match=r"chassis.m cannot be set.*fixed.*parameters"):
            run.set({"chassis.m": 1.0})
        with pytest.raises(SteeringError, match=r"wheel.x_c is not overridden"):
            run.release("wheel.x_c")


def test_a_driven_input_is_not_set(capability_dir: Path) -> None:
    """Inputs that the table of inputs drives are left to it."""
    table = InputSettings(table=((0.0, 1.0), (0.0, 1.0)))
    system = System(
        simulation={"stop_time": 1.0},
        slaves={"drive": {"model": str(capability_dir / "drive2.fmu")}},
        inputs={"drive.u": table},
    )
    with open_run(system, in_process=True) as run:
        run.until(0.5)
        assert run["drive.u"] == pytest.approx(0.5)
        with pytest.raises(SteeringError, match=r"drive.u is driven from outside.*\[inputs\]"):
            run.set({"drive.u": 1.0})


# ---- Ends ---------------------------------------------------------------------------------------


def test_a_session_that_is_left_early_is_stopped_and_resumed(tmp_path: Path) -> None:
    """Its results hold what was reached, and `resume` leads to the files of one call."""
    system = car(checkpoint_interval=1e-9)
    simulate(system, output=tmp_path / "call", in_process=True)
    with open_run(system, output=tmp_path / "session", in_process=True) as run:
        many_steps(run, 5)
        time = run.time
    loaded = Result.load(tmp_path / "session")
    assert loaded.summary["outcome"] == run.result().summary["outcome"] == "stopped"
    assert loaded.time[-1] == time
    resume(tmp_path / "session")
    assert files(tmp_path / "call") == files(tmp_path / "session")


@pytest.mark.parametrize("slave", [{}, {"state": "replay"}])
def test_changes_and_branches_are_resumed(
    capability_dir: Path, tmp_path: Path, slave: Mapping[str, Any]
) -> None:
    """Values set and overridden before a run was broken off hold when it goes on."""

    def steered(folder: Path, stop: float) -> None:
        system = drive(capability_dir, **slave)
        system = system.with_simulation(checkpoint_interval=1e-9)
        with open_run(system, output=folder, in_process=True) as run:
            run.set({"drive.u": 2.0})
            mark = run.save()
            run.until(0.2)
            run.restore(mark)
            run.set({"drive.gain": 3.0})
            run.until(0.4)
            many_steps(run, 2)
            if stop == 1.0:
                run.until(1.0)

    steered(tmp_path / "whole", 1.0)
    steered(tmp_path / "cut", 0.4)
    resume(tmp_path / "cut")
    assert files(tmp_path / "whole") == files(tmp_path / "cut")


@pytest.mark.parametrize("steps", [0, 3])
def test_a_run_is_resumed_behind_a_branch(fmu_dir: Path, tmp_path: Path, steps: int) -> None:
    """Also where the log of the slaves' calls no longer holds the mark that was restored."""
    system = car(
        estimator="none", initial_step_size=0.002, checkpoint_interval=1e-9
    ).with_simulation(stop_time=1.0)
    for name in ("chassis", "wheel"):
        system = system.with_slave(name, model=str(fmu_dir / f"{name}.fmu"))
    simulate(system, output=tmp_path / "call", in_process=True)
    with open_run(system, output=tmp_path / "cut", in_process=True) as run:
        many_steps(run, 50)
        mark, other = run.save(), run.save()
        many_steps(run, 200)
        run.forget(other)
        run.restore(mark)
        many_steps(run, steps)
    resume(tmp_path / "cut")
    assert files(tmp_path / "call") == files(tmp_path / "cut")


def test_overrides_are_resumed(tmp_path: Path) -> None:
    """An input that was overridden when a run was broken off stays so."""
    system = car(checkpoint_interval=1e-9)

    def steered(folder: Path, *, whole: bool) -> None:
        with open_run(system, output=folder, in_process=True) as run:
            many_steps(run, 2)
            run.override({"wheel.x_c": 0.05})
            many_steps(run, 2)
            while whole and run.step():
                pass

    steered(tmp_path / "whole", whole=True)
    steered(tmp_path / "cut", whole=False)
    resume(tmp_path / "cut")
    assert files(tmp_path / "whole") == files(tmp_path / "cut")


def test_ctrl_c_waits_for_the_step(tmp_path: Path) -> None:
    """The session stands at a communication point then, and ends in the files of one call."""

    class Press:
        """Presses Ctrl-C in its fourth attempt."""

        left = 4

        def started(self, _: object) -> None:
            pass

        def attempted(self, _: Attempt) -> None:
            self.left -= 1
            if self.left == 0:
                signal.raise_signal(signal.SIGINT)

        def ended(self, _: object) -> None:
            pass

    signal.signal(signal.SIGINT, signal.default_int_handler)
    simulate(car(), output=tmp_path / "call", in_process=True)
    output = tmp_path / "session"
    with open_run(car(), output=output, in_process=True, observers=[Press()]) as run:
        with pytest.raises(KeyboardInterrupt):
            run.until(STOP)
        assert 0.0 < run.time < STOP
        assert run.result().time[-1] == run.time
        run.until(STOP)
    assert files(tmp_path / "call") == files(output)


def test_an_interrupted_with_block_is_told(tmp_path: Path) -> None:
    """The results say that the run was interrupted."""
    run = open_run(car(), output=tmp_path / "run", in_process=True)
    run.step()
    with pytest.raises(InterruptedRunError), run:
        raise KeyboardInterrupt
    assert Result.load(tmp_path / "run").summary["outcome"] == "interrupted"


def test_an_observer_that_raises_breaks_the_run_off() -> None:
    """The results so far can be read, and every further step says why there is none."""

    class Refusing:
        def started(self, _: object) -> None:
            pass

        def attempted(self, attempt: Attempt) -> None:
            if attempt.time > 0.1:
                raise ValueError("that is enough")

        def ended(self, _: object) -> None:
            pass

    with open_run(car(), in_process=True, observers=[Refusing()]) as run:
        with pytest.raises(ValueError, match="enough"):
            run.until(STOP)
        with pytest.raises(SteeringError, match=r"cannot go on.*that is enough"):
            run.step()
        assert run.result().time[-1] > 0.1


def test_one_folder_has_one_session(tmp_path: Path) -> None:
    """A second one is refused while the first is open."""
    with (
        open_run(car(), output=tmp_path, in_process=True),
        pytest.raises(ResultsError, match=r"another"),
        open_run(car(), output=tmp_path, in_process=True),
    ):
        pass
    with open_run(car(), output=tmp_path, in_process=True) as run:
        run.step()


@pytest.mark.parametrize("ends", ["with", "forgotten"])
def test_launched_slaves_are_steered_and_end(
    tmp_path: Path, no_process_left: None, ends: str
) -> None:
    """Over Zenoh the same bits as in process; a session that is left open ends its slaves."""
    system = car()
    reads = []
    for mode in (True, False):
        run = open_run(system, output=tmp_path / str(mode), in_process=mode)
        run.until(0.1)
        mark = run.save()
        run.override({"wheel.x_c": 0.05})
        run.until(0.2)
        reads.append(run["wheel.x"])
        run.restore(mark)
        run.until(STOP)
        if ends == "with":
            with run:
                pass
        del run
        gc.collect()
    assert reads[0] == reads[1]
    assert files(tmp_path / "True") == files(tmp_path / "False")


def test_errors_of_slaves_end_the_session(tmp_path: Path) -> None:
    """H that would have to be too small is told as of one call."""
    system = car(initial_step_size=0.1, smallest_step_size=0.1, relative_tolerance=1e-12)
    with open_run(system, output=tmp_path, in_process=True) as run:
        with pytest.raises(DoublestepError, match="smallest communication step size"):
            run.until(STOP)
        with pytest.raises(SteeringError, match="cannot go on"):
            run.step()


# ---- Results and examples -----------------------------------------------------------------------


def test_results_in_a_notebook(session: Session) -> None:
    """A data frame with the bits of the result, a length, and a picture with escaped words."""
    session.until(0.2)
    result = session.result()
    frame = result.to_pandas()
    assert len(result) == len(frame) == len(result.time)
    assert list(frame.columns) == [*result]
    assert frame["wheel.x"].to_numpy().tobytes() == result["wheel.x"].tobytes()
    assert frame.index.to_numpy().tobytes() == result.time.tobytes()
    assert frame.attrs["units"]["wheel.x"] == "m"
    html = result._repr_html_()
    assert "&lt;Result" in html
    assert "data:image/png;base64,iVBOR" in html


def test_the_example_what_if() -> None:
    """Its branches end apart, and the last one as a run without branches."""
    ends = example("what_if").main()
    result = open_run(load_system(EXAMPLES / "displacement_python.toml"), in_process=True)
    with result as run:
        run.until(1.0)
        assert ends["as it is"] == run.until(2.0)["chassis.x"]
    assert len({round(end, 4) for end in ends.values()}) == 3


def test_the_example_with_an_optimizer() -> None:
    """The damper that it finds is better than the given one, and within its bounds."""
    damping, best, as_it_is = example("choose_damper").main()
    assert 200.0 < damping < 5000.0
    assert best < 0.6 * as_it_is


def test_the_example_of_an_environment() -> None:
    """Episodes repeat to the last bit, whatever came between them."""
    module = example("environment")
    with module.SemiActiveDamper(steps=10) as environment:
        first = module.episode(environment, 300.0)
        other = module.episode(environment, 3000.0)
        assert module.episode(environment, 300.0) == first != other
        observation, told = environment.reset(seed=1)
        assert observation.shape == (4,)
        assert not told
        observation, reward, is_over, is_late, told = environment.step(1000.0)
        assert told["time"] == pytest.approx(0.02, abs=1e-12)
        assert reward < 0.0
        assert not is_over
        assert not is_late


def example(name: str) -> Any:
    """A module of the examples, as it stands."""
    path = EXAMPLES.parent / "steering" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
