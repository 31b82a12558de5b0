"""Polynomials of a low degree in substeps that act like one of a higher degree over the whole step.

For models that take input derivatives, but not of all orders. As in ``inputs.py``, what
counts are the moments of what is held in place of the polynomial u. N pieces of degree m have
N (m + 1) coefficients, so as many moments can be right; here the first k + 1 are, for u of degree
k, if there are so many. So lines need half as many substeps as constants. Among all pieces with
these moments those next to u are taken, in the mean square. Where outputs belong to the inputs at
the end of the step, the last piece meets u there.

What is missed of the square of an input is the mean square of the distance, which is
(u'' H^2 / N^2)^2 / 720 for lines.
"""

from __future__ import annotations

from functools import lru_cache
from math import ceil, sqrt

import numpy as np
from numpy.polynomial.legendre import leggauss, legval

from protocol.signals import FloatArray
from slave_node.substeps.inputs import MAX_SUBSTEPS

_GAUSS_POINTS = 4
_OF_SQUARE = 720.0


def piece_polynomials(
    rows: FloatArray, lengths: tuple[float, ...], degree: int, *, meets_end: bool
) -> FloatArray:
    """One polynomial for each substep.

    Args:
        rows: of the polynomial over the whole step, `substep_inputs.scaled`, shape (k + 1, n).
        lengths: of the N substeps in units of H; their sum is 1.
        degree: m of the pieces, 1 or 2.
        meets_end: the last one has the value u(T + H) at its end.

    Returns:
        Values and derivatives at the beginning of each substep, shape (N, m + 1, n), with H as the
        unit of time.
    """
    weights = piece_weights(lengths, len(rows), degree, meets_end=meets_end)
    pieces: FloatArray = np.einsum("ijk,kn->ijn", weights, rows)
    return pieces


@lru_cache(maxsize=256)
def piece_weights(
    lengths: tuple[float, ...], rows: int, degree: int, *, meets_end: bool
) -> FloatArray:
    """The pieces are these weights times H^j / j! u^(j): shape (N, m + 1, rows).

    With c the coefficients in Legendre polynomials on each piece, G the inverse of their Gram
    matrix, and C c = d the conditions (moments of the whole, value at the end): c = p + G C^T
    (C G C^T)^-1 (d - C p), where p is the projection of u on each piece.
    """
    number, terms = len(lengths), degree + 1
    edges = np.concatenate([[0.0], np.cumsum(lengths)])
    moments = min(number * terms - meets_end, rows)
    points, gauss = leggauss(_GAUSS_POINTS)
    local = np.stack([legval(points, _unit(i)) for i in range(terms)])
    inverse = np.empty(number * terms)
    projection = np.empty((number * terms, rows))
    conditions = np.zeros((moments + meets_end, number * terms))
    wanted = np.zeros((moments + meets_end, rows))
    for n, (begin, width) in enumerate(zip(edges, lengths, strict=False)):
        own = slice(n * terms, (n + 1) * terms)
        sigma = begin + 0.5 * width * (points + 1.0)
        weight = 0.5 * width * gauss
        powers = np.stack([sigma**j for j in range(rows)], axis=1)
        whole = np.stack([legval(2.0 * sigma - 1.0, _unit(q)) for q in range(moments)])
        inverse[own] = (2.0 * np.arange(terms) + 1.0) / width
        projection[own] = inverse[own, np.newaxis] * ((weight * local) @ powers)
        conditions[:moments, own] = (weight * whole) @ local.T
        wanted[:moments] += (weight * whole) @ powers
    if meets_end:
        conditions[-1, -terms:] = wanted[-1] = 1.0
    reach = inverse[:, np.newaxis] * conditions.T
    missing = wanted - conditions @ projection
    found = projection + reach @ np.linalg.solve(conditions @ reach, missing)
    to_derivatives = np.stack([_derivatives(terms, width) for width in lengths])
    weights: FloatArray = to_derivatives @ found.reshape(number, terms, rows)
    weights.setflags(write=False)
    return weights


def _derivatives(terms: int, width: float) -> FloatArray:
    """From coefficients of Legendre polynomials on a piece to derivatives at its beginning."""
    per_unit = 2.0 / width
    rows = np.array([[1.0, -1.0, 1.0], [0.0, 1.0, -3.0], [0.0, 0.0, 3.0]])[:terms, :terms]
    derivatives: FloatArray = rows * per_unit ** np.arange(terms)[:, np.newaxis]
    return derivatives


def _unit(degree: int) -> list[float]:
    return [0.0] * degree + [1.0]


def pieces_needed(
    rows: FloatArray, degree: int, nominal: FloatArray, tolerance: float, *, meets_end: bool
) -> int:
    """Number of equal pieces that an accuracy needs, from 1 to `MAX_SUBSTEPS`.

    So many that all k + 1 moments can be right. And let r be the relative change of an input in the
    step, and r_2 that part of it which is not along a line; a slave whose f depends on u as a
    square does is wrong by r r_2^2 / (720 N^4) of its size, see ``inputs.py``.

    Args:
        rows: of the polynomial, `substep_inputs.scaled`, shape (k + 1, n), k > m.
        degree: m of the pieces.
        nominal: typical sizes of the inputs, shape (n,), unit [u].
        tolerance: relative, that of the slave's own solver.
        meets_end: the last one is to meet u(T + H).
    """
    least = ceil((len(rows) + meets_end) / (degree + 1))
    if not nominal.size:
        return least
    sizes = np.abs(rows)
    typical = np.maximum(sizes[0], nominal)
    change = float((sizes[1:].sum(axis=0) / typical).max())
    bend = float((sizes[2:].sum(axis=0) / typical).max())
    if not change < np.inf:  # the step fails anyway
        return least
    needed = sqrt(sqrt(change * bend * bend / (_OF_SQUARE * tolerance)))
    return max(least, ceil(min(needed, MAX_SUBSTEPS)))
