"""Prints the tables, as Markdown. What takes options is run by name only: see `CHECKS`."""

import sys

from benchmarks import (
    attacks,
    corpus,
    coupled,
    coverage_guided,
    digests,
    emulated_inputs,
    fault_points,
    fault_schedules,
    fuzz,
    in_process,
    many_variables,
    memory,
    nemesis,
    over_zenoh,
    recovery,
    saved_states,
    stiff,
    tls,
)

TABLES = {
    "over_zenoh": (
        "Attempted double step over Zenoh, two slave processes on loopback",
        ("configuration", "attempted double step", "empty two-slave fan-out", "ratio"),
        over_zenoh.run,
    ),
    "in_process": (
        "Attempted double step in process",
        ("configuration", "attempted double step", "by hand with FMPy", "ratio"),
        in_process.run,
    ),
    "tls": (
        "Attempted double step over TLS, two slave processes on loopback",
        ("configuration", "over TLS", "over TCP", "ratio"),
        tls.run,
    ),
    "emulated_inputs": (
        "Inputs followed natively / emulated / held, quarter car",
        ("configuration", "accepted steps", "mean error", "slaves' time for a do_step"),
        emulated_inputs.run,
    ),
    "saved_states": (
        "States saved by forking and natively",
        ("what", "fork", "native", "ratio"),
        saved_states.run,
    ),
    "many_variables": (
        "Attempted double step of two slaves with many connected variables",
        ("configuration", "5 000 variables", "10 variables", "ratio"),
        many_variables.run,
    ),
    "recovery": (
        "A slave process is killed in mid step",
        ("process", "noticed after", "the next double step is done after"),
        recovery.run,
    ),
    "memory": (
        "Resident memory over a million attempted double steps",
        ("process", "after 10 %", "at the end", "growth"),
        memory.run,
    ),
}

CHECKS = {
    "attacks": attacks.main,
    "corpus": corpus.main,
    "coupled": coupled.main,
    "coverage_guided": coverage_guided.main,
    "digests": digests.main,
    "fault_points": fault_points.main,
    "fault_schedules": fault_schedules.main,
    "fuzz": fuzz.main,
    "nemesis": nemesis.main,
    "stiff": stiff.main,
}
"""With their own options. All but `stiff` end with an error when something did not hold."""


def main(names: list[str]) -> None:
    """Run the named benchmarks, or all tables."""
    if names and names[0] in CHECKS:
        CHECKS[names[0]](names[1:])
        return
    unknown = [name for name in names if name not in TABLES]
    if unknown:
        known = ", ".join(sorted({*TABLES, *CHECKS}))
        sys.exit(f"no benchmark is named {unknown[0]!r}; there are {known}")
    for name in names or TABLES:
        title, columns, run = TABLES[name]
        print(f"\n### {title}\n")
        print(f"| {' | '.join(columns)} |")
        print("|" + "---|" * len(columns))
        for row in run():
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
