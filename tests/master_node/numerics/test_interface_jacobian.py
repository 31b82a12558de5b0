"""Laws of the interface Jacobian: secants of slaves, corrections, loop gains."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from master_node.numerics.interface_jacobian import (
    Interface,
    InterfaceJacobian,
    Secants,
    orthonormal,
)

FloatArray = NDArray[np.float64]
NODES = 2


class Linear:
    """Slaves with linear answers Y_i = A_i U_i at both nodes; inputs are outputs of others.

    Args:
        widths: how many inputs, and as many outputs, each slave has at a node.
        source: of each input the number of its output.
        gain: size of the answers.
        seed: of the random answers.
    """

    def __init__(self, widths: list[int], source: list[int], gain: float, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        ends = np.cumsum(widths)
        self.slices = [slice(int(b - w), int(b)) for w, b in zip(widths, ends, strict=True)]
        self.size = int(ends[-1])
        self.answers = [gain * random.uniform(-1.0, 1.0, (NODES * w, NODES * w)) for w in widths]
        self.constant = random.uniform(-1.0, 1.0, (NODES, self.size))
        self.source = np.array(source)
        self.interface = Interface(self.slices, self.slices, self.size, self.inputs_of)
        self.scale = np.full((NODES, self.size), 1e-3)

    def inputs_of(self, outputs: FloatArray) -> FloatArray:
        """Inputs that belong to outputs."""
        return outputs[..., self.source]

    def outputs(self, inputs: FloatArray) -> FloatArray:
        """One evaluation of all slaves, shape (nodes, m)."""
        y = self.constant.copy()
        for own, answer in zip(self.slices, self.answers, strict=True):
            y[:, own] += (answer @ inputs[:, own].ravel()).reshape(NODES, -1)
        return y

    def evaluations(self, most: int) -> tuple[int, FloatArray]:
        """Evaluations until the correction vanishes and nothing is unknown; the inputs then."""
        secants = [Secants()] * len(self.slices)
        inputs = np.zeros((NODES, self.size))
        before: tuple[FloatArray, FloatArray] | None = None
        for number in range(1, most + 1):
            outputs = self.outputs(inputs)
            if before is not None:
                du, dy = inputs - before[0], outputs - before[1]
                secants = [
                    own.pushed(du[:, columns].ravel(), dy[:, columns].ravel(), 2 * self.size)
                    for own, columns in zip(secants, self.slices, strict=True)
                ]
            before = inputs, outputs
            jacobian = InterfaceJacobian(secants, self.interface, self.scale)
            correction = jacobian.correction(self.inputs_of(outputs) - inputs)
            if max(correction.size, correction.unknown) <= 1e-6:
                return number, inputs
            inputs = inputs + correction.inputs
        raise AssertionError(f"no end after {most} evaluations")

    def solution(self) -> FloatArray:
        """The inputs that agree with their outputs, by one dense system."""
        size = NODES * self.size
        residual = [
            (self.inputs_of(self.outputs(unit)) - self.inputs_of(self.constant) - unit).ravel()
            for unit in np.eye(size).reshape(size, NODES, self.size)
        ]
        right = -self.inputs_of(self.constant).ravel()
        return np.linalg.solve(np.array(residual).T, right).reshape(NODES, self.size)


def ring(slaves: int, gain: float, seed: int = 0) -> Linear:
    """Each slave's input is the output of the one before."""
    return Linear([1] * slaves, [(i - 1) % slaves for i in range(slaves)], gain, seed)


def rod(pieces: int, gain: float, seed: int = 0) -> Linear:
    """Pieces with two inputs and two outputs each, one towards either neighbour."""
    size = 2 * pieces
    source = [(i - 1) % size if i % 2 == 0 else (i + 1) % size for i in range(size)]
    return Linear([2] * pieces, source, gain, seed)


def pair(secants: list[Secants], scale: float = 1.0) -> InterfaceJacobian:
    """Two slaves with one input each, that get each other's output; one node."""

    def swapped(outputs: FloatArray) -> FloatArray:
        return outputs[..., ::-1]

    slices = [slice(0, 1), slice(1, 2)]
    interface = Interface(slices, slices, 2, swapped)
    return InterfaceJacobian(secants, interface, np.full((1, 2), scale))


def secant(du: float, dy: float) -> Secants:
    """One of a slave with one input and one output."""
    return Secants((np.array([du]),), (np.array([dy]),))


@pytest.mark.parametrize("gain", [0.1, 1.0, 30.0])
@pytest.mark.parametrize("system", [ring, rod])
@pytest.mark.parametrize("seed", range(5))
def test_linear_systems_are_solved_whatever_their_gain(
    system: Callable[[int, float, int], Linear], gain: float, seed: int
) -> None:
    """The correction is Newton's as soon as secants span the inputs of each slave: exact."""
    linear = system(3, gain, seed)
    width = NODES * len(range(*linear.slices[0].indices(linear.size)))
    number, inputs = linear.evaluations(width + 3)
    exact = linear.solution()
    assert number <= width + 3
    np.testing.assert_allclose(inputs, exact, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("seed", range(5))
def test_evaluations_do_not_grow_with_the_number_of_slaves(seed: int) -> None:
    """All slaves gather their secants at the same time: a rod of twelve costs what one of three
    does.
    """
    few, _ = rod(3, 5.0, seed).evaluations(20)
    many, _ = rod(12, 5.0, seed).evaluations(20)
    assert many <= few + 1


def test_correction_of_a_loop_is_the_geometric_series() -> None:
    """Answers a and b in a loop: (I - J)^-1 of a residual is 1 / (1 - a b) of it and its answer."""
    a, b = 0.5, -3.0
    correction = pair([secant(2.0, 2.0 * a), secant(0.1, 0.1 * b)]).correction(
        np.array([[1.0, 0.0]])
    )
    expected = np.array([[1.0, a]]) / (1.0 - a * b)
    np.testing.assert_allclose(correction.inputs, expected, rtol=1e-12)
    assert correction.size == pytest.approx(np.sqrt((expected**2).mean()), rel=1e-12)
    assert correction.unknown == pytest.approx(0.0, abs=1e-12)


@given(a=st.floats(-50.0, 50.0), b=st.floats(-50.0, 50.0))
def test_loop_gain_is_the_spectral_radius(a: float, b: float) -> None:
    """The loop gain of two slaves is the root of the product of their answers."""
    gain = pair([secant(1.0, a), secant(1.0, b)]).loop_gain
    assert gain == pytest.approx(np.sqrt(abs(a * b)), rel=1e-6, abs=1e-7)


@given(gain=st.floats(1.001, 1e6))
def test_an_error_that_comes_back_with_its_own_sign_is_enlarged(gain: float) -> None:
    """A loop of two followers with answers 1 - 1 / gain enlarges a common error that much."""
    answer = 1.0 - 1.0 / gain
    jacobian = pair([secant(1.0, answer), secant(1.0, answer)])
    assert jacobian.enlargement(np.array([1.0, 1.0])) == pytest.approx(gain, rel=1e-6)
    assert jacobian.enlargement(np.array([1.0, -1.0])) == 1.0
    assert jacobian.enlargement(np.zeros(2)) == 1.0


def test_answers_that_no_secant_tells_are_unknown() -> None:
    """Without secants the residual is the correction, and all of it is unknown."""
    correction = pair([Secants(), Secants()], 0.1).correction(np.array([[0.3, 0.4]]))
    np.testing.assert_array_equal(correction.inputs, [[0.3, 0.4]])
    assert correction.unknown == pytest.approx(correction.size)
    assert correction.size == pytest.approx(np.sqrt(12.5))


def test_a_stiff_slave_enlarges_what_is_unknown_of_another() -> None:
    """The bound grows with what is known of the loop, so no sweep ends an iteration too early."""
    calm = pair([secant(1.0, 0.1), Secants()]).correction(np.array([[1.0, 0.2]]))
    stiff = pair([secant(1.0, 1e3), Secants()]).correction(np.array([[1.0, 0.2]]))
    assert stiff.unknown > 100.0 * calm.unknown


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_never_counts_as_converged(bad: float) -> None:
    """Not-finite answers and residuals give sizes that no bound passes."""
    with np.errstate(invalid="ignore"):  # as in a run
        infinite = pair([secant(1.0, bad), secant(1.0, 0.5)]).correction(np.array([[1e-9, 1e-9]]))
        assert not infinite.size <= 1.0
        assert not infinite.unknown <= 1.0
        assert pair([secant(1.0, bad), secant(1.0, 0.5)]).loop_gain == np.inf
        correction = pair([secant(1.0, 0.5), secant(1.0, 0.5)]).correction(np.array([[bad, 0.0]]))
        assert not max(correction.size, correction.unknown) <= 1.0


def test_singular_equations_never_count_as_converged() -> None:
    """Answers with the product 1 have no solution, or any: nothing passes, nothing is raised."""
    correction = pair([secant(1.0, 1.0), secant(1.0, 1.0)]).correction(np.array([[1.0, 0.0]]))
    assert not max(correction.size, correction.unknown) <= 1e6
    assert not pair([secant(1.0, 1.0), secant(1.0, 1.0)]).enlargement(np.ones(2)) <= 1e6


def test_directions_are_orthonormal_and_the_newest_come_first() -> None:
    """Dependent and empty secants are left out; a newer answer stands against an older one."""
    newest, older = np.array([2.0, 0.0, 0.0]), np.array([4.0, 0.0, 0.0])
    other, nothing = np.array([1.0, 1.0, 0.0]), np.zeros(3)
    secants = Secants(
        (newest, nothing, older, other),
        (np.array([6.0]), np.array([9.0]), np.array([0.0]), np.array([5.0])),
    )
    directions, answers = orthonormal(secants, np.ones(3))
    np.testing.assert_allclose(np.array(directions), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(np.array(answers), [[3.0], [2.0]], rtol=1e-12)


def test_the_oldest_secants_are_forgotten() -> None:
    """Only the newest secants stay."""
    secants = Secants()
    for number in range(5):
        secants = secants.pushed(np.array([float(number)]), np.array([0.0]), 3)
    assert [float(inputs[0]) for inputs in secants.inputs] == [4.0, 3.0, 2.0]
