"""Constant inputs in substeps that act like a polynomial over the whole step.

Let u be a polynomial of degree k over a communication step H and c piecewise constant, with N
values. Held in a slave x' = A x + B u in place of u, c leaves at the end of the step the error

    int_0^H exp(A (H - t)) B (c - u) dt = sum_i A^i B (-1)^i / i! int_0^H (t - H)^i (c - u) dt

so what counts are the moments of c - u. With the mean values of u over the substeps the first
moment is right and the second one wrong, by u' H^3 / (12 N^2). Here as many moments are right as N
and u have coefficients: the first min(N, k + 1). With N = k + 1 the error is of order H^(k+3), one
more than that of the extrapolation. Of all values with these moments those next to the mean values
are taken.

Where an input enters nonlinearly its square counts too, and c misses some of it: x' = f(u) is wrong
by f'' u'^2 H^3 / (24 N^2). That is what more substeps are for: `substeps_needed`.
"""

from __future__ import annotations

from functools import lru_cache
from math import ceil, sqrt

import numpy as np
from numpy.polynomial.legendre import leggauss, legint, legval

from protocol.signals import MAX_ORDER, FloatArray

MAX_SUBSTEPS = 32
"""That many of its own choice; a model with a clock or a bound of its own may need more."""

_GAUSS_POINTS = 4
"""Exact for polynomials of degree 7: P_3 times a cubic and one more."""


def scaled(derivatives: FloatArray, step_size: float) -> FloatArray:
    """H^j / j! u^(j): the polynomial in units of its step.

    Args:
        derivatives: of the inputs at the beginning of the step, shape (k + 1, n), [u]/s^j.
        step_size: H [s].

    Returns:
        Shape (k + 1, n), unit [u].
    """
    rows = derivatives.copy()
    power = 1.0
    for j in range(1, len(rows)):
        power *= step_size / j
        rows[j] *= power
    return rows


def substep_values(rows: FloatArray, lengths: tuple[float, ...], *, meets_end: bool) -> FloatArray:
    """One constant value for each substep.

    Args:
        rows: of the polynomial, `scaled`, shape (k + 1, n).
        lengths: of the N substeps in units of H; their sum is 1.
        meets_end: the value in the last substep is u(T + H).

    Returns:
        Shape (N, n), unit [u].
    """
    values: FloatArray = substep_weights(lengths, len(rows), meets_end=meets_end) @ rows
    return values


@lru_cache(maxsize=256)
def substep_weights(lengths: tuple[float, ...], rows: int, *, meets_end: bool) -> FloatArray:
    """The values of the substeps are these weights times H^j/j! u^(j): shape (N, rows).

    In Legendre polynomials P_j on the step: c_n = sum_j a_j mean_n(P_j), with a_j such that
    int P_i c = int P_i u for as many i as there are j. Arguments as for `substep_values`.
    """
    edges = np.concatenate([[0.0], np.cumsum(lengths)])
    number = len(lengths) - meets_end
    degrees = range(min(number, rows))
    x = 2.0 * edges - 1.0
    means = np.stack([np.diff(legval(x, legint(_unit(j)))) / np.diff(x) for j in degrees], axis=1)
    points, gauss = leggauss(_GAUSS_POINTS)
    powers = np.stack([(0.5 * (points + 1.0)) ** j for j in range(rows)], axis=1)
    legendre = np.stack([legval(points, _unit(j)) for j in degrees])
    moments = (0.5 * gauss * legendre) @ powers
    widths = 0.5 * np.diff(x)
    weights = np.ones((len(lengths), rows))  # the last one is u(T + H)
    if meets_end:
        moments = moments - widths[-1] * np.outer(means[-1], weights[-1])
    free = means[:number]
    gram = (free.T * widths[:number]) @ free
    weights[:number] = free @ np.linalg.solve(gram, moments)
    weights.setflags(write=False)
    return weights


def _unit(degree: int) -> list[float]:
    return [0.0] * degree + [1.0]


def substeps_needed(rows: FloatArray, nominal: FloatArray, tolerance: float) -> int:
    """Number of equal substeps that an accuracy needs, from 1 to `MAX_SUBSTEPS`.

    k + 1 for the order. And let r be the relative change of an input in the step, |u - u(T)| /
    max(|u(T)|, nominal). A slave whose f depends on u as a square does makes an error of
    (r/N)^2 / 24 of its own change in the step; that change is taken to be r too, so

        r^3 / (24 N^2) <= tolerance

    Args:
        rows: of the polynomial, `scaled`, shape (k + 1, n).
        nominal: typical sizes of the inputs, shape (n,), unit [u].
        tolerance: relative, that of the slave's own solver.
    """
    if len(rows) == 1 or not nominal.size:
        return 1
    sizes = np.abs(rows)
    change = float((sizes[1:].sum(axis=0) / np.maximum(sizes[0], nominal)).max())
    if not change < np.inf:  # the step fails anyway
        return len(rows)
    needed = ceil(min(change * sqrt(change / (24.0 * tolerance)), MAX_SUBSTEPS))
    return max(len(rows), needed)


assert MAX_ORDER + 1 <= _GAUSS_POINTS
