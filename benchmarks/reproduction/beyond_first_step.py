"""The initial step size that the program chooses."""

from __future__ import annotations

import numpy as np

from benchmarks.reproduction.beyond_text import commands, paragraphs, power, short, table
from benchmarks.reproduction.measured_runs import SYSTEMS, TOLERANCES, load, run_variant, varied

FIRST = 5
"""Attempts that count as the start."""

NOTICEABLE = 0.1
"""ERR from which on the tolerance bounds H, and not how fast H may grow."""


def section() -> str:
    """H_0, the first H accepted, early rejections, and how long H took to grow."""
    rows = [_row(name, tolerance) for name in SYSTEMS for tolerance in TOLERANCES]
    return paragraphs(
        "## 10. The first step",
        "Without `initial_step_size` the program tries one very short double step, takes it back, "
        "and chooses H_0 from how the outputs have moved. *H accepted* is the step size of the "
        f"first double step that was accepted, *rejections* those among the first {FIRST} "
        "attempts. *ERR* is that of the first attempt, and *attempts* how many it "
        f"took until ERR came to {NOTICEABLE:g} for the first time.",
        table(
            ("system", "tolerance", "H_0 [s]", "ERR", "H accepted [s]", "rejections", "attempts"),
            rows,
        ),
        "H_0 is meant to be too small rather than too large: H doubles with each double step, and "
        "a few of them cost less than one that goes wrong. `quarter car, force` begins with very "
        "short steps and has to shorten them at the smallest tolerances: the force grows with the "
        "wheel's first motion, of which it has no derivative to tell, so its first polynomial is a "
        "constant. `kick` rests at first: there is nothing to choose by, and H_0 is taken from the "
        "simulated time; its first ERR that counts is that of the jump.",
        commands(
            "master-node run examples/oscillators/chain.toml --in-process --output results",
            "master-node run examples/oscillators/chain.toml --in-process --step-size 0.01 "
            "--output results",
        ),
        "**When to use which.** Leave it out. Give `initial_step_size` where the trial step must "
        "not happen, to repeat somebody's numbers, or where you know H_0 from an earlier run: that "
        "saves three do_steps and the attempts of the last column.",
    )


def _row(name: str, tolerance: float) -> tuple[object, ...]:
    system = varied(load(name), {}, without=["initial_step_size"])
    one = run_variant(name, system, relative_tolerance=tolerance, absolute_tolerance=tolerance)
    steps = one.result.steps
    noticeable = steps["error_norm"] >= NOTICEABLE
    return (
        name,
        power(tolerance),
        short(steps["step_size"][0]),
        short(steps["error_norm"][0]) if steps["error_norm"][0] else "0",
        short(steps["step_size"][steps["accepted"]][0]),
        int(np.count_nonzero(~steps["accepted"][:FIRST])),
        int(np.argmax(noticeable)) + 1,
    )
