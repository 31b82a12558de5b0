"""The step size controllers, and the slaves' rules for step sizes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.reproduction.beyond_text import (
    block,
    both,
    commands,
    paragraphs,
    power,
    short,
    table,
)
from benchmarks.reproduction.measured_runs import (
    QUARTER_CAR,
    SMOOTH,
    load,
    run,
    run_variant,
    varied,
)

ORDERS = (1, 2, 3, "auto")
TOLERANCES = (1e-4, 1e-6)

RULES: dict[str, Mapping[str, Mapping[str, Any]]] = {
    "none": {},
    "`wheel`: `step_multiple = 1e-3`": {"wheel": {"step_multiple": 1e-3}},
    "`wheel`: `step_multiple = 1e-3`, `chassis`: `step_multiple = 4e-4`": {
        "wheel": {"step_multiple": 1e-3},
        "chassis": {"step_multiple": 4e-4},
    },
    "`wheel`: `largest_step_size = 0.02`": {"wheel": {"largest_step_size": 0.02}},
    "`wheel`: `largest_step_size = 0.01`": {"wheel": {"largest_step_size": 0.01}},
}
"""Settings of the slaves, by how they are shown."""

RULES_TOLERANCE = 1e-3


def section() -> str:
    """Both controllers with all orders, and what rules for H cost."""
    return paragraphs(
        "## 5. Controllers and rules for H",
        "The elementary controller of the paper against the PI controller, which looks at how ERR "
        "changes and does not let H grow right after a rejection. Each cell is elementary / PI. "
        "Fixed orders are without derivatives.",
        table(
            ("system", "tolerance", "order", "steps", "rejections", "do_steps", "mean error"),
            [
                _controllers(name, tolerance, order)
                for name in SMOOTH
                for tolerance in TOLERANCES
                for order in ORDERS
            ],
        ),
        _totals(),
        commands(
            "master-node run examples/oscillators/two_mass.toml --in-process --order 2 "
            "--controller elementary --output results",
        ),
        "**When to use which.** PI, the default, wherever a rejection is expensive: where saving "
        "and restoring a state takes long, or where a model logs each step. `elementary` for the "
        "paper's numbers.",
        "A slave may have rules for its own steps: a smallest or a largest size, multiples of the "
        "step of its own solver, or a single size. Then H is rounded down so that all slaves' "
        "rules are kept, also in the last steps. The quarter car at "
        f"{power(RULES_TOLERANCE)}, H_0 chosen by the program (multiples of 1 ms and of 0.4 ms are "
        "multiples of 2 ms):",
        table(
            ("rules", "steps", "rejections", "do_steps", "mean error", "smallest H", "largest H"),
            [_rules(shown, slaves) for shown, slaves in RULES.items()],
        ),
        "The smallest H that the rules allow must be small enough for the tolerance. "
        "At 1e-6 the start of the quarter car needs H below 1 ms. With multiples of 1 ms the run "
        "ends there, with an error that says so.",
        block(
            "toml",
            "[slaves.wheel]",
            'model = "wheel.fmu"',
            "parameters = { z = 0.1 }",
            "step_multiple = 1e-3",
        ),
        "**When to use it.** `step_multiple` for models with a fixed internal step: between its "
        "points they hold or repeat values, and the estimate sees that as an error. "
        "`largest_step_size` for models that become unstable, or miss something, in longer steps.",
    )


def _controllers(name: str, tolerance: float, order: int | str) -> tuple[str, ...]:
    runs = [run(name, tolerance, order=order, controller=c) for c in ("elementary", "pi")]
    return (
        name,
        power(tolerance),
        str(order),
        *both(
            [one.steps for one in runs],
            [one.rejections for one in runs],
            [one.do_steps for one in runs],
            [short(one.mean_error) for one in runs],
        ),
    )


def _totals() -> str:
    sums = {}
    for controller in ("elementary", "pi"):
        runs = [
            run(name, tolerance, order=order, controller=controller)
            for name in SMOOTH
            for tolerance in TOLERANCES
            for order in ORDERS
        ]
        sums[controller] = sum(r.rejections for r in runs), sum(r.do_steps for r in runs)
    (rejections, do_steps), (fewer, work) = sums["elementary"], sums["pi"]
    return (
        f"Over the whole table the PI controller rejects {fewer} double steps instead of "
        f"{rejections}, and takes {abs(work / do_steps - 1):.1%} "
        f"{'fewer' if work < do_steps else 'more'} do_steps."
    )


def _rules(shown: str, slaves: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    system = varied(load(QUARTER_CAR), slaves, without=["initial_step_size"])
    one = run_variant(
        QUARTER_CAR,
        system,
        relative_tolerance=RULES_TOLERANCE,
        absolute_tolerance=RULES_TOLERANCE,
    )
    summary = one.result.summary
    return (
        shown,
        str(one.steps),
        str(one.rejections),
        str(one.do_steps),
        short(one.mean_error),
        f"{1e3 * summary['smallest_step_size']:.3g} ms",
        f"{1e3 * summary['largest_step_size']:.3g} ms",
    )
