"""Values of parameters for the runs of a study."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.signals import FloatArray


def spaced(begin: float, end: float, number: int, *, logarithmic: bool = False) -> FloatArray:
    """Values from ``begin`` to ``end``, both included, at equal distances or ratios.

    Args:
        begin: the first; with ``logarithmic`` positive.
        end: the last; likewise.
        number: 2 or more.
        logarithmic: neighbours have equal ratios.

    Returns:
        Shape (number,); the first and the last are ``begin`` and ``end`` bit for bit.
    """
    values = _between(np.linspace(0.0, 1.0, number), begin, end, logarithmic=logarithmic)
    values[0], values[-1] = begin, end
    return values


def latin_hypercube(
    number: int,
    seed: int,
    begin: FloatArray,
    end: FloatArray,
    logarithmic: NDArray[np.bool_],
) -> FloatArray:
    """A Latin hypercube sample: each of ``number`` equal parts of each range has one value.

    McKay, Beckman, Conover: A comparison of three methods for selecting values of input variables
    in the analysis of output from a computer code, Technometrics 21 (1979).

    Args:
        number: of samples.
        seed: equal seeds give equal samples.
        begin: of the ranges, shape (d,).
        end: of the ranges, shape (d,).
        logarithmic: whether a range is divided into parts of equal ratios, shape (d,).

    Returns:
        Shape (number, d).
    """
    from scipy.stats.qmc import LatinHypercube  # noqa: PLC0415  slow, and grids do without it

    sampler = LatinHypercube(len(begin), rng=np.random.default_rng(seed))
    unit: FloatArray = sampler.random(number)
    columns = [
        _between(unit[:, j], begin[j], end[j], logarithmic=bool(logarithmic[j]))
        for j in range(len(begin))
    ]
    return np.column_stack(columns)


def _between(unit: FloatArray, begin: float, end: float, *, logarithmic: bool) -> FloatArray:
    if logarithmic:
        values: FloatArray = np.exp((1.0 - unit) * np.log(begin) + unit * np.log(end))
    else:
        values = (1.0 - unit) * begin + unit * end
    return np.clip(values, min(begin, end), max(begin, end))
