"""Estimates and the true local error: along the motion, over H, after H has changed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.quarter_car import EXAMPLE
from benchmarks.reproduction.exact_quarter_car import FloatArray
from benchmarks.reproduction.local_errors import ExactStarts, LocalError, exact_starts
from master_node import load_system
from master_node.numerics.extrapolation import POLYNOMIALS, InputPolynomial

ESTIMATORS = ("rich", "mod")

# --- Figures 2 and 3 ------------------------------------------------------------------------------

STEP_SIZE = 1e-3
"""H of the constant steps in Table 1 [s]."""

TIMES: FloatArray = np.linspace(0.02, 3.98, 100)
"""Starting points along the motion [s]."""

TIME = 0.1
"""Starting point of the double steps of different H [s]: in the transient phase."""

STEP_SIZES = np.geomspace(1e-4, 1e-2, 9)


class Curve(NamedTuple):
    """Sizes of local errors and of their estimates with the paper's constants, shape (n,) each.

    Attributes:
        true: of the two small steps.
        rich, mod: EST_Rich and EST_mod.
    """

    true: FloatArray
    rich: FloatArray
    mod: FloatArray


class LocalErrorFigure(NamedTuple):
    """One of the Figures 2 and 3: for k = 0 and 1 the curves over `TIMES` and `STEP_SIZES`."""

    over_time: dict[int, Curve]
    over_step_size: dict[int, Curve]


def figure(file: str) -> LocalErrorFigure:
    """The curves of one coupling: of all outputs, or of the force where there is one."""
    with exact_starts(load_system(EXAMPLE / file)) as starts:
        times = [(time, STEP_SIZE) for time in TIMES.tolist()]
        sizes = [(TIME, step_size) for step_size in STEP_SIZES.tolist()]
        return LocalErrorFigure(
            {order: _curve(starts, order, times) for order in (0, 1)},
            {order: _curve(starts, order, sizes) for order in (0, 1)},
        )


def _curve(starts: ExactStarts, order: int, points: list[tuple[float, float]]) -> Curve:
    shown = _shown(starts)
    rows = []
    for time, step_size in points:
        rich, mod = (
            starts.local_error(time, step_size, InputPolynomial(order), estimator)
            for estimator in ESTIMATORS
        )
        vectors = (rich.true, rich.paper, mod.paper)
        rows.append([np.linalg.norm(vector[shown]) for vector in vectors])
    return Curve(*np.array(rows).T)


def _shown(starts: ExactStarts) -> NDArray[np.intp]:
    """The outputs to look at: those with feed-through, if any, else all."""
    force = [i for i, name in enumerate(starts.names) if name.endswith(".F")]
    return np.array(force or range(len(starts.names)), dtype=np.intp)


def largest_difference(one: LocalErrorFigure, other: LocalErrorFigure) -> float:
    """Between the true errors of two kinds of slaves, relative."""
    pairs = [(a[order].true, b[order].true) for a, b in zip(one, other, strict=True) for order in a]
    return max(float(np.max(np.abs(x - y) / x)) for x, y in pairs)


# --- Where the paper's constants stop -------------------------------------------------------------

FACTORS = (0.3, 1.0, 2.0)
"""H over the spacing of the communication points before T_n."""

LADDER = (4e-3, 2e-3, 1e-3, 0.5e-3, 0.25e-3)
"""H [s]."""

STARTS: FloatArray = np.linspace(0.1, 0.2, 9)
"""A tenth of a second, in which the wheel swings once [s]: no term vanishes at all of them."""

VALUES_ONLY = tuple(p for p in POLYNOMIALS if not p.derivative_points)


class Quotients(NamedTuple):
    """Estimate over true local error for each H of `LADDER`, shape (5,).

    It is the factor before the true error in the estimate's part along it, over all `STARTS`:
    1 when the estimate is right, negative when it has the wrong sign.
    """

    paper: FloatArray
    exact: FloatArray


Study = dict[tuple[InputPolynomial, str, float], Quotients]
"""By polynomial, estimator and factor."""


def study(file: str, polynomials: tuple[InputPolynomial, ...]) -> Study:
    """The quotients of one coupling."""
    with exact_starts(load_system(EXAMPLE / file)) as starts:
        return {
            (polynomial, estimator, factor): _quotients(starts, polynomial, estimator, factor)
            for polynomial in polynomials
            for estimator in ESTIMATORS
            for factor in FACTORS
        }


def _quotients(
    starts: ExactStarts, polynomial: InputPolynomial, estimator: str, factor: float
) -> Quotients:
    shown = _shown(starts)
    rows = []
    for step_size in LADDER:
        errors = [
            starts.local_error(time, step_size, polynomial, estimator, step_size / factor)
            for time in STARTS.tolist()
        ]
        true, paper, exact = (
            np.concatenate([getattr(error, name)[shown] for error in errors])
            for name in LocalError._fields
        )
        rows.append([paper @ true / (true @ true), exact @ true / (true @ true)])
    return Quotients(*np.array(rows).T)


def worst_deviation(results: Study, polynomial: InputPolynomial, estimator: str) -> FloatArray:
    """|quotient - 1| with exact constants, the largest of all `FACTORS`, shape (5,)."""
    quotients = [results[polynomial, estimator, factor].exact for factor in FACTORS]
    return np.asarray(np.max(np.abs(np.array(quotients) - 1.0), axis=0))
