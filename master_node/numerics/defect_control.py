"""The step size where no step can be taken back, from the defects of the inputs.

The defect of an input polynomial at a later communication point is u^(q+1) / (q+1)! w, with the
product w of the distances to its nodes (see ``error_estimators``). The first factor is a divided
difference of inputs that are known, so the defect of the next step follows from its H before the
step is taken, on any grid. H is chosen such that it has a distance from the tolerance: a step that
turns out worse than foreseen has been taken all the same.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import numpy as np

from master_node.numerics.error_estimators import node_polynomial
from master_node.numerics.extrapolation import CouplingHistory, Extrapolation, Nodes, Polynomials
from protocol.signals import FloatArray

TARGET = 0.5
"""Norm of the defects that steps are made for; 1 is the tolerance."""

_BISECTIONS = 16
_PARTS = 8


def largest_between(nodes: Nodes, begin: float, end: float) -> float:
    """The largest |w| from ``begin`` to ``end``, to about 1 % (nine points are looked at)."""
    part = (end - begin) / _PARTS
    return max(abs(node_polynomial(nodes, begin + i * part)) for i in range(_PARTS + 1))


def defect_coefficients(
    extrapolation: Extrapolation, history: CouplingHistory, polynomials: Polynomials
) -> FloatArray | None:
    """|u^(q+1) / (q+1)!| of each input, shape (n,), unit [u]/s^(q+1); None: not known.

    The larger one of those at the two newest points: single ones pass through zero.

    Args:
        extrapolation: how the polynomials are made.
        history: up to T_n, with one more point than the polynomials go through.
        polynomials: of each kind.
    """
    needed = max(polynomial.points for polynomial in polynomials)
    coefficients: FloatArray | None = None
    for newest in range(min(2, len(history.times) - needed)):
        past = history.before(newest + 1)
        if extrapolation.known(polynomials, past) != polynomials:
            continue
        span = history.times[newest] - past.times[0]
        foreseen = extrapolation.signal(past, polynomials).at(span)
        nodes = extrapolation.nodes(past.times, polynomials, past.times[0])
        products = np.array([node_polynomial(offsets, span) for offsets in nodes])
        found = np.abs(history.inputs[newest][0] - foreseen)
        found /= products[extrapolation.kind_of_input]
        coefficients = found if coefficients is None else np.maximum(coefficients, found)
    return coefficients


def foreseen_step_size(norm: Callable[[float], float], smallest: float, largest: float) -> float:
    """H for the next step [s]: the largest for which the norm foreseen is not above `TARGET`.

    Args:
        norm: of the defects in a step of H [s]; does not fall with H.
        smallest: bound of H [s]; taken where no H is small enough, or the norm is NaN.
        largest: bound of H [s].
    """
    if norm(largest) <= TARGET:
        return largest
    if not norm(smallest) <= TARGET:
        return smallest
    low, high = smallest, largest
    for _ in range(_BISECTIONS):
        between = sqrt(low * high)
        if norm(between) <= TARGET:
            low = between
        else:
            high = between
    return low
