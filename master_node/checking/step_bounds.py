"""Bounds of the communication step size that are known before the first step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from master_node.checking.report import LoopReport, StepBound
from master_node.coupling.scheme import slaves_without_rollback
from master_node.coupling.step_sizes import fixed_step_limits, step_size_limits
from master_node.preparing.readiness import Ready
from protocol.text.names import number_of, some


def step_bounds(ready: Ready, loops: Sequence[LoopReport]) -> list[StepBound]:
    """All of them, those in seconds first."""
    system = ready.prepared.system
    settings = system.simulation
    if settings.estimator == "none":
        size = fixed_step_limits(system).largest
        given = settings.initial_step_size is not None
        why = (
            "initial_step_size" if given else "a thousandth of the simulated time, as none is given"
        )
        return [
            StepBound("fixed H", size, f"without an estimator all steps have one size: {why}"),
            *_rules(ready),
        ]
    limits = step_size_limits(system)
    together = "double steps share what is left" if limits.quantum is None else "on a grid"
    return [
        StepBound("smallest H", limits.smallest, _smallest(ready, limits.smallest)),
        StepBound("largest H", limits.largest, f"{_largest(ready, limits.largest)}; {together}"),
        *_at_rest(ready, limits.largest),
        *_rules(ready),
        *_events(ready),
        *_error_control(ready),
        *_feed_through(loops),
    ]


def _smallest(ready: Ready, value: float) -> str:
    system = ready.prepared.system
    for name, slave in system.slaves.items():
        if slave.smallest_step_size is not None and float(slave.smallest_step_size) == value:
            return f"smallest_step_size of {name}"
    if system.simulation.smallest_step_size is not None:
        given = float(system.simulation.smallest_step_size)
        return "smallest_step_size" if given == value else "smallest_step_size, and rules of slaves"
    if value == system.simulation.smallest:
        return "1e-9 of the simulated time"
    return "the resolution of numbers, or rules of slaves"


def _largest(ready: Ready, value: float) -> str:
    system = ready.prepared.system
    if system.simulation.largest == value:
        if system.simulation.largest_step_size is not None:
            return "largest_step_size"
        return "half of the simulated time: two steps"
    for name, slave in system.slaves.items():
        if slave.largest_step_size is not None and float(slave.largest_step_size) >= value:
            return f"largest_step_size of {name}"
    return "rules of slaves"


def _at_rest(ready: Ready, largest: float) -> Iterator[StepBound]:
    """Bound of H where no estimate has one."""
    coupled, value = ready.coupled, ready.prepared.system.simulation.largest_at_rest
    is_coupled = coupled.source.size or coupled.discrete.holds_inputs
    if (
        is_coupled
        and value < largest
        and len(slaves_without_rollback(coupled)) < len(coupled.parts)
    ):
        why = "a 32nd of the simulated time, where no estimate bounds H; largest_step_size sets it"
        yield StepBound("H at rest", value, why)


def _rules(ready: Ready) -> Iterator[StepBound]:
    """Grids of single slaves."""
    prepared = ready.prepared
    for name, slave in prepared.system.slaves.items():
        examination = prepared.examinations.get(name)
        if slave.step_size is not None:
            yield StepBound("only H", float(slave.step_size), f"step_size of {name}")
        if slave.step_multiple is None:
            continue
        multiple = float(slave.step_multiple)
        why = f"step_multiple of {name}"
        if examination is not None and examination.internal_clock is not None:
            why = f"{name} has an internal clock, which trial steps have found"
        elif prepared.descriptions[name].fixed_step_size == multiple:
            why = f"{name} takes steps of this size only"
        yield StepBound("multiples of", multiple, why)


def _events(ready: Ready) -> Iterator[StepBound]:
    """Points that steps have to meet."""
    coupled, settings = ready.coupled, ready.prepared.system.simulation
    if settings.events:
        times = some([f"{float(t):g}" for t in settings.events], 5)
        yield StepBound("ends at", None, f"events at t = {times} s")
    inside = [j for j in coupled.jumps if float(settings.start_time) < j.time < settings.end]
    if inside:
        first = f"the first is that of {inside[0].name} at t = {inside[0].time:g} s"
        yield StepBound(
            "ends at", None, f"{number_of(len(inside), 'jump')} of external inputs; {first}"
        )
    keys, held = coupled.discrete.names, coupled.discrete.inputs
    feeding = sorted({keys[h.output] for each in held for h in each if h.output is not None})
    if feeding:
        yield StepBound("events", None, f"changes of {some(feeding, 5)}, which are located")
    if settings.discontinuities:
        yield StepBound("events", None, "jumps of connected variables, which are searched for")


def _error_control(ready: Ready) -> Iterator[StepBound]:
    """ERR, and what it cannot see."""
    coupled, settings = ready.coupled, ready.prepared.system.simulation
    feeding = set(coupled.source.tolist())
    counts = [
        name
        for index, (name, counted) in enumerate(
            zip(coupled.output_names, coupled.is_controlled.tolist(), strict=True)
        )
        if counted and index in feeding
    ]
    tolerances = f"RTOL = {settings.relative_tolerance:g}, ATOL = {settings.absolute_tolerance:g}"
    if counts:
        yield StepBound("ERR <= 1", None, f"errors of {some(counts, 6)}: {tolerances}")
    held = [p.name for p in coupled.parts if p.connected and p.max_order == 0]
    if held:
        why = f"{some(held, 5)} hold inputs constant in each step: errors are of first order"
        yield StepBound("ERR <= 1", None, why)
    without = [coupled.parts[i].name for i in slaves_without_rollback(coupled)]
    if without:
        why = f"{some(without, 5)} cannot go back: defects of inputs bound the step behind them"
        yield StepBound("defects", None, why)


def _feed_through(loops: Sequence[LoopReport]) -> Iterator[StepBound]:
    for loop in loops:
        if not abs(loop.gain) < 1.0:  # NaN, too
            known = loop.unknown or f"gain {loop.gain:.3g}"
            why = f"loop of direct feed-through over {some(loop.outputs, 4)} ({known}): "
            yield StepBound("ERR <= 1", None, why + "errors of extrapolated inputs may grow in it")
