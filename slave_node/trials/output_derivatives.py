"""Derivatives of outputs, compared with differences of the values.

Two steps of equal size h give the values y_1 and y_2 and the derivatives d_1 and d_2. For a true
derivative (d_1 + d_2) / 2 is the difference (y_2 - y_1) / h but for a part of order h^2, so that
some h small enough tells. What is not finite at any point, or far from the difference at all h, is
no derivative. Neither is the difference itself, which some tools give: it is off by h y'' / 2, so
that polynomials which meet it have order 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.signals import FloatArray
from slave_node.trials.steps import Reading, Trial, TrialError

_LARGER = 8.0
"""From one h to the next."""

_FAR, _NEAR = 0.9, 0.5
"""Parts of the larger one by which a derivative and a difference differ that have nothing to do
with each other (a factor of ten, or another sign), and that agree."""

_SEEN = 0.1
"""Part of the tolerance: where neither derivative nor difference would change an output by more in
h, nothing is said."""

_SAME = 1e-3
"""Part of the change of a derivative over h: it is the difference if it is nearer to it than this.
A true derivative is off by half of the change."""

_ROUNDING = 1e-9


class Pair(NamedTuple):
    """Two steps of equal size.

    Attributes:
        size: of each [s].
        first, second: outputs behind them.
    """

    size: float
    first: Reading
    second: Reading


def poor_derivatives(trial: Trial, pair_of: Callable[[float], Pair]) -> dict[str, str]:
    """The outputs whose derivatives cannot be used, with the reason.

    Args:
        trial: of the slave.
        pair_of: takes two steps of a size [s]; raises `TrialError`.
    """
    pairs: list[Pair] = []
    for size in trial.sizes(_LARGER, 0.25 * trial.largest_step):
        before = trial.time_left
        with suppress(TrialError):  # a step that is too short, or too long, for the model
            pairs.append(pair_of(size))
        if pairs and judge(pairs, trial.scale).settled.all():
            break
        if trial.time_left < _LARGER * (before - trial.time_left):
            break
    if not pairs:
        return {}
    verdict = judge(pairs, trial.scale)
    found: dict[str, str] = {}
    for is_so, reason in (
        (verdict.not_finite, "not finite"),
        (verdict.far, "nowhere near the change of the output"),
        (verdict.differences, "differences over the last step"),
    ):
        found |= dict.fromkeys(trial.names(is_so), reason)
    return found


class Verdict(NamedTuple):
    """Verdicts on each output, shape (n,).

    Attributes:
        not_finite: its derivative is finite nowhere.
        far: it has nothing to do with the differences.
        differences: it is the difference over the last step.
        settled: nothing more will be learnt of it.
    """

    not_finite: NDArray[np.bool_]
    far: NDArray[np.bool_]
    differences: NDArray[np.bool_]
    settled: NDArray[np.bool_]


def judge(pairs: Sequence[Pair], scale: Callable[[FloatArray, FloatArray], FloatArray]) -> Verdict:
    """Verdict of some pairs of steps together.

    Args:
        pairs: at least one.
        scale: tolerances of outputs from their values in two readings.
    """
    n = len(pairs[0].first.values)
    is_finite, agrees, differs, follows, leads = (np.zeros(n, dtype=bool) for _ in range(5))
    for size, first, second in pairs:
        slopes = np.array((first.slopes, second.slopes))
        known = np.isfinite(slopes).all(axis=0)
        is_finite |= np.isfinite(slopes).any(axis=0)
        d1, d2 = np.where(known, slopes, 0.0)
        difference = (second.values - first.values) / size
        mean = 0.5 * (d1 + d2)
        larger = np.maximum(np.abs(mean), np.abs(difference))
        is_seen = known & (larger * size > _SEEN * scale(first.values, second.values))
        apart = np.abs(mean - difference)
        agrees |= is_seen & (apart <= _NEAR * larger)
        differs |= is_seen & (apart > _FAR * larger)
        change = np.abs(d2 - d1)
        is_curved = known & (change > _ROUNDING * np.maximum(np.abs(d1), np.abs(d2)))
        is_same = np.abs(d2 - difference) <= _SAME * change
        follows |= is_curved & is_same
        leads |= is_curved & is_seen & ~is_same
    return Verdict(
        not_finite=~is_finite,
        far=differs & ~agrees,
        differences=follows & ~leads,
        settled=agrees & (follows | leads),
    )
