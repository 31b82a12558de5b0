"""The polynomial that stands for a known signal in one step.

It meets the signal at both ends of the step, as far as its degree allows, and has its mean and its
first moment:

    degree 3   both ends, mean, first moment
    degree 2   both ends, mean
    degree 1   both ends
    degree 0   mean

With s = (t - T)/H, which runs from 0 to 1, that is

    u(0) + (u(1) - u(0)) s + a s (1 - s) + b s (1 - s) (2 s - 1)

A slave answers to an input by an integral over the step, so what is wrong with an input of the
right mean and first moment cancels to leading order: with degree 3 the error of the states is of
order H^7 where the signal is smooth, with degree 0 of order H^3. An impulse keeps its size and its
place also where a step goes over kinks or a jump. Outputs with direct feed-through are right at
communication points, as the ends are met. Polynomials up to their degree are reproduced.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.signals import MAX_ORDER, FloatArray

_ABSCISSAE, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_PLACES: FloatArray = 0.5 * (1.0 + _ABSCISSAE)
_PARTS: FloatArray = 0.5 * _WEIGHTS


class Quadrature(NamedTuple):
    """Where and with what weights to take a signal over a step; exact up to degree 5 in each piece.

    Attributes:
        times: in each of q pieces, shape (q, 3) [s].
        mean: weights of the mean over the step, shape (q, 3).
        moment: weights of the integral of (s - 1/2) u over s from 0 to 1, shape (q, 3).
    """

    times: FloatArray
    mean: FloatArray
    moment: FloatArray

    @staticmethod
    def over(begin: float, inner: FloatArray, end: float) -> Quadrature:
        """For a step from ``begin`` to ``end`` [s] over ``inner`` breakpoints, shape (q - 1,)."""
        step_size = end - begin
        edges = np.concatenate([[0.0], (inner - begin) / step_size, [1.0]])
        lengths = np.diff(edges)[:, np.newaxis]
        places = edges[:-1, np.newaxis] + lengths * _PLACES
        weights = lengths * _PARTS
        return Quadrature(begin + places * step_size, weights, weights * (places - 0.5))


def step_polynomial(
    first: FloatArray,
    last: FloatArray,
    deviations: tuple[FloatArray, FloatArray],
    step_size: float,
    degree: int | NDArray[np.intp],
) -> FloatArray:
    """The polynomials of n signals over a step of ``step_size`` H [s].

    Args:
        first: values at the beginning of the step, from inside, shape (n,).
        last: at its end, from inside, shape (n,).
        deviations: mean and first moment of u - ``first``, shape (n,) each: exactly 0 for a
            constant.
        step_size: H [s].
        degree: of all polynomials, or of each, shape (n,).

    Returns:
        Derivatives of order 0 to 3 at the beginning of the step, shape (4, n).
    """
    mean, moment = deviations
    change = last - first
    bow = np.where(np.greater_equal(degree, 2), 6.0 * mean - 3.0 * change, 0.0)
    twist = np.where(np.greater_equal(degree, 3), 60.0 * moment - 5.0 * change, 0.0)
    is_constant = np.equal(degree, 0)
    rows = np.empty((MAX_ORDER + 1, len(first)))
    rows[0] = np.where(is_constant, first + mean, first)
    rows[1] = np.where(is_constant, 0.0, (change + bow - twist) / step_size)
    rows[2] = (6.0 * twist - 2.0 * bow) / step_size**2
    rows[3] = -12.0 * twist / step_size**3
    return rows
