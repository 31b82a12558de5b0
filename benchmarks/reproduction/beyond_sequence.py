"""Gauss-Seidel against Jacobi."""

from __future__ import annotations

from benchmarks.reproduction.beyond_text import both, commands, paragraphs, power, short, table
from benchmarks.reproduction.measured_runs import SMOOTH, load, run


def section() -> str:
    """Work and error of both sequences."""
    rows = []
    for name in SMOOTH:
        for tolerance in (1e-4, 1e-6):
            runs = [run(name, tolerance, sequence=s) for s in ("jacobi", "gauss-seidel")]
            rows.append(
                (
                    f"{name} ({len(load(name).slaves)} slaves)",
                    power(tolerance),
                    *both(
                        [one.steps for one in runs],
                        [one.rejections for one in runs],
                        [one.do_steps for one in runs],
                        [one.round_trips for one in runs],
                        [short(one.mean_error) for one in runs],
                    ),
                )
            )
    return paragraphs(
        "## 8. Gauss-Seidel against Jacobi",
        "Jacobi: all slaves take a step at the same time, with extrapolated inputs. Gauss-Seidel: "
        "one after the other, in the order of the system file, with inputs that are interpolated "
        "where the slave behind them has taken the step already. Each cell is Jacobi / "
        "Gauss-Seidel, default settings.",
        table(
            (
                "system",
                "tolerance",
                "steps",
                "rejections",
                "do_steps of each slave",
                "round trips",
                "mean error",
            ),
            rows,
        ),
        commands(
            "master-node run examples/oscillators/two_mass.toml --in-process "
            "--sequence gauss-seidel --output results",
        ),
        "**When to use which.** Jacobi where slaves compute at the same time on different "
        "processors or hosts: its round trips do not depend on the number of slaves. Gauss-Seidel "
        "for two or three slaves with a stiff coupling, as in two_mass, where H is bounded by "
        "stability and not by accuracy, or where all slaves share one processor and have to wait "
        "for each other anyway. With many slaves its round trips are expensive and it "
        "gains little.",
    )
