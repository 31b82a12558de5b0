"""Discontinuities: found, declared, or ignored."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.reproduction.beyond_text import commands, paragraphs, power, short, table
from benchmarks.reproduction.measured_runs import KICK, SMOOTH, TOLERANCES, Run, load, run

JUMP = 1.0
"""When source.y of the kick jumps [s]."""

TREATMENTS: dict[str, dict[str, Any]] = {
    "found (default)": {},
    "declared: `events = [1.0]`": {"events": (JUMP,)},
    "ignored: `discontinuities = false`": {"discontinuities": False},
}

VARIANTS: dict[str, dict[str, Any]] = {
    "auto, EST_mod": {},
    "auto, EST_Rich": {"estimator": "rich"},
    "k = 2, EST_mod": {"order": 2},
    "k = 2, EST_Rich": {"order": 2, "estimator": "rich"},
}


def section() -> str:
    """All treatments with all variants at two tolerances."""
    rows = [
        _row(tolerance, variant, treatment)
        for tolerance in (1e-4, 1e-6)
        for variant in VARIANTS
        for treatment in TREATMENTS
    ]
    smallest = load(KICK).simulation.smallest
    return paragraphs(
        "## 6. Discontinuities",
        f"`kick.toml`: everything rests until an input jumps at t = {JUMP:g} s. *Late* is the time "
        "from the jump to the first communication point that is not before it: until then the "
        "slaves know nothing of it. *Crossed in* is the double step that was accepted as the one "
        "with the jump, by its beginning and its length in seconds. *At the jump* counts the "
        "double steps spent on finding it and on crossing it. The error is that of displacements "
        "and velocities.",
        table(
            (
                "tolerance",
                "variant",
                "the jump is",
                "steps",
                "rejections",
                "at the jump",
                "crossed in",
                "late [s]",
                "mean error",
                "largest error",
            ),
            rows,
        ),
        "Ignored, the jump is stepped over: the slave behind it sees the new value only at the end "
        "of a long step, neither solution of the double step has noticed anything, so ERR is small "
        "and the error is not, at any tolerance. Found, the jump is bracketed by halving until the "
        f"smallest H is reached, here {short(smallest, 1)} s. Then the history is cut, so no "
        "polynomial leads over the jump, and order and H begin as at the start.",
        commands(
            "master-node run examples/oscillators/kick.toml --in-process --output results",
        ),
        "**When to use which.** Keep the detection where anything may switch; in the "
        f"{len(SMOOTH) * len(TOLERANCES)} runs of section 4, where nothing jumps, it "
        f"spent {_spent_elsewhere()} double steps. Declare `events` where you know the times: no "
        "double step is spent on the search. Switch the detection off for inputs that are noisy or "
        "quantised, where every step looks like a jump.",
    )


def _row(tolerance: float, variant: str, treatment: str) -> tuple[object, ...]:
    one = run(KICK, tolerance, **VARIANTS[variant], **TREATMENTS[treatment])
    return (
        power(tolerance),
        variant,
        treatment,
        one.steps,
        one.rejections,
        one.result.summary["double_steps_at_discontinuities"],
        _crossing(one),
        short(_late(one)) if _late(one) else "0",
        short(one.mean_error),
        short(one.largest_error),
    )


def _crossing(one: Run) -> str:
    """The accepted double step with the jump, relative to the jump [s]."""
    steps = one.result.steps
    marked = [
        bool(accepted) and (reason == "event" or reason.endswith("jumps"))
        for accepted, reason in zip(steps["accepted"], steps["limiting_variable"], strict=True)
    ]
    return ", ".join(
        f"{JUMP:g} - {short(JUMP - time)}, {short(2.0 * step_size)}"
        for time, step_size in steps[["time", "step_size"]][marked].tolist()
    )


def _late(one: Run) -> float:
    """From the jump to the first communication point that is not before it [s]."""
    time = one.result.time
    return float(time[np.searchsorted(time, JUMP)] - JUMP)


def _spent_elsewhere() -> int:
    """Double steps at jumps in systems that have none."""
    summaries = [run(name, t).result.summary for name in SMOOTH for t in TOLERANCES]
    return sum(summary["double_steps_at_discontinuities"] for summary in summaries)
