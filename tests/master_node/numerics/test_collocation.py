"""Laws of the iterated step: stability, damping, order, and what Milne's device tells."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, factorial, sin

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from benchmarks.reproduction.stiff import growth as stability
from master_node.numerics.collocation import (
    FARTHEST,
    MIDDLE,
    NEAREST,
    TELLING,
    Collocation,
    earlier_point,
    follower_constant,
    milne_factor,
    predictor_constant,
)
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.extrapolation import CouplingHistory

FloatArray = NDArray[np.float64]

RATES = [10.0**exponent for exponent in range(-3, 7)]
"""kh of the exchanges."""

DISTANCES = [NEAREST, 0.7, 1.0, 1.3, 2.0, FARTHEST]
"""Distances of the earlier point from T, in units of h."""


class Slave:
    """x' = -a x + b u, y = x; without a: y = b u.

    Args:
        a: how fast it forgets [1/s]; None: it has no state.
        b: what it makes of its input.
    """

    def __init__(self, a: float | None, b: float) -> None:
        self.a, self.b = a, b

    def after(self, x: float, u: FloatArray, size: float) -> float:
        """Output after ``size`` [s], for an input with the derivatives u, shape (k + 1,)."""
        powers = np.array([size**j / factorial(j) for j in range(len(u))])
        if self.a is None:
            return float(self.b * (u @ powers))
        if self.a * size < 1.0:
            matrix = np.diag(np.ones(len(u)), 1)
            matrix[0, :2] = -self.a, self.b
            return float((expm(matrix * size) @ np.array([x, *u]))[0])
        solution = [  # the polynomial that solves the equation, derivative by derivative
            sum(self.b * (-1.0) ** j * u[i + j] / self.a ** (j + 1) for j in range(len(u) - i))
            for i in range(len(u))
        ]
        return float(solution @ powers + exp(-self.a * size) * (x - solution[0]))


def step(
    slaves: Sequence[Slave], x: FloatArray, earlier: FloatArray | None, d: float
) -> FloatArray:
    """Outputs of two slaves that get each other's, after one converged step of h = 1.

    Args:
        slaves: both.
        x: their outputs at T.
        earlier: those at -d, for degree 3; None: degree 2.
        d: see there.
    """
    times = [0.0] if earlier is None else [0.0, -d]
    known = [x] if earlier is None else [x, earlier]
    history = CouplingHistory(tuple(times), tuple(y[::-1][np.newaxis] for y in known), 9)
    collocation = Collocation(tuple(times), (MIDDLE, 1.0), tuple(range(len(times))), ())

    def outputs(inputs: FloatArray) -> FloatArray:
        begin, middle = collocation.step_inputs(history, inputs)
        pairs = list(enumerate(slaves))
        at_middle = [slave.after(x[i], begin[:, i], MIDDLE) for i, slave in pairs]
        at_end = [slave.after(at_middle[i], middle[:, i], 1.0 - MIDDLE) for i, slave in pairs]
        return np.array([at_middle, at_end])

    def residual(unknown: FloatArray) -> FloatArray:
        inputs = unknown.reshape(2, 2)
        return (outputs(inputs)[:, ::-1] - inputs).ravel()

    constant = residual(np.zeros(4))
    jacobian = np.array([residual(unit) - constant for unit in np.eye(4)]).T
    return outputs(np.linalg.solve(jacobian, -constant).reshape(2, 2))[1]


def growth(slaves: Sequence[Slave], d: float | None) -> float:
    """Spectral radius of the step from both outputs, and the earlier ones for degree 3."""
    if d is None:
        columns = [step(slaves, unit, None, 0.0) for unit in np.eye(2)]
        return float(np.abs(np.linalg.eigvals(np.array(columns).T)).max())
    matrix = np.zeros((4, 4))
    for i, unit in enumerate(np.eye(4)):
        matrix[:2, i] = step(slaves, unit[:2], unit[2:], d)
    matrix[2:, :2] = np.eye(2)
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def vessels(kh: float, leak: float) -> Sequence[Slave]:
    """Two followers, x_i' = k (x_other - x_i) - leak x_i."""
    return Slave(kh + leak, kh), Slave(kh + leak, kh)


def flow_cut(kh: float) -> Sequence[Slave]:
    """An integrator x' = q, and the flow q = -k x by direct feed-through."""
    return Slave(0.0, 1.0), Slave(None, -kh)


def lagging_flow(kh: float) -> Sequence[Slave]:
    """An integrator and a flow that follows ten times faster than it empties it."""
    return Slave(0.0, 1.0), Slave(10.0 * kh, -10.0 * kh * kh)


@pytest.mark.parametrize("kh", RATES)
@pytest.mark.parametrize("d", [None, *DISTANCES])
def test_pairs_are_stable_at_every_rate(kh: float, d: float | None) -> None:
    """Nothing that decays grows: followers, flow cuts, and both in one loop."""
    bound = 1.0 + 1e-9
    assert growth(flow_cut(kh), d) <= bound
    assert growth(lagging_flow(kh), d) <= bound
    for leak in (0.0, 1e-3, 1.0, 1e3):
        assert growth(vessels(kh, leak), d) <= bound + 1e-7


def test_a_stiff_flow_keeps_three_sevenths() -> None:
    """(1 - c) / c with c = 0.7 on flow cuts; the middle at 1/2 would keep everything."""
    assert growth(flow_cut(1e6), None) == pytest.approx((1.0 - MIDDLE) / MIDDLE, rel=1e-4)
    for d in DISTANCES:
        assert growth(flow_cut(1e6), d) < 0.83


def test_followers_forget_what_is_fast() -> None:
    """A slow mode that is fast against h is gone after one step (L-stability)."""
    assert growth(vessels(1e6, 1e3), None) < 1e-2
    assert growth(vessels(1e6, 1e5), None) < 1e-4


@pytest.mark.parametrize("is_flow", [False, True])
def test_region_of_stability(is_flow: bool) -> None:
    """Degree 2 is A-stable, degree 3 A(80 degrees)-stable; its growth on the imaginary axis."""
    sizes = 10.0 ** np.linspace(-3.0, 6.0, 46)
    axis = [1j * size for size in sizes]
    left = [size * np.exp(1j * np.radians(angle)) for size in sizes for angle in (100, 135, 180)]
    assert max(stability(z, None, is_flow=is_flow) for z in [*axis, *left]) <= 1.0 + 1e-9
    for d in DISTANCES:
        assert max(stability(z, d, is_flow=is_flow) for z in left) < 1.0
        largest = max(stability(z, d, is_flow=is_flow) for z in axis)
        assert largest <= (1.0005 if d >= 1.0 else 1.2)


def nodes_and_known(size: float, degree: int) -> tuple[tuple[float, float], list[float]]:
    """Offsets of a step of some size."""
    return (MIDDLE * size, size), [0.0] if degree == 2 else [0.0, -size]


def history_of(times: Sequence[float]) -> CouplingHistory:
    """Sin at these times [s], newest first."""
    inputs = tuple(np.array([[sin(time)]]) for time in times)
    return CouplingHistory(tuple(times), inputs, len(times))


def times_of(begin: float, size: float) -> DoubleStepTimes:
    """A step of ``size`` [s] with its middle where it belongs."""
    return DoubleStepTimes.from_step_size(begin, size / 2.0).with_middle(MIDDLE)


def follower_values(begin: float, size: float, degree: int) -> FloatArray:
    """The polynomial of a follower at both nodes: its derivative is that of sin there."""
    nodes, known = nodes_and_known(size, degree)
    powers = np.arange(degree + 1)
    rows = [offset**powers for offset in known]
    rows += [powers * node ** np.maximum(powers - 1, 0) for node in nodes]
    right = [sin(begin + offset) for offset in known] + [np.cos(begin + node) for node in nodes]
    found = np.linalg.solve(np.array(rows, dtype=float), right)
    return np.array([[found @ node**powers] for node in nodes])


def observed_order(errors: Sequence[float]) -> float:
    """Order of errors at sizes that are halved each time, between the last two."""
    return float(np.log2(errors[-2] / errors[-1]))


@pytest.mark.parametrize("degree", [2, 3])
def test_order_of_a_follower(degree: int) -> None:
    """Order degree + 1: the local error is `follower_constant` times u^(q) / q!."""
    q, begin = degree + 1, 0.4
    errors = [
        sin(begin + size) - follower_values(begin, size, degree)[1, 0] for size in (0.2, 0.1, 0.05)
    ]
    assert observed_order(np.abs(errors)) == pytest.approx(q, abs=0.15)
    nodes, known = nodes_and_known(0.05, degree)
    derivative = np.sin(begin + q * np.pi / 2.0)
    leading = follower_constant(known, nodes) * derivative / factorial(q)
    assert errors[-1] == pytest.approx(leading, rel=0.1)


@pytest.mark.parametrize("degree", [2, 3])
def test_order_of_a_flow(degree: int) -> None:
    """An integrator's local error is of order q + 1: one more than its input's."""
    begin, errors = 0.4, []
    for size in (0.2, 0.1, 0.05):
        nodes, known = nodes_and_known(size, degree)
        history = history_of([begin + offset for offset in known])
        collocation = Collocation(tuple(known), nodes, tuple(range(len(known))), ())
        exact = np.array([[sin(begin + node)] for node in nodes])
        derivatives = collocation.step_inputs(history, exact).begin[:, 0]
        found = sum(u * size ** (j + 1) / factorial(j + 1) for j, u in enumerate(derivatives))
        errors.append(abs(found - (np.cos(begin) - np.cos(begin + size))))
    assert observed_order(errors) == pytest.approx(degree + 2, abs=0.15)


@pytest.mark.parametrize("degree", [2, 3])
def test_milne_tells_the_error(degree: int) -> None:
    """The distance from the predictor, times the factor, is the error of a follower with its sign
    left out; as the step shrinks their ratio tends to 1.
    """
    begin, ratios = 0.4, []
    for size in (0.1, 0.05, 0.025):
        times = [begin, begin - size, begin - 2.0 * size, begin - 3.0 * size]
        if degree == 2:
            times = [begin, begin - 0.4 * size, begin - 5.0 * size]
        history = history_of(times)
        double = times_of(begin, size)
        collocation = Collocation.over(history, double)
        assert collocation.order == degree + 1
        found = follower_values(begin, size, degree)
        predicted = collocation.predicted(history)
        told = collocation.error(history.inputs[0][0], found, predicted)
        ratios.append(abs(told[0] / (sin(begin + size) - found[1, 0])))
    assert ratios[-1] == pytest.approx(1.0, abs=0.12)
    assert abs(ratios[-1] - 1.0) < abs(ratios[-2] - 1.0) < abs(ratios[-3] - 1.0)


def test_both_constants_have_one_sign() -> None:
    """So the factor is C_c / (C_p - C_c), and more than it would be with unlike signs."""
    nodes = (MIDDLE, 1.0)
    for known, past in (([0.0], [0.0, -0.3, -1.0]), ([0.0, -1.0], [0.0, -0.3, -1.0, -1.3])):
        corrector, predictor = follower_constant(known, nodes), predictor_constant(past, 1.0)
        assert 0.0 < TELLING * corrector < predictor
        assert milne_factor(known, nodes, past) == pytest.approx(
            corrector / (predictor - corrector), rel=1e-12
        )


@pytest.mark.parametrize("spacing", [1e-6, 1e-3, 0.05, 0.3, 1.0, 3.0])
def test_the_factor_is_bounded_on_every_grid(spacing: float) -> None:
    """Where predictor and polynomial err alike degree 2 is taken: the factor stays below 2."""
    for last in (0.4, 0.6, 1.0, 2.0, 3.9):
        offsets = [0.0, *(-spacing * i for i in (1, 2, 3)), -3.0 * spacing - last]
        history = history_of(offsets)
        times = times_of(0.0, 1.0)
        collocation = Collocation.over(history, times)
        known = [offsets[number] for number in collocation.known]
        past = [offsets[number] for number in collocation.predicting]
        assert 0.0 < milne_factor(known, collocation.nodes, past) <= 2.0


def test_without_past_points_the_error_is_not_told_too_small() -> None:
    """The distance from a line stands for the error of the first steps."""
    begin, size = 0.4, 0.1
    history = history_of([begin])
    times = times_of(begin, size)
    collocation = Collocation.over(history, times)
    found = follower_values(begin, size, 2)
    told = collocation.error(history.inputs[0][0], found, collocation.predicted(history))
    assert abs(told[0]) > abs(sin(begin + size) - found[1, 0])


def test_the_earlier_point_is_neither_near_nor_far() -> None:
    """The nearest point of those far enough is taken, unless it is too far."""
    assert earlier_point([0.0, -0.3, -0.6, -1.0], 1.0) == 2
    assert earlier_point([0.0, -0.3], 1.0) is None
    assert earlier_point([0.0, -4.1], 1.0) is None
    assert earlier_point([0.0], 1.0) is None


def test_values_that_are_not_finite_are_told() -> None:
    """An infinite or missing input gives an error that no bound passes."""
    history = history_of([0.0, -0.5, -1.0])
    times = times_of(0.0, 1.0)
    collocation = Collocation.over(history, times)
    predicted = collocation.predicted(history)
    for bad in (np.nan, np.inf):
        told = collocation.error(history.inputs[0][0], np.array([[0.0], [bad]]), predicted)
        assert not np.abs(told).max() <= 1e300
