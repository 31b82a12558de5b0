"""Tolerance proportionality: the error over the tolerance, over four decades of tolerances."""

from __future__ import annotations

from math import log, sqrt

import numpy as np

from benchmarks.reproduction.beyond_text import commands, paragraphs, power, table, verdict
from benchmarks.reproduction.measured_runs import SMOOTH, TOLERANCES, run

WITHIN = 5.0
"""Factor within which the error is wanted to be proportional to the tolerance."""


def section() -> str:
    """Error over tolerance for all systems, and how far from constant it is."""
    rows, factors, spreads = [], {}, {}
    for name in SMOOTH:
        ratios = [run(name, tolerance).mean_error / tolerance for tolerance in TOLERANCES]
        spreads[name] = max(ratios) / min(ratios)
        factors[name] = sqrt(spreads[name])
        slope = 1.0 + np.polyfit([log(t) for t in TOLERANCES], np.log(ratios), 1)[0]
        rows.append(
            (
                name,
                *(f"{ratio:.1f}" for ratio in ratios),
                f"{spreads[name]:.2f}",
                f"{factors[name]:.2f}",
                f"{slope:.2f}",
            )
        )
    beyond = [name for name, spread in spreads.items() if spread > WITHIN]
    strict = (
        f"Were it asked that the largest ratio is at most {WITHIN:g} times the smallest one, "
        f"{', '.join(beyond)} would not reach it."
        if beyond
        else f"Largest over smallest is at most {WITHIN:g} too."
    )
    return paragraphs(
        "## 4. The error follows the tolerance",
        "Mean error divided by the tolerance, default settings. The *factor* is the smallest one "
        "for which there is a c such that c tolerance / factor <= error <= factor c tolerance. The "
        "*exponent* is the slope of the error over the tolerance, both logarithmic; 1 is "
        "proportional.",
        table(
            (
                "system",
                *map(power, TOLERANCES),
                "largest / smallest",
                "factor",
                "exponent",
            ),
            rows,
        ),
        f"Wanted: a factor of at most {WITHIN:g}: "
        f"{verdict(reached=max(factors.values()) <= WITHIN)}. {strict}",
        "The error control bounds what one double step adds (error per step). As H becomes smaller "
        "the steps become more, and in a motion that is hardly damped, as in the chain, what they "
        "add piles up: with degree k = 3 the global error goes like the tolerance to the power "
        "(k + 1) / (k + 2) = 0.8. A motion that is drawn back to where it belongs, by damping or "
        "to a limit cycle, forgets most of them, and its exponent is nearer to 1.",
        commands(
            "master-node run examples/oscillators/chain.toml --in-process "
            "--relative-tolerance 1e-6 --absolute-tolerance 1e-6 --output results",
        ),
        "**How to use it.** The tolerance is a bound for each double step and not for the global "
        "error. Run once more with a tolerance ten times smaller: `master-node compare` of both "
        "then shows the error of the first run.",
    )
