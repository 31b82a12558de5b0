"""Jacobians of slaves from differences of their answers, and of the interface between them.

In an iterated step the inputs U at its nodes are wanted for which U = c(Y(U)). Each evaluation of
Y is one request to all slaves. A slave's outputs depend on its own inputs alone, so differences of
its inputs and outputs between two evaluations are *secants* of its own Jacobian, and all slaves
gather theirs at the same time: as many evaluations as the widest slave has inputs at the nodes give
the whole interface Jacobian J, however many slaves there are. (Interface quasi-Newton methods as
IQN-ILS gather secants of the whole; Sicklinger and others 2014 put J together slave by slave, from
directional derivatives.) The newest secants come first, older ones fill what these leave open.

What the secants span is solved for at once, (I - J) correction = residual. What they do not span
answers in a way that is not known; there the residual stands for the correction, and `Correction`
tells how much of it there is, and by how much stiffness might enlarge it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.signals import FloatArray

_DEPENDENT = 1e-6
"""Part of a secant that the newer ones do not span, below which it says nothing of its own."""


class Secants(NamedTuple):
    """Pairs of differences between evaluations of one slave, newest first.

    Attributes:
        inputs: of its p inputs at the nodes, shape (p,) each, unit [u].
        outputs: of its q outputs at the nodes, shape (q,) each, unit [y].
    """

    inputs: tuple[FloatArray, ...] = ()
    outputs: tuple[FloatArray, ...] = ()

    def pushed(self, inputs: FloatArray, outputs: FloatArray, most: int) -> Secants:
        """With a newer pair, the ``most`` newest of them."""
        return Secants((inputs, *self.inputs[: most - 1]), (outputs, *self.outputs[: most - 1]))


class Interface(NamedTuple):
    """Inputs and outputs of each slave.

    Attributes:
        input_slices, output_slices: for each slave, of the n inputs and of the m outputs.
        outputs: m.
        inputs_of: changes of connected inputs, shape (..., n), that belong to changes of outputs,
            shape (..., m).
    """

    input_slices: Sequence[slice]
    output_slices: Sequence[slice]
    outputs: int
    inputs_of: Callable[[FloatArray], FloatArray]


class Correction(NamedTuple):
    """Correction of the inputs at the nodes.

    Attributes:
        inputs: (I - J)^-1 residual, shape (nodes, n), unit [u].
        size: root mean square of it in units of the tolerances; infinite where the equations are
            singular.
        unknown: bound of its error, in units of the tolerances, by parts whose answers no secant
            tells: their size, times what the known part of (I - J)^-1 could make of them.
    """

    inputs: FloatArray
    size: float
    unknown: float


class InterfaceJacobian:
    """J in the directions in which the slaves' secants tell it.

    With orthonormal directions Q of all slaves and the inputs W that belong to their answers,
    J = W Q^T, so only (I - Q^T W) a = Q^T residual is to be solved: as many equations as there are
    directions.

    Args:
        secants: of each slave.
        interface: see there.
        scale: tolerances of the inputs, shape (nodes, n), unit [u].
    """

    def __init__(self, secants: Sequence[Secants], interface: Interface, scale: FloatArray) -> None:
        self._scale = scale
        directions, answers = [], []
        for own, inputs, outputs in zip(
            secants, interface.input_slices, interface.output_slices, strict=True
        ):
            own_directions, own_answers = orthonormal(own, scale[:, inputs].ravel())
            for direction, answer in zip(own_directions, own_answers, strict=True):
                all_inputs = np.zeros_like(scale)
                all_inputs[:, inputs] = direction.reshape(len(scale), -1)
                directions.append(all_inputs)
                all_outputs = np.zeros((len(scale), interface.outputs))
                all_outputs[:, outputs] = answer.reshape(len(scale), -1)
                answers.append(interface.inputs_of(all_outputs) / scale)
        number = len(directions)
        self._directions = np.array(directions).reshape(number, scale.size)
        self._answers = np.array(answers).reshape(number, scale.size)
        self._projected = self._directions @ self._answers.T

    @cached_property
    def _inverse(self) -> FloatArray | None:
        """(I - Q^T W)^-1; None where there is none."""
        if not np.isfinite(self._projected).all():
            return None
        matrix: FloatArray = np.eye(len(self._projected)) - self._projected
        try:
            return np.asarray(np.linalg.inv(matrix), dtype=float)
        except np.linalg.LinAlgError:
            return None

    @property
    def loop_gain(self) -> float:
        """Spectral radius of J as far as it is known: factor of an error from sweep to sweep."""
        if not np.isfinite(self._projected).all():
            return float("inf")
        return float(np.abs(np.linalg.eigvals(self._projected)).max(initial=0.0))

    def enlargement(self, error: FloatArray) -> float:
        """Size of (I - J)^-1 error over that of the error, shape (n,), unit [u]; 1 at least."""
        weighted = error / self._scale
        size = float(np.sqrt(np.vdot(weighted, weighted) / max(1, weighted.size)))
        if not size > 0.0:
            return 1.0
        return max(1.0, self.correction(weighted * self._scale).size / size)

    def correction(self, residual: FloatArray) -> Correction:
        """Newton's correction of the inputs at the nodes.

        Args:
            residual: c(Y(U)) - U, shape (nodes, n), unit [u].
        """
        weighted = (residual / self._scale).ravel()
        if self._inverse is None:
            return Correction(residual, float("inf"), float("inf"))
        answered = self._inverse.T @ self._answers
        found = weighted + (self._directions @ weighted) @ answered
        rest = found - (self._directions @ found) @ self._directions
        gain = 1.0 + float(np.sqrt(np.vdot(answered, answered)))
        size = float(np.sqrt(found @ found / max(1, len(found))))
        unknown = gain * float(np.sqrt(rest @ rest / max(1, len(rest))))
        return Correction(found.reshape(self._scale.shape) * self._scale, size, unknown)


def loop_gain_bound(
    inputs: FloatArray,
    answers: FloatArray,
    slave_of_input: NDArray[np.intp],
    slave_of_source: NDArray[np.intp],
) -> float:
    """Bound of the loop gain that one secant of each slave tells: J's Frobenius norm.

    Args:
        inputs: differences of the inputs, in tolerances, shape (n,).
        answers: differences of the inputs that belong to the outputs' differences, in tolerances,
            shape (n,).
        slave_of_input: number of the slave that has the input, shape (n,).
        slave_of_source: number of the slave that feeds it, shape (n,).
    """
    slaves = int(slave_of_source.max(initial=0)) + 1
    squares = np.bincount(slave_of_input, inputs * inputs, slaves).take(slave_of_source)
    told = squares > 0.0
    return float(np.sqrt((answers[told] ** 2 / squares[told]).sum()))


def orthonormal(secants: Secants, scale: FloatArray) -> tuple[list[FloatArray], list[FloatArray]]:
    """Orthonormal directions of the secants, by Gram and Schmidt from the newest on.

    Args:
        secants: of one slave.
        scale: tolerances of its inputs at the nodes, shape (p,); units of the directions.

    Returns:
        The directions, shape (p,) each, and the change of the outputs for each, shape (q,), unit
        [y].
    """
    directions: list[FloatArray] = []
    answers: list[FloatArray] = []
    for inputs, outputs in zip(secants.inputs, secants.outputs, strict=True):
        if len(directions) == len(scale):
            break
        direction = inputs / scale
        length = float(np.sqrt(direction @ direction))
        if not 0.0 < length < np.inf:
            continue
        direction = direction / length
        answer = outputs / length
        for _ in range(2):  # twice is enough for orthogonality to rounding
            for other, others_answer in zip(directions, answers, strict=True):
                part = other @ direction
                direction = direction - part * other
                answer = answer - part * others_answer
        rest = float(np.sqrt(direction @ direction))
        if rest >= _DEPENDENT:
            directions.append(direction / rest)
            answers.append(answer / rest)
    return directions, answers
