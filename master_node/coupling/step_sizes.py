"""From the settings of a system to the communication step sizes that suit all its slaves."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from math import ulp

from master_node.coupling.coupled_system import CoupledSystem
from master_node.inputs.continuous import Jump
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.error_estimators import ESTIMATORS
from master_node.numerics.step_size_limits import (
    SlaveLimits,
    StepSizeLimits,
    StepSizeLimitsError,
)
from master_node.system.system import System
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError

log = logging.getLogger("master_node")

_RESOLUTION = 64.0
"""H is that many times the distance of neighbouring numbers at least: T + H is a later time then,
and H is what it is to about a percent."""


def with_fixed_steps(system: System, descriptions: Mapping[str, SlaveDescription]) -> System:
    """The system with a ``step_multiple`` for each slave whose model takes steps of one size.

    Its node splits a communication step into as many of them. Given rules of the slave win.
    """
    for name, description in descriptions.items():
        settings, fixed = system.slaves[name], description.fixed_step_size
        if fixed is not None and settings.step_size is None and settings.step_multiple is None:
            system = system.with_slave(name, step_multiple=fixed)
    return system


def step_size_limits(system: System) -> StepSizeLimits:
    """Limits for H from the simulation's settings and the slaves' rules.

    Raises:
        ConfigurationError: nothing.
    """
    settings = system.simulation
    estimator = ESTIMATORS.get(settings.estimator)
    long_step = estimator is not None and estimator.needs_long_step
    limits = _limits(system, settings.smallest, settings.largest, long_step=long_step)
    reached = start = float(settings.start_time)
    ways = []
    for event in sorted(settings.events):
        crossing = limits.crossing(start, float(event))
        if crossing.begin <= reached or crossing.end >= settings.end:
            raise ConfigurationError(
                f"{system.source}: [simulation] events: {event!r} is too near to another event or "
                "to an end of the simulated time"
            )
        ways.append((reached, crossing.begin))
        reached = crossing.end
    try:
        limits.check_ways(start, [*ways, (reached, settings.end)])
    except StepSizeLimitsError as error:
        raise ConfigurationError(
            f"{system.source}: no communication step size suits all: {error}"
        ) from None
    return limits


def with_bounded_steps(system: System, coupled: CoupledSystem) -> System:
    """The system with bounded steps, if there is no continuous output to control them by.

    A thousandth of the simulated time, unless the system says more; a warning says so.
    """
    settings = system.simulation
    is_bounded = settings.estimator == "none" or settings.largest_step_size is not None
    if coupled.output_names or is_bounded:
        return system
    largest = max(
        1e-3 * (settings.end - settings.start_time),
        settings.initial_step_size or 0.0,
        settings.smallest,
    )
    log.warning(
        "no slave has a continuous output, so there is no error to control: communication steps "
        "are of %r s at most; largest_step_size says otherwise",
        largest,
    )
    return system.with_simulation(largest_step_size=largest)


def crossings(
    system: System, limits: StepSizeLimits, jumps: Sequence[Jump]
) -> list[tuple[DoubleStepTimes, str]]:
    """The double steps that lead over events, in order, each with what it is to be called.

    Args:
        system: with the declared events.
        limits: with which these were checked.
        jumps: of external inputs, in order of time. One too near to another one, to an event or to
            an end of the simulated time to be crossed by itself is left out.
    """
    start, stop = float(system.simulation.start_time), system.simulation.end
    declared = [
        (limits.crossing(start, event), "event")
        for event in sorted(set(map(float, system.simulation.events)))
    ]
    begins = [crossing.begin for crossing, _ in declared]
    found = []
    reached = start
    for jump in jumps:
        crossing = limits.crossing(start, jump.time)
        following = bisect_right(begins, crossing.begin)
        free = max([reached, *(c.end for c, _ in declared[:following][-1:])])
        ahead = min([stop, *begins[following : following + 1]])
        if jump.is_held and limits.quantum is None and crossing.begin < free < jump.time:
            # Told late by two of the smallest H at most; a later one could be of any size.
            crossing = DoubleStepTimes.from_step_size(free, limits.smallest)
        is_between = free <= crossing.begin and crossing.end <= ahead and crossing.end < stop
        if is_between and all(
            limits.leads(start, *way) for way in ((free, crossing.begin), (crossing.end, ahead))
        ):
            found.append((crossing, f"{jump.name} jumps"))
            reached = crossing.end
    return sorted(declared + found)


def check_step_sizes(system: System) -> None:
    """True if there are step sizes that suit all slaves, before any of them is started.

    Raises:
        ConfigurationError: there are none.
    """
    if system.simulation.estimator == "none":
        fixed_step_limits(system)
    else:
        step_size_limits(system)


def fixed_step_limits(system: System) -> StepSizeLimits:
    """Fixed step of the simulation under the slaves' rules.

    Raises:
        ConfigurationError: it contradicts them.
    """
    step_size = system.simulation.step_size
    return _limits(
        system,
        step_size,
        step_size,
        long_step=False,
        given_by="the fixed step, initial_step_size or --step-size",
    )


def _limits(
    system: System,
    smallest: float,
    largest: float,
    *,
    long_step: bool,
    given_by: str = "the simulation",
) -> StepSizeLimits:
    rules = [
        SlaveLimits(
            name,
            slave.step_size,
            slave.step_multiple,
            slave.smallest_step_size,
            slave.largest_step_size,
        )
        for name, slave in system.slaves.items()
    ]
    start, stop = float(system.simulation.start_time), system.simulation.end
    resolution = _RESOLUTION * ulp(max(abs(start), abs(stop)))
    if smallest < resolution:
        smallest, given_by = resolution, f"the numbers near t={max(start, stop, key=abs)!r} s"
    try:
        limits = StepSizeLimits.of(
            rules,
            smallest,
            largest,
            long_step=long_step,
            given_by=given_by,
            stop_time=stop,
        )
        together = 1 if system.simulation.estimator == "none" else 2
        limits.check_span(start, stop, together)
    except StepSizeLimitsError as error:
        raise ConfigurationError(
            f"{system.source}: no communication step size suits all: {error}"
        ) from None
    return limits
