"""The default settings beside the paper's method on the paper's benchmark."""

from __future__ import annotations

from benchmarks.reproduction.beyond_text import commands, paragraphs, power, short, table, verdict
from benchmarks.reproduction.measured_runs import QUARTER_CAR, run

WANTED = {1e-4: (150, 3.2e-4), 1e-6: (350, None)}
"""By the tolerance: accepted steps and mean error that are wanted at most."""


def section() -> str:
    """Steps, rejections and errors of both, and whether what is wanted was reached."""
    rows, sentences = [], []
    for tolerance, (most_steps, most_error) in WANTED.items():
        ours = run(QUARTER_CAR, tolerance)
        runs = {
            '`preset = "paper"`, k = 2': run(QUARTER_CAR, tolerance, preset="paper", order=2),
            "default": ours,
            "default, `derivative_points = 0`": run(QUARTER_CAR, tolerance, derivative_points=0),
        }
        rows += [
            (
                power(tolerance),
                name,
                one.steps,
                one.rejections,
                one.do_steps,
                short(one.mean_error),
                short(one.largest_error),
            )
            for name, one in runs.items()
        ]
        wanted = f"at most {most_steps} steps"
        reached = ours.steps <= most_steps
        if most_error is not None:
            wanted += f" with a mean error of at most {short(most_error)}"
            reached &= ours.mean_error <= most_error
        sentences.append(f"Wanted at {power(tolerance)}: {wanted}: {verdict(reached=reached)}.")
    return paragraphs(
        "## 1. The default against the paper",
        "The paper's benchmark, displacement-displacement coupling. With the default settings each "
        "input polynomial meets the derivatives of the outputs at the newest points as well, its "
        "degree is chosen for each step, the constants of EST_mod are those of the nodes that "
        "there are, and a PI controller chooses H. The last row of each tolerance is for slaves of "
        "which only values are known.",
        table(
            (
                "tolerance",
                "settings",
                "steps",
                "rejections",
                "do_steps",
                "mean error",
                "largest error",
            ),
            rows,
        ),
        " ".join(sentences),
        commands(
            "master-node run examples/quarter_car/displacement.toml --in-process --output results",
            "master-node run examples/quarter_car/displacement.toml --in-process --preset paper "
            "--order 2 --output results",
        ),
        "**When to use which.** Keep the default. The paper's method is there to be compared "
        "with. A slave without output derivatives needs no setting: its outputs are extrapolated "
        "by their values.",
    )
