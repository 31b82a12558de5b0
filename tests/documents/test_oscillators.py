"""The FMUs of the oscillators obey their equations, and the reference solutions obey the FMUs.

What all FMUs of the framework have in common (life cycle, refusals, saved states) is tested with
the quarter car; here is what these models add: four inputs, an output of the time, no states.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from master_node import Result, System, simulate
from protocol.calls import Initialize, StepStatus
from protocol.slave import Slave
from protocol.variables import Causality, StartValue
from slave_node.loading import describe_model, load_slave

MODELS = ("mass", "van_der_pol", "step_source")
NAMES = ("two_mass", "van_der_pol", "chain", "kick")


# ---- The models, as mathematics -----------------------------------------------------------------


def mass(p: Mapping[str, float], s: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Shape (2,); inputs are x_left, v_left, x_right, v_right."""
    x, v = s
    force = p["c_left"] * (u[0] - x) + p["d_left"] * (u[1] - v)
    force += p["c_right"] * (u[2] - x) + p["d_right"] * (u[3] - v)
    return np.array([v, force / p["m"]])


def van_der_pol(p: Mapping[str, float], s: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Shape (2,); inputs are x_other, v_other."""
    x, v = s
    pull = p["c"] * (u[0] - x) + p["d"] * (u[1] - v)
    return np.array([v, p["mu"] * (1 - x**2) * v - x + pull])


Equations = Callable[[Mapping[str, float], np.ndarray, np.ndarray], np.ndarray]
MOVING: dict[str, tuple[Equations, dict[str, float]]] = {
    "mass": (mass, {"m": 0.7, "c_left": 13.0, "d_left": 0.3, "c_right": 40.0, "d_right": 1.1}),
    "van_der_pol": (van_der_pol, {"mu": 1.7, "c": 0.4, "d": 0.15}),
}
START = {"x": 0.8, "v": -1.3}


def polynomials(model: str) -> np.ndarray:
    """Inputs of degree 3 that all differ; row j holds the j-th derivatives, shape (4, n_u)."""
    rows = np.array(
        [
            [0.5, 0.3, -0.4, 1.1],
            [-0.2, 0.7, 0.9, -0.6],
            [3.0, -4.0, 1.0, 2.0],
            [-20.0, 30.0, 9.0, -11.0],
        ]
    )
    return rows[:, : 4 if model == "mass" else 2]


# ---- The FMUs -----------------------------------------------------------------------------------

Load = Callable[..., Slave]


@pytest.fixture
def load(oscillator_dir: Path, tmp_path: Path) -> Iterator[Load]:
    """``load(model, start values, outputs)`` gives a slave that can be stepped from t = 0.5 s on.

    Its inputs are all that the model has; its outputs too unless others are asked for.
    """
    with ExitStack() as stack:

        def initialized(
            model: str,
            values: Mapping[str, StartValue] | None = None,
            outputs: Sequence[str] | None = None,
        ) -> Slave:
            scratch = tmp_path / f"{model}_{len(list(tmp_path.iterdir()))}"
            scratch.mkdir()
            slave = load_slave(f"{model}.fmu", oscillator_dir, model, scratch)
            stack.callback(slave.close)
            variables = slave.description.variables
            slave.initialize(
                Initialize(
                    start_time=0.5,
                    stop_time=None,
                    relative_tolerance=1e-12,
                    start_values=values or {},
                    inputs=tuple(v.name for v in variables if v.causality is Causality.INPUT),
                    outputs=outputs
                    or tuple(v.name for v in variables if v.causality is Causality.OUTPUT),
                )
            )
            slave.exit_initialization_mode()
            return slave

        yield initialized


@pytest.mark.parametrize("model", MODELS)
def test_fmu_is_valid(oscillator_dir: Path, model: str) -> None:
    """The archive and its model description keep the rules of FMI 2.0."""
    assert validate_fmu(str(oscillator_dir / f"{model}.fmu")) == []


@pytest.mark.parametrize("model", MODELS)
def test_capabilities(oscillator_dir: Path, model: str) -> None:
    """All that the error control can use, and no direct feed-through."""
    description = describe_model(f"{model}.fmu", oscillator_dir)
    can = description.capabilities
    assert can.can_get_and_set_state
    assert can.can_serialize_state
    assert can.can_interpolate_inputs
    assert can.can_handle_variable_step_size
    assert can.max_output_derivative_order == 1
    outputs = [v for v in description.variables if v.causality is Causality.OUTPUT]
    assert outputs
    assert description.feed_through.keys().isdisjoint(v.name for v in outputs)
    assert all(v.is_continuous_real for v in outputs)


@pytest.mark.parametrize("model", MODELS)
def test_the_binary_has_the_start_values_of_its_description(load: Load, model: str) -> None:
    """The reference solutions read them there."""
    description = load(model).description
    starts = {v.name: v.start for v in description.variables if v.start is not None}
    assert len(starts) >= 4
    (values,) = load(model, outputs=list(starts)).get_outputs(0)
    assert dict(zip(starts, values, strict=True)) == starts


@pytest.mark.parametrize("model", MOVING)
def test_motion_under_polynomial_inputs(load: Load, model: str) -> None:
    """Over several steps, from any start: the solution of the equations with these inputs."""
    equations, parameters = MOVING[model]
    slave, u = load(model, {**parameters, **START}), polynomials(model)
    slave.set_inputs(u)
    steps = np.array([0.2, 0.05, 0.4])
    times = np.cumsum(steps)

    def derivatives(t: float, s: np.ndarray) -> np.ndarray:
        return equations(parameters, s, sum(u[j] * t**j / math.factorial(j) for j in range(4)))

    expected = solve_ivp(
        derivatives,
        (0.0, times[-1]),
        list(START.values()),
        method="DOP853",
        t_eval=times,
        rtol=1e-12,
        atol=1e-12,
    ).y.T
    now = 0.5
    for step_size, states in zip(steps, expected, strict=True):
        done = slave.do_step(now, step_size, True)
        assert done.status is StepStatus.OK
        now += step_size
        np.testing.assert_allclose(slave.get_outputs(0)[0], states, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("model", MOVING)
def test_output_derivatives(load: Load, model: str) -> None:
    """They are the right-hand side at the outputs and inputs that the slave has."""
    equations, parameters = MOVING[model]
    slave, u = load(model, {**parameters, **START}), polynomials(model)
    slave.set_inputs(u)
    states, rates = slave.get_outputs(1)
    assert states.tolist() == list(START.values())
    np.testing.assert_allclose(rates, equations(parameters, states, u[0]), rtol=1e-14)


@pytest.mark.parametrize("model", MODELS)
def test_a_saved_state_repeats_bit_for_bit(load: Load, model: str) -> None:
    """A step leads to the same bits any number of times, and from serialized bytes elsewhere."""
    values = {**MOVING[model][1], **START} if model in MOVING else {"before": 3.0, "after": 7.0}
    slave, other = load(model, values), load(model)

    def step(one: Slave) -> bytes:
        one.do_step(0.8, 0.3, False)
        return one.get_outputs(1).tobytes()

    if model in MOVING:
        slave.set_inputs(polynomials(model))
    slave.do_step(0.5, 0.3, False)
    state = slave.get_state()
    block = slave.serialize_state(state)
    first = step(slave)
    for _ in range(2):
        slave.set_state(state)
        assert step(slave) == first
    moved = other.deserialize_state(block)
    other.set_state(moved)
    assert step(other) == first
    other.free_state(moved)
    slave.free_state(state)


def test_the_step_source_jumps_at_its_time_and_not_before(load: Load) -> None:
    """One unit in the last place before t_step it has not jumped; its derivative is always 0."""
    slave = load("step_source", {"before": -2.0, "after": 5.0, "t_step": 1.0})
    assert slave.get_outputs(1).tolist() == [[-2.0], [0.0]]
    state = slave.get_state()
    for step_size, y in ((0.5, 5.0), (math.nextafter(1.0, 0.0) - 0.5, -2.0), (3.0, 5.0)):
        assert slave.do_step(0.5, step_size, False).time == 0.5 + step_size
        assert slave.get_outputs(1).tolist() == [[y], [0.0]]
        slave.set_state(state)
    slave.free_state(state)
    assert load("step_source", {"t_step": 0.5}).get_outputs(0).tolist() == [[1.0]]


def test_a_step_source_can_discard(load: Load) -> None:
    """A slave without states goes as far as max_step too."""
    slave = load("step_source", {"max_step": 0.25})
    done = slave.do_step(0.5, 1.0, False)
    assert (done.status, done.time) == (StepStatus.DISCARD, 0.75)


# ---- The reference solutions --------------------------------------------------------------------


def slopes_of_the_fmus(
    load: Load, tables: Mapping[str, Any], now: Mapping[str, float]
) -> dict[str, float]:
    """The derivatives of x and v when the outputs of a system have the values ``now``."""
    sources = {connection["to"]: connection["from"] for connection in tables["connections"]}
    slopes: dict[str, float] = {}
    for name, table in tables["slaves"].items():
        model = Path(table["model"]).stem
        if model not in MOVING:
            continue
        states = {state: now[f"{name}.{state}"] for state in ("x", "v")}
        slave = load(model, {**table["parameters"], **states})
        inputs = [v.name for v in slave.description.variables if v.causality is Causality.INPUT]
        connected = [sources.get(f"{name}.{variable}") for variable in inputs]
        slave.set_inputs(np.array([[now[source] if source else 0.0 for source in connected]]))
        derivatives = slave.get_outputs(1)[1]
        slopes |= {f"{name}.{state}": derivatives[i] for i, state in enumerate(states)}
    return slopes


@pytest.mark.parametrize("name", NAMES)
def test_reference_solution_satisfies_the_equations_of_the_fmus(
    oscillators: ModuleType, load: Load, name: str
) -> None:
    """Its derivative is what the FMUs say that their outputs do, wired as the system file says.

    At some times that are not too close to the jump, by the five-point formula.
    """
    tables = tomllib.loads(oscillators.SYSTEMS[name][0].read_text(encoding="utf-8"))
    outputs = sorted({connection["from"] for connection in tables["connections"]})
    h = 2e-4
    for t in (0.3, 0.97, 1.03, 7.7):
        y = oscillators.reference_solution(name, outputs, t + h * np.arange(-2, 3))
        dy = dict(zip(outputs, (y[0] - 8 * y[1] + 8 * y[3] - y[4]) / (12 * h), strict=True))
        slopes = slopes_of_the_fmus(load, tables, dict(zip(outputs, y[2].tolist(), strict=True)))
        expected = [dy[output] for output in slopes]
        np.testing.assert_allclose(list(slopes.values()), expected, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("name", NAMES)
def test_reference_solution_begins_at_the_start_values(oscillators: ModuleType, name: str) -> None:
    """And its columns come in the order that is asked for."""
    system = oscillators.load(name)
    backwards = system.states[::-1]
    (start,) = oscillators.reference_solution(name, backwards, [0.0])
    assert start.tolist() == [system.values[state] for state in backwards]
    assert np.any(start) == (name != "kick")


def test_reference_solution_of_the_kick(oscillators: ModuleType) -> None:
    """At rest before the jump; after it a motion that only depends on the time since then."""
    states = oscillators.load("kick").states
    before, at = np.linspace(0.0, 1.0, 11), np.array([1.0, 1.5, 4.0])
    assert not np.any(oscillators.reference_solution("kick", states, before))
    y = oscillators.reference_solution("kick", ["source.y"], [0.0, np.nextafter(1.0, 0.0), 1.0])
    assert y.ravel().tolist() == [0.0, 0.0, 0.1]
    late = oscillators.reference_solution("kick", states, at + 1.25, {"source.t_step": 2.25})
    motion = oscillators.reference_solution("kick", states, at)
    np.testing.assert_allclose(late, motion, rtol=0, atol=1e-14)
    early = oscillators.reference_solution("kick", states, at - 1.0, {"source.t_step": -3.0})
    np.testing.assert_allclose(early, motion, rtol=0, atol=1e-14)


def test_what_has_no_reference_solution_is_refused(oscillators: ModuleType) -> None:
    """A name that is not there, and a time before the start."""
    with pytest.raises(KeyError):
        oscillators.reference_solution("chain", ["mass_9.x"], [0.0])
    with pytest.raises(KeyError, match=r"left\.k"):
        oscillators.reference_solution("two_mass", ["left.x"], [0.0], {"left.k": 1.0})
    with pytest.raises(ValueError, match="before the start"):
        oscillators.reference_solution("two_mass", ["left.x"], [0.0, -1.0])


# ---- The systems --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["two_mass", "chain", "kick"])
def test_action_is_reaction(oscillators: ModuleType, name: str) -> None:
    """Both ends of a spring or damper have the same constant: stiffness and damping symmetric."""
    system = oscillators.load(name)
    matrix = oscillators.mass_matrix(system, 0.0)
    m = np.array([[system.values[f"{slave}.m"]] for slave in system.slaves("mass")])
    for forces in (m * matrix[1:-1:2, 0:-1:2], m * matrix[1:-1:2, 1:-1:2]):
        np.testing.assert_allclose(forces, forces.T, rtol=1e-14)


def test_two_mass_has_a_fast_and_a_slow_mode(oscillators: ModuleType) -> None:
    """The fast one 10 to 20 times as fast, moderately damped; a few periods of the slow one."""
    system = oscillators.load("two_mass")
    modes = np.linalg.eigvals(oscillators.mass_matrix(system, 0.0)[:-1, :-1])
    slow, _, fast, _ = modes[np.argsort(np.abs(modes))]
    assert 10 < abs(fast) / abs(slow) < 20
    assert 0.1 < -fast.real / abs(fast) < 0.4
    assert 3 < system.stop_time * abs(slow) / (2 * np.pi) < 8


def simulated(oscillators: ModuleType, folder: Path, name: str, tolerance: float) -> Result:
    """A run with order 2."""
    tables = tomllib.loads(oscillators.SYSTEMS[name][0].read_text(encoding="utf-8"))
    return simulate(
        System(**tables, base=folder),
        in_process=True,
        order=2,
        relative_tolerance=tolerance,
        absolute_tolerance=tolerance,
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_co_simulation_comes_close_to_the_reference_solution(
    oscillators: ModuleType, oscillator_dir: Path, name: str
) -> None:
    """The closer, the smaller the tolerance.

    The kick is measured from where the slaves can learn of it: the first communication point that
    is not before it.
    """
    errors = []
    for tolerance in (1e-3, 1e-5):
        result = simulated(oscillators, oscillator_dir, name, tolerance)
        jump = {"source.t_step": result.time[result.time >= 1.0][0]} if name == "kick" else None
        exact = oscillators.reference_solution(name, result.names, result.time, jump)
        errors.append(np.max(np.abs(result.outputs - exact)))
    assert errors[1] < errors[0] / 10
    assert errors[1] < 0.01
