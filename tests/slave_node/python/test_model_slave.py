"""Laws of `ModelSlave`, of the declarations of a `Model`, and of finding one by reference."""

import hashlib
import inspect
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.calls import Initialize, StepStatus
from protocol.errors import ConfigurationError, ModelError, SlaveError, StepRejectedError
from protocol.signals import InputSignal
from protocol.variables import Causality, Variable, VariableType
from slave_node.model import Model, describe, real
from slave_node.python import model_slave
from slave_node.python.loading import load_model_class
from slave_node.python.model_slave import ModelSlave
from tests.support.places import ROOT

QUARTER_CAR = "examples/quarter_car/quarter_car.py"

Chassis = load_model_class(f"{QUARTER_CAR}:Chassis", ROOT)
quarter_car = inspect.getmodule(Chassis)


class WholeCar(Model):
    """Both halves of the quarter car in one model, without inputs."""

    states = (real("x_c"), real("v_c"), real("x_w"), real("v_w"))
    outputs = states

    def prepare(self):
        self.chassis, self.wheel = quarter_car.Chassis(), quarter_car.Wheel()

    def derivatives(self, t, x, u):
        return [
            *self.chassis.derivatives(t, x[:2], x[2:]),
            *self.wheel.derivatives(t, x[2:], x[:2]),
        ]


class Lag(Model):
    """x' = (u - x) / T."""

    inputs = (real("u"),)
    states = (real("x"),)
    outputs = states
    parameters = (real("T", "s", start=1.0), real("max_step", "s"))

    def derivatives(self, t, x, u):
        return (u - x) / self.T


class Pendulum(Model):
    """Driven and nonlinear, with an output that is no state and uses the input."""

    inputs = (real("torque"), real("wind", start=0.5))
    states = (real("angle", "rad", start=1.0), real("speed", "rad/s"))
    outputs = (*states, real("power"))
    feed_through = {"power": ("torque",)}  # noqa: RUF012 - a ClassVar of Model

    def derivatives(self, t, x, u):
        return [x[1], u[0] + u[1] - np.sin(x[0]) * np.exp(0.1 * np.cos(t))]

    def output_values(self, t, x, u):
        return [*x, x[1] * u[0]]


class Gain(Model):
    """A function without states."""

    inputs = (real("u"),)
    outputs = (real("y"),)
    parameters = (real("K", start=2.0),)
    feed_through = {"y": ("u",)}  # noqa: RUF012 - a ClassVar of Model

    def output_values(self, t, x, u):
        return self.K * u

    def output_derivatives(self, t, x, u, dx, du):
        return self.K * du


def started(model, start_values=None, *, tolerance=None, inputs=None, outputs=None, time=0.0):
    """A slave at its first communication point."""
    slave = ModelSlave(model)
    slave.initialize(
        Initialize(
            start_time=time,
            stop_time=None,
            relative_tolerance=tolerance,
            start_values=start_values or {},
            inputs=tuple(v.name for v in model.inputs) if inputs is None else inputs,
            outputs=tuple(v.name for v in model.outputs) if outputs is None else outputs,
        )
    )
    slave.exit_initialization_mode()
    return slave


def march(slave, time, steps):
    """Take steps one after the other; the outputs after each as bytes, and the time reached."""
    seen = []
    for derivatives, step_size in steps:
        slave.set_inputs(derivatives)
        status, time = slave.do_step(time, step_size, False)
        assert status is StepStatus.OK
        highest = slave.description.capabilities.max_output_derivative_order
        seen.append(slave.get_outputs(highest).tobytes())
    return seen, time


def some_steps(seed, n, n_u):
    """Give n random inputs, shape (k + 1, n_u), and step sizes [s]."""
    random = np.random.default_rng(seed)
    return [
        (random.normal(size=(random.integers(1, 5), n_u)), random.uniform(1e-3, 0.2))
        for _ in range(n)
    ]


# ---- Accuracy --------------------------------------------------------------------------------


def test_exact_solution_satisfies_the_equations_of_the_models():
    """exact_solution starts at rest and its derivative is the models' right-hand side."""
    t, h = np.linspace(0.01, 4.0, 100), 1e-4
    car = WholeCar()
    car.prepare()
    s = quarter_car.exact_solution
    slope = (8.0 * (s(t + h) - s(t - h)) - (s(t + 2 * h) - s(t - 2 * h))) / (12.0 * h)
    expected = [car.derivatives(0.0, x, np.empty(0)) for x in s(t)]
    np.testing.assert_allclose(slope, expected, atol=1e-6)
    np.testing.assert_allclose(s([0.0]), np.zeros((1, 4)), atol=1e-15)


def test_error_is_proportional_to_the_tolerance():
    """Over nine decades the greatest error on a changing grid is less than 10 tolerances."""
    ratios = []
    for tolerance in 10.0 ** -np.arange(3, 12):
        slave, t, worst = started(WholeCar, tolerance=tolerance), 0.0, 0.0
        for step_size in np.tile([0.003, 0.02, 0.05], 20):
            _, t = slave.do_step(t, step_size, False)
            error = slave.get_outputs(0)[0] - quarter_car.exact_solution([t])[0]
            worst = max(worst, np.abs(error).max())
        ratios.append(worst / tolerance)
    assert max(ratios) < 10.0
    assert max(ratios) < 2.0 * min(ratios)


def test_short_steps_cost_one_inner_step_each():
    """The inner step is carried on, and not shortened by the ends of communication steps."""
    calls = []

    class Counted(Lag):
        def derivatives(self, t, x, u):
            calls.append(t)
            return super().derivatives(t, x, u)

    slave, t = started(Counted, {"x": 1.0}), 0.0
    _, t = slave.do_step(t, 0.5, False)
    carried = slave.get_state().inner_step
    for step_size in (1e-2, 1e-6, 1e-9, 1e-2):
        calls.clear()
        _, t = slave.do_step(t, step_size, False)
        assert len(calls) == 7
    assert slave.get_state().inner_step >= carried


def test_default_tolerance_is_a_millionth():
    """No tolerance given is the same as 1e-6, to the bit."""
    outputs = [
        march(started(Lag, tolerance=rtol), 0.0, some_steps(1, 5, 1)) for rtol in (None, 1e-6)
    ]
    assert outputs[0] == outputs[1]


@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_polynomial_inputs_are_followed_within_the_step(k):
    """With u = p + p', x' = u - x has the solution x = p, whatever the step size and the order."""
    p = np.polynomial.Polynomial([0.3, -1.0, 2.0, 0.7][: k + 1])
    u = p + p.deriv()
    slave, t = started(Lag, {"x": p(0.0)}, tolerance=1e-9), 0.0
    for step_size in (0.5, 0.01, 1.0):
        slave.set_inputs(np.array([[u.deriv(j)(t) if j else u(t)] for j in range(k + 1)]))
        _, t = slave.do_step(t, step_size, False)
        assert slave.get_outputs(0)[0, 0] == pytest.approx(p(t), abs=1e-8)


def test_inputs_go_on_as_the_same_polynomial():
    """Two steps on one polynomial give what one step of both lengths gives."""
    u = np.array([[1.0], [2.0], [-3.0], [5.0]])
    once, twice = started(Lag, tolerance=1e-10), started(Lag, tolerance=1e-10)
    once.set_inputs(u)
    twice.set_inputs(u)
    once.do_step(0.0, 0.75, False)
    twice.do_step(0.0, 0.25, False)
    twice.do_step(0.25, 0.5, False)
    np.testing.assert_allclose(once.get_outputs(1), twice.get_outputs(1), atol=1e-9)


def test_nominal_value_scales_the_absolute_tolerance():
    """A model in other units, with nominal values to match, takes the same inner steps."""

    class Large(Lag):
        states = (real("x", nominal=2.0**40),)
        outputs = states

    small, large = started(Lag), started(Large)
    small.set_inputs(np.array([[1.0]]))
    large.set_inputs(np.array([[2.0**40]]))
    small.do_step(0.0, 1.5, False)
    large.do_step(0.0, 1.5, False)
    assert large.get_outputs(0) == 2.0**40 * small.get_outputs(0)


def test_the_end_of_a_step_is_set():
    """The time reached is the sum of communication point and step size, to the bit."""
    slave, t = started(Lag), 0.0
    for step_size in (0.1, 0.2, 1e-9, 0.3):
        expected = t + step_size
        status, t = slave.do_step(t, step_size, False)
        assert (status, t) == (StepStatus.OK, expected)


def test_stiff_model_with_an_implicit_solver():
    """Radau takes a step of a million time constants; RK45 gives up with a remedy."""

    class Stiff(Lag):
        solver = "Radau"

    slave = started(Stiff, {"T": 1e-6})
    slave.set_inputs(np.array([[3.0]]))
    slave.do_step(0.0, 1.0, False)
    assert slave.get_outputs(0)[0, 0] == pytest.approx(3.0, rel=1e-5)


def test_a_step_of_too_many_inner_steps_is_rejected(monkeypatch):
    """A model too stiff for its solver is reported instead of running for hours."""
    monkeypatch.setattr(model_slave, "MAX_INNER_STEPS", 10)
    slave = started(Lag, {"T": 1e-6})
    slave.set_inputs(np.array([[3.0]]))
    with pytest.raises(StepRejectedError, match=r"more than 10 inner steps.*Radau"):
        slave.do_step(0.0, 1.0, False)


# ---- Saved states ----------------------------------------------------------------------------


@pytest.mark.parametrize("solver", sorted(model_slave.SOLVERS))
def test_restored_state_repeats_the_same_bits(solver):
    """A restored state repeats its future, whatever happened after it was saved."""
    model = type("Variant", (Pendulum,), {"solver": solver})
    slave = started(model)
    _, t = march(slave, 0.0, some_steps(2, 3, 2))
    state = slave.get_state()
    first = march(slave, t, some_steps(3, 5, 2))
    slave.set_state(state)
    march(slave, t, some_steps(4, 2, 2))
    for _ in range(2):
        slave.set_state(state)
        assert march(slave, t, some_steps(3, 5, 2)) == first


def test_restored_state_brings_back_its_inputs():
    """Inputs belong to the state: without new ones the slave goes on with the saved ones."""
    slave = started(Pendulum)
    slave.set_inputs(np.array([[1.0, 2.0], [3.0, 4.0]]))
    slave.do_step(0.0, 0.1, False)
    state, outputs = slave.get_state(), slave.get_outputs(0)
    slave.set_inputs(np.array([[-7.0, 0.0]]))
    slave.set_state(state)
    np.testing.assert_array_equal(slave.get_outputs(0), outputs)


def test_failed_step_leaves_no_trace():
    """After a rejected step the slave, even without a restore, is what it was before."""

    class Wall(Lag):
        def derivatives(self, t, x, u):
            return [1.0 / (0.5 - t)] if t < 0.5 else [math.nan]

    slave = started(Wall)
    slave.do_step(0.0, 0.1, False)
    state = slave.get_state()
    with pytest.raises(StepRejectedError):
        slave.do_step(0.1, 0.6, False)
    assert slave.get_state() is state


@pytest.mark.parametrize("model", [Pendulum, Lag, Gain, WholeCar])
def test_serialized_state_goes_on_with_the_same_bits_in_a_fresh_slave(model):
    """Nothing that matters later is missing in the bytes, and serializing is reproducible."""
    slave, n_u = started(model), len(model.inputs)
    _, t = march(slave, 0.0, some_steps(5, 3, n_u))
    data = slave.serialize_state(slave.get_state())
    expected = march(slave, t, some_steps(6, 4, n_u))

    fresh = started(model)
    state = fresh.deserialize_state(data)
    assert fresh.serialize_state(state) == data
    fresh.set_state(state)
    assert march(fresh, t, some_steps(6, 4, n_u)) == expected


@given(data=st.binary(max_size=300), keep=st.integers(0, 200))
@settings(max_examples=300, deadline=None)
def test_random_bytes_are_refused(data, keep):
    """Bytes that are no saved state raise SlaveError and nothing else, also after a good start."""
    slave = started(Pendulum)
    good = slave.serialize_state(slave.get_state())
    for bad in (data, good[:keep] + data):
        if bad != good:
            with pytest.raises(SlaveError):
                slave.deserialize_state(bad)


def test_every_flipped_bit_is_noticed():
    """A saved state that was damaged anywhere is refused."""
    slave = started(Pendulum)
    good = slave.serialize_state(slave.get_state())
    for i in range(8 * len(good)):
        bad = bytearray(good)
        bad[i // 8] ^= 1 << i % 8
        with pytest.raises(SlaveError):
            slave.deserialize_state(bytes(bad))


def test_states_of_another_experiment_are_refused():
    """Other parameters, another tolerance or another model would not go on with the same bits."""
    state_of = started(Lag)
    data = state_of.serialize_state(state_of.get_state())
    for other in (started(Lag, {"T": 2.0}), started(Lag, tolerance=1e-5), started(Gain)):
        with pytest.raises(SlaveError, match="not of this"):
            other.deserialize_state(data)
    for nonsense in (None, 3, started(Pendulum).get_state()):
        with pytest.raises(SlaveError, match="not a saved state of Lag"):
            state_of.set_state(nonsense)


def test_a_model_cannot_write_into_a_saved_state():
    """The arrays of a state are read-only, so a model that writes to x is caught."""

    class Vandal(Lag):
        def derivatives(self, t, x, u):
            x[0] = 0.0
            return x

    with pytest.raises(SlaveError, match="read-only"):
        started(Vandal).do_step(0.0, 0.1, False)


# ---- Inputs and outputs ----------------------------------------------------------------------


def test_outputs_with_feed_through_use_the_input_at_the_end_of_the_step():
    """After a step u is u(T + H), and set_inputs replaces the whole polynomial."""
    u = InputSignal(np.array([[1.0], [2.0], [3.0], [4.0]]))
    slave = started(Gain, {"K": 10.0})
    slave.set_inputs(u.derivatives)
    slave.do_step(0.0, 0.5, False)
    expected = 10.0 * u.shifted(0.5).derivatives[:2]
    np.testing.assert_allclose(slave.get_outputs(1), expected, rtol=1e-15)
    slave.set_inputs(np.array([[7.0]]))
    np.testing.assert_array_equal(slave.get_outputs(1), [[70.0], [0.0]])


def test_output_derivatives_are_the_slopes_of_the_outputs():
    """Row 1 is the derivative of what row 0 is, for states and for an output with feed-through."""
    wheel = load_model_class(f"{QUARTER_CAR}:WheelForce", ROOT)
    h, u = 1e-5, np.array([[0.1, 1.0], [2.0, 30.0], [10.0, 100.0]])
    for model in (Chassis, wheel):
        slave = started(model, tolerance=1e-12)
        slave.set_inputs(u)
        slave.do_step(0.0, 0.1, False)
        before = slave.get_outputs(0)[0]
        slave.do_step(0.1, h, False)
        slope = slave.get_outputs(1)[1]
        slave.do_step(0.1 + h, h, False)
        central = (slave.get_outputs(0)[0] - before) / (2.0 * h)
        np.testing.assert_allclose(slope, central, rtol=1e-4)


def test_derivatives_that_a_model_does_not_have_are_refused():
    """The order is at most what the description promises."""
    assert describe(Pendulum).capabilities.max_output_derivative_order == 0
    assert describe(Lag).capabilities.max_output_derivative_order == 1
    with pytest.raises(SlaveError, match=r"order 1 .* up to 0"):
        started(Pendulum).get_outputs(1)
    with pytest.raises(SlaveError, match=r"order 2 .* up to 1"):
        started(Lag).get_outputs(2)


def test_columns_are_those_named_at_initialization():
    """Inputs and outputs come in the master's order; an input not named keeps its start value."""
    full, part = started(Pendulum), started(Pendulum, inputs=["torque"], outputs=["power", "angle"])
    full.set_inputs(np.array([[2.0, 0.5], [1.0, 0.0]]))
    part.set_inputs(np.array([[2.0], [1.0]]))
    for slave in (full, part):
        slave.do_step(0.0, 0.3, False)
    np.testing.assert_array_equal(part.get_outputs(0), full.get_outputs(0)[:, [2, 0]])


def test_wrong_shapes_of_inputs_are_refused():
    """No rows, too many rows, another number of columns, another dimension."""
    slave = started(Pendulum)
    for shape in ((0, 2), (5, 2), (1, 3), (2,), (1, 2, 1)):
        with pytest.raises(SlaveError, match="inputs of shape"):
            slave.set_inputs(np.zeros(shape))


def test_the_slave_keeps_its_own_copy_of_the_inputs():
    """A caller may use its array again."""
    slave, u = started(Gain), np.array([[3.0]])
    slave.set_inputs(u)
    u[:] = math.nan
    assert slave.get_outputs(0) == 6.0


# ---- Steps that do not go through ------------------------------------------------------------


def test_step_beyond_max_step_is_discarded_where_it_ends():
    """DISCARD, and the slave stands at T + max_step as after a step of that size; 0 is no limit."""
    limited, free = started(Lag, {"max_step": 0.25, "x": 1.0}), started(Lag, {"x": 1.0})
    assert limited.do_step(0.0, 0.25, False) == (StepStatus.OK, 0.25)
    assert limited.do_step(0.25, 0.3, False) == (StepStatus.DISCARD, 0.5)
    free.do_step(0.0, 0.25, False)
    free.do_step(0.25, 0.25, False)
    np.testing.assert_array_equal(limited.get_outputs(0), free.get_outputs(0))


def test_wrong_communication_point_is_refused_by_both_times():
    """A step begins where the last one ended, to the last bit; the message names both times."""
    slave, t = started(Lag, time=3.0), 3.0
    for _ in range(10):
        _, t = slave.do_step(t, 0.1, False)
    assert t != 4.0 == pytest.approx(t)
    for point in (4.5, 4.0):
        with pytest.raises(SlaveError, match=rf"from {point} s, but the slave stands at {t!r} s"):
            slave.do_step(point, 0.1, False)
    assert slave.do_step(t, 0.1, False)[0] is StepStatus.OK


@pytest.mark.parametrize("step_size", [0.0, -0.1, math.nan, math.inf, 1e-30])
def test_steps_that_do_not_advance_are_refused(step_size):
    """The time must grow, and stay finite."""
    with pytest.raises(SlaveError, match="does not advance"):
        started(Lag, time=1.0).do_step(1.0, step_size, False)


class NotANumber(Lag):
    def derivatives(self, t, x, u):
        return [math.nan if t > 0.05 else 1.0]


class Overflow(Lag):
    def derivatives(self, t, x, u):
        return x * 1e308 + 1e308


class DivisionByZero(Lag):
    def derivatives(self, t, x, u):
        return [1.0 / self.nothing]

    nothing = 0.0


class NegativeRoot(Lag):
    def derivatives(self, t, x, u):
        return [math.sqrt(-1.0 - t)]


@pytest.mark.parametrize("solver", sorted(model_slave.SOLVERS))
@pytest.mark.parametrize(
    ("model", "cause"),
    [
        (NotANumber, r"derivative of 'x' is not finite at t=0\."),
        (Overflow, "is not finite"),
        (
            DivisionByZero,
            r"DivisionByZero\.derivatives\(\).*ZeroDivisionError.*test_model_slave.*line",
        ),
        (NegativeRoot, "ValueError: .*math domain|expected a nonneg"),
    ],
)
def test_right_hand_side_without_a_value_rejects_the_step(model, cause, solver):
    """A smaller step may succeed, so it is a rejection; the message says which value."""
    slave = started(type(model.__name__, (model,), {"solver": solver}))
    with pytest.raises(StepRejectedError, match=cause):
        slave.do_step(0.0, 0.2, False)


def test_input_that_is_not_finite_rejects_the_step():
    """NaN from the master does not get into the states."""
    slave = started(Lag)
    slave.set_inputs(np.array([[math.nan]]))
    with pytest.raises(StepRejectedError, match="not finite"):
        slave.do_step(0.0, 0.1, False)


@pytest.mark.parametrize("returned", [None, [1.0, 2.0], 1.0, [], "x", [[1.0]]])
def test_wrong_returned_value_is_an_error_with_its_place(returned):
    """A wrong shape or type is named with model, method and time."""
    model = type("Wrong", (Lag,), {"derivatives": lambda *_: returned})
    with pytest.raises(SlaveError, match=r"Wrong\.derivatives\(\) at t=0\.0 s"):
        started(model).do_step(0.0, 0.1, False)


def test_defect_in_a_model_is_no_rejection():
    """A smaller step would not help against a wrong name, so the run ends."""

    class Typo(Lag):
        def derivatives(self, t, x, u):
            return [self.tau]

    with pytest.raises(SlaveError, match=r"AttributeError.*tau") as caught:
        started(Typo).do_step(0.0, 0.1, False)
    assert not isinstance(caught.value, StepRejectedError)


# ---- Set up ----------------------------------------------------------------------------------


def test_description_of_a_model():
    """Causalities, units, start values and capabilities are those of the declarations."""
    d = describe(Pendulum)
    assert (d.model, d.kind, d.state_kind) == ("Pendulum", "Python model", "native")
    assert [v.name for v in d.of(Causality.INPUT)] == ["torque", "wind"]
    assert [v.name for v in d.of(Causality.OUTPUT)] == ["angle", "speed", "power"]
    assert d.variable("angle").start == 1.0
    assert d.variable("power").start is None
    assert d.feed_through == {"power": ("torque",)}
    assert d.capabilities.can_serialize_state
    assert d.sha256 == hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    force = describe(load_model_class(f"{QUARTER_CAR}:WheelForce", ROOT))
    assert [v.name for v in force.of(Causality.LOCAL)] == ["x", "v"]
    assert force.variable("k_w").unit == "N/m"


def test_a_model_without_a_source_file_still_has_a_hash():
    """The hash is of the qualified name, so that the next process has it too."""
    scope = {"__name__": "nowhere", "Model": Model}
    exec("class Ghost(Model): pass", scope)
    assert describe(scope["Ghost"]).sha256 == hashlib.sha256(b"nowhere.Ghost").hexdigest()


def test_start_values_reach_parameters_states_and_inputs():
    """They are there at the first communication point; prepare() sees the parameters."""

    class Prepared(Gain):
        parameters = (
            *Gain.parameters,
            Variable("n", type=VariableType.INTEGER, start=1),
            Variable("on", type=VariableType.BOOLEAN, start=False),
        )

        def prepare(self):
            self.K = self.K * self.n if self.on else 0.0

    slave = started(Prepared, {"K": 3, "n": 2, "on": True, "u": 5.0}, inputs=[])
    assert slave.get_outputs(0) == 30.0
    assert started(Pendulum, {"angle": 0.25}).get_outputs(0)[0, 0] == 0.25


def test_reset_forgets_everything():
    """After reset a slave is as after its construction."""
    slave = started(Lag, {"T": 5.0, "x": 2.0}, tolerance=1e-3)
    march(slave, 0.0, some_steps(7, 3, 1))
    slave.reset()
    fresh = ModelSlave(Lag)
    assert slave.serialize_state(slave.get_state()) == fresh.serialize_state(fresh.get_state())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start_values": {"angel": 1.0}}, "no variable 'angel'; did you mean 'angle'"),
        ({"start_values": {"power": 1.0}}, "'power' is computed by Pendulum"),
        ({"start_values": {"angle": "1"}}, "'angle' is of type Real; it cannot be '1'"),
        ({"start_values": {"angle": True}}, "it cannot be True"),
        ({"inputs": ["torqe"]}, "no input 'torqe'; did you mean 'torque'"),
        ({"outputs": ["zzz"]}, "no output 'zzz'; there is 'angle', 'speed', 'power'"),
        ({"outputs": ["angle", "angle"]}, "'angle' is listed twice"),
        ({"tolerance": 0.0}, "relative tolerance 0.0"),
        ({"tolerance": math.nan}, "relative tolerance nan"),
    ],
)
def test_wrong_set_up_is_named(arguments, message):
    """The error has the user's wrong text, and the nearest right one."""
    with pytest.raises(ConfigurationError) as caught:
        started(Pendulum, **arguments)
    assert message in str(caught.value)


def test_constructor_that_fails_is_named():
    """A model that cannot be made is the model's fault, with the place in its source."""

    class Broken(Gain):
        def __init__(self):
            raise OSError("no table")

    with pytest.raises(ModelError, match=r"Broken\.__init__\(\): OSError: no table .*line"):
        ModelSlave(Broken)


def test_negative_max_step_is_refused():
    """0 is no limit, a negative one is a mistake."""
    with pytest.raises(ConfigurationError, match=r"max_step is -1\.0"):
        started(Lag, {"max_step": -1.0})


def test_prepare_that_fails_is_named():
    """An exception of the user's code becomes an error with its place."""

    class Broken(Gain):
        def prepare(self):
            raise RuntimeError("no table")

    with pytest.raises(SlaveError, match=r"Broken\.prepare\(\): RuntimeError: no table .*line"):
        started(Broken)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"inputs": (real("u"), real("u"))}, "'u' is declared twice"),
        ({"inputs": (real("x"),)}, "'x' is declared twice"),
        ({"outputs": (real("x", "m"),)}, "'x' is declared twice"),
        ({"inputs": ("u",)}, "'u' is not a variable"),
        ({"states": (real("x", nominal=0.0),)}, "nominal"),
        ({"inputs": (Variable("u", type=VariableType.INTEGER),)}, "not real"),
        ({"parameters": (real("spring.c"),)}, "cannot be the name"),
        ({"parameters": (real("inputs"),)}, "cannot be the name"),
        ({"parameters": (Variable("p"),)}, "no start value"),
        ({"feed_through": {"xx": ()}}, "no output 'xx'; did you mean 'x'"),
        ({"feed_through": {"x": ("v",)}}, "no input 'v'; there is 'u'"),
        ({"derivatives": Model.derivatives}, "no method derivatives()"),
        ({"outputs": (real("y"),)}, "no method output_values()"),
        ({"solver": "RK54"}, "no 'RK54'; did you mean 'RK45'"),
    ],
)
def test_contradictory_declarations_are_refused(attributes, message):
    """A slave is not even made of a model whose declarations cannot be right."""
    with pytest.raises(ModelError) as caught:
        ModelSlave(type("Wrong", (Lag,), attributes))
    assert message in str(caught.value)


def test_feed_through_that_is_not_declared_is_found():
    """It would make the step size control use a wrong order; a declared one that is 0 does not."""
    model = type("Silent", (Pendulum,), {"feed_through": {}})
    with pytest.raises(ModelError, match=r"'power' depends directly on input 'torque'"):
        started(model, {"speed": 1.0})
    started(Pendulum, {"speed": 0.0})


# ---- Loading ---------------------------------------------------------------------------------


def test_models_are_found_by_file_and_by_module():
    """Both forms of a reference lead to the class; other files of the same name do not disturb."""
    assert load_model_class(str(ROOT / QUARTER_CAR) + ":Wheel", Path("/")).__name__ == "Wheel"
    assert load_model_class("slave_node.model:Model", ROOT) is Model


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("models.py", "does not name a model; write"),
        (":Class", "does not name a model; write"),
        ("models.py:", "does not name a model; write"),
        ("modles.py:Car", "did you mean 'models.py'"),
        ("no_such_package.module:Car", "no module 'no_such_package'; install"),
        ("slave_node.no_such_module:Car", "no module 'slave_node.no_such_module'; install"),
        ("models.py:Cart", "no class 'Cart' there; did you mean 'Car'"),
        ("models.py:number", "'number' is not a subclass of Model; there is 'Car', 'Truck'"),
        ("models.py:Model", None),
        ("broken.py:Car", "broken.py failed: RuntimeError: no licence (broken.py, line 2)"),
        ("missing.py:Car", "missing.py failed: ModuleNotFoundError: No module named 'nowhere'"),
        ("syntax.py:Car", "syntax.py failed: SyntaxError"),
        ("leaves.py:Car", "leaves.py failed: SystemExit: 3"),
    ],
)
def test_reference_that_leads_nowhere_is_named(tmp_path, reference, message):
    """The error names the missing part, a near one, and the module's own error."""
    (tmp_path / "models.py").write_text(
        "from slave_node.model import Model\n"
        "class Car(Model): pass\nclass Truck(Model): pass\nnumber = 3\n"
    )
    (tmp_path / "broken.py").write_text("\nraise RuntimeError('no licence')\n")
    (tmp_path / "missing.py").write_text("import nowhere\n")
    (tmp_path / "syntax.py").write_text("class Car(\n")
    (tmp_path / "leaves.py").write_text("raise SystemExit(3)\n")
    if message is None:
        assert load_model_class(reference, tmp_path) is Model
        return
    with pytest.raises(ModelError) as caught:
        load_model_class(reference, tmp_path)
    assert message in str(caught.value)


def test_dependency_missing_inside_an_installed_module_is_not_taken_for_the_module(
    tmp_path, monkeypatch
):
    """The message names what is missing, and where it was wanted."""
    (tmp_path / "wants_more.py").write_text("import not_installed_anywhere\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModelError, match=r"import of wants_more failed.*not_installed_anywhere"):
        load_model_class("wants_more:Car", ROOT)
