"""Warnings at the end of a run: parts of it that are uncertain or expensive.

Everything follows from the counters, so a run that was resumed says the same.
"""

from __future__ import annotations

from master_node.observing.observers import Statistics

_DOUBLE_STEPS = 100
"""Double steps from which on their shares say something."""

_SHARE_OF_JUMPS, _SHARE_OF_FALSE_ALARMS = 0.5, 0.1
"""Shares of all double steps that go to jumps, and to false alarms, without a warning."""


_SHARE_OF_STIFF_STEPS = 0.05
"""Share of all double steps that may be explicit where the coupling is stiff."""


def warnings_of(statistics: Statistics) -> list[str]:
    """One sentence for each, with its remedy."""
    warnings = []
    attempts = statistics.communication_steps // 2 + statistics.rejected_double_steps
    at_jumps, at_false_alarms = (
        statistics.double_steps_at_discontinuities,
        statistics.double_steps_at_false_alarms,
    )
    if attempts >= _DOUBLE_STEPS and at_jumps > _SHARE_OF_JUMPS * attempts:
        warnings.append(
            f"{at_jumps} of {attempts} double steps went to jumps, of which "
            f"{statistics.discontinuities} were found: 'jumps' in the column limiting_variable of "
            "steps.csv says of what; give their times in 'events', or a larger "
            "smallest_step_size; if nothing jumps there, raise that output's absolute tolerance"
        )
    if attempts >= _DOUBLE_STEPS and at_false_alarms > _SHARE_OF_FALSE_ALARMS * attempts:
        warnings.append(
            f"{at_false_alarms} of {attempts} double steps went to false alarms: something moves "
            "so fast that it looks like a jump; 'jumps' in the column limiting_variable of "
            "steps.csv says what; lower largest_step_size, or set discontinuities = false"
        )
    if statistics.late_jumps:
        warnings.append(
            f"{statistics.late_jumps} jumps were met late, by a time that is not known: inputs of "
            "the slaves that jumped had been off by more than ten tolerances, and no estimate "
            "showed it; 'jumps late' in the column limiting_variable of steps.csv says where; use "
            'order = "auto", or lower largest_step_size or the tolerances of the outputs that '
            "these slaves get"
        )
    stiff = statistics.stiff_double_steps
    if stiff > _SHARE_OF_STIFF_STEPS * statistics.communication_steps / 2:
        warnings.append(
            f"{stiff} of {statistics.communication_steps // 2} double steps had a loop gain above "
            "0.9: the coupling is stiff, and the estimate of an extrapolated step tells little "
            'there; use coupling = "auto" with slaves whose states can be saved and whose inputs '
            "follow input derivatives or substeps, or check against a run with lower tolerances"
        )
    if statistics.changes_at_smallest_step_size:
        warnings.append(
            f"{statistics.changes_at_smallest_step_size} changes of discrete outputs were handed "
            "over late, with an error above the tolerance or unknown, as H could not be smaller: "
            "lower smallest_step_size, or allow smaller steps of the slaves"
        )
    return warnings
