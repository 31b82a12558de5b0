"""``order = "auto"`` against every input polynomial that does not change."""

from __future__ import annotations

from functools import cache

import numpy as np

from benchmarks.reproduction.beyond_text import commands, paragraphs, power, table, verdict
from benchmarks.reproduction.measured_runs import SMOOTH, TOLERANCES, Run, run
from master_node.numerics.extrapolation import POLYNOMIALS, InputPolynomial

FIXED = tuple(polynomial for polynomial in POLYNOMIALS if polynomial.order > 0)
WORST = 1.10
"""Ratio to the best fixed polynomial that is wanted at most."""
AROUND = (0.8, 0.9, 1.0, 1.1, 1.25)
"""Factors of a tolerance, to see how the ratio scatters."""
NEAR = 1.25
"""Polynomials that need up to so many times the do_steps of the best are tried without a past."""


def section() -> str:
    """do_steps of all, ratio to the best, and how often the polynomial changed."""
    rows, ratios, hard_ratios = [], {}, {}
    for name in SMOOTH:
        for tolerance in TOLERANCES:
            best = _best(name, tolerance)
            auto = run(name, tolerance)
            ratios[name, tolerance] = auto.do_steps / best
            hard_ratios[name, tolerance] = auto.do_steps / _best_without_past(name, tolerance)
            fixed = [_do_steps(name, tolerance, polynomial) for polynomial in FIXED]
            rows.append(
                (
                    name,
                    power(tolerance),
                    *(f"**{number}**" if number == best else number for number in fixed),
                    auto.do_steps,
                    f"{ratios[name, tolerance]:.3f}",
                    f"{hard_ratios[name, tolerance]:.3f}",
                    _changes(auto),
                )
            )
    return paragraphs(
        "## 2. Order control",
        "do_steps of each slave with the input polynomial chosen for each step, `auto`, and with "
        "each one that is the same in all steps. k is the degree; one prime means that the newest "
        "point counts with its derivative, two that the two newest points do. The best of the "
        "fixed ones is bold, the ratio is `auto` to that one, and the last column counts how often "
        "`auto` changed the polynomial.",
        table(
            (
                "system",
                "tolerance",
                *map(str, FIXED),
                "auto",
                "ratio",
                "ratio, `none`",
                "changes",
            ),
            rows,
        ),
        f"{_worst('ratio', ratios)} Wanted: at most {WORST:.2f} everywhere: "
        f"{verdict(reached=max(ratios.values()) <= WORST)}. The geometric mean of all is "
        f"{np.exp(np.mean(np.log(list(ratios.values())))):.3f}.",
        'A fixed order begins with `initial_history = "rest"`, with full degree from the first '
        "step. That is right for a car that rested, and `auto` cannot know it: it begins with what "
        "one communication point says. In the column *ratio, `none`* the fixed polynomials begin "
        "either way, whichever is better. "
        f"{_worst('ratio', hard_ratios)}",
        _scatter(*max(ratios, key=ratios.__getitem__)),
        commands(
            "master-node run examples/oscillators/two_mass.toml --in-process --output results",
            "master-node run examples/oscillators/two_mass.toml --in-process --order 3 "
            "--derivative-points 2 --output results",
        ),
        "**When to use which.** `auto` unless you know better: no fixed polynomial is good for all "
        "tolerances, and the wrong one can cost ten times as much. Give an `order` to repeat "
        "somebody's numbers, or for comparisons in which all steps should be of one kind.",
    )


def _do_steps(name: str, tolerance: float, polynomial: InputPolynomial, **more: str) -> int:
    return run(
        name,
        tolerance,
        order=polynomial.order,
        derivative_points=polynomial.derivative_points,
        **more,
    ).do_steps


@cache
def _best(name: str, tolerance: float) -> int:
    return min(_do_steps(name, tolerance, polynomial) for polynomial in FIXED)


def _best_without_past(name: str, tolerance: float) -> int:
    """With either initial history, of the polynomials that have a chance."""
    best = _best(name, tolerance)
    near = [p for p in FIXED if _do_steps(name, tolerance, p) <= NEAR * best]
    return min(best, *(_do_steps(name, tolerance, p, initial_history="none") for p in near))


def _scatter(name: str, tolerance: float) -> str:
    """The ratios at tolerances around one."""
    ratios = {
        factor: run(name, factor * tolerance).do_steps / _best(name, factor * tolerance)
        for factor in AROUND
    }
    listed = ", ".join(f"{ratio:.2f} at {f:g} times" for f, ratio in ratios.items())
    return (
        "How many do_steps there are is no smooth function of the tolerance, and so the ratio "
        f"scatters. Around the largest one, {name} at {power(tolerance)}: {listed} the tolerance."
    )


def _changes(auto: Run) -> int:
    steps = auto.result.steps
    polynomials = steps[["order", "derivative_points"]][steps["accepted"]]
    return int(np.count_nonzero(polynomials[1:] != polynomials[:-1]))


def _worst(what: str, ratios: dict[tuple[str, float], float]) -> str:
    (name, tolerance), ratio = max(ratios.items(), key=lambda item: item[1])
    return f"The largest {what} is {ratio:.3f}, of {name} at {power(tolerance)}."
