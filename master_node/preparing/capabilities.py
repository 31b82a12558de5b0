"""Meaning of the slaves' capabilities for a run, before it begins."""

from __future__ import annotations

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem, SlavePart
from master_node.coupling.scheme import outputs_follow_inputs, slaves_without_rollback
from master_node.numerics.collocation import NODES
from master_node.system.system import System
from protocol.errors import ConfigurationError
from protocol.text.names import listed
from protocol.variables import Causality


def check_capabilities(coupled: CoupledSystem, system: System) -> list[str]:
    """Warnings of what the slaves' capabilities mean for this run.

    Raises:
        ConfigurationError: an estimator was asked for and a slave cannot change its step size and
            has no ``step_size`` given, or outputs are to be evaluated again where some slaves have
            rollback and some have not.
    """
    settings = system.simulation
    without = slaves_without_rollback(coupled)
    is_mixed = settings.estimator != "none" and 0 < len(without) < len(coupled.parts)
    if settings.evaluate_outputs and is_mixed:
        raise ConfigurationError(
            f"{coupled.parts[without[0]].name}: its state cannot be saved (canGetAndSetFMUstate), "
            "so its outputs are not known when those of the others would be evaluated again",
            remedy="leave out evaluate_outputs",
        )
    warnings = []
    for part in coupled.parts:
        warnings += [f"{part.name}: {remark}" for remark in part.description.remarks]
        warnings += _local_sources(part)
        can = part.description.capabilities
        fixed = system.slaves[part.name].step_size or part.description.fixed_step_size
        if settings.estimator != "none" and not can.can_handle_variable_step_size and fixed is None:
            raise ConfigurationError(
                f"{part.name}: the model cannot handle variable communication step sizes",
                remedy=f"give {system.places.setting(f'slaves.{part.name}', 'step_size')}, or use "
                "--estimator none with a fixed --step-size",
            )
        highest, wanted = part.max_order, settings.order
        if part.connected and (highest < (1 if wanted == "auto" else wanted)):
            warnings.append(
                f"{part.name} cannot interpolate inputs (canInterpolateInputs): its inputs are "
                f"held constant in each step, order {highest} instead of {wanted}"
            )
        if any(coupled.external.changes[part.external_slice]) and not highest:
            warnings.append(
                f"{part.name} cannot interpolate inputs (canInterpolateInputs): its external "
                "inputs are held at their mean in each step"
            )
        has_feed_through = coupled.feed_through[part.output_slice].any()
        evaluates = settings.evaluate_outputs and has_feed_through
        if evaluates and not outputs_follow_inputs(part, system):
            warnings.append(
                f"{part.name}: its outputs with direct feed-through cannot be evaluated again at "
                "communication points, as FMI 2.0 does not promise that they follow its inputs "
                f"without a step; if they do, say so: [slaves.{part.name}] "
                "outputs_follow_inputs = true"
            )
    return warnings + _not_iterated(coupled, system) + _jumps_off_the_grid(coupled, system)


def _not_iterated(coupled: CoupledSystem, system: System) -> list[str]:
    """Where ``coupling = "implicit"`` is asked for and cannot be had."""
    settings = system.simulation
    if settings.coupling != "implicit" or settings.estimator == "none":
        return []
    without = [coupled.parts[slave].name for slave in slaves_without_rollback(coupled)]
    if without:
        return [
            f'coupling = "implicit" needs slaves that can go back, and the state of {without[0]} '
            "cannot be saved: inputs are extrapolated"
        ]
    held = [p.name for p in coupled.parts if p.connected and p.max_order < NODES]
    if held:
        return [
            f'coupling = "implicit" needs inputs that follow a polynomial of degree {NODES}, and '
            f"those of {held[0]} do not: inputs are extrapolated; leave out input_substeps = 1"
        ]
    return []


def _local_sources(part: SlavePart) -> list[str]:
    """Warnings of sources of inputs that are not meant for other models."""
    locals_ = [
        name for name in part.locals if part.description.variable(name).causality is Causality.LOCAL
    ]
    if not locals_ or part.description.kind == "Python model":
        return []
    return [
        f"{part.name}: inputs are fed by its local variables {listed(locals_)}: FMI means only "
        "outputs for other models"
    ]


def _jumps_off_the_grid(coupled: CoupledSystem, system: System) -> list[str]:
    """Without an estimator no communication point is put where an external input jumps."""
    settings = system.simulation
    if settings.estimator != "none":
        return []
    start, stop, step_size = float(settings.start_time), settings.end, settings.step_size
    inside = [jump for jump in coupled.jumps if start < jump.time < stop]
    steps = np.array([(jump.time - start) / step_size for jump in inside])
    is_off = np.abs(steps - np.round(steps)) > 1e-9 * np.maximum(1.0, steps)
    if not is_off.any():
        return []
    first = inside[int(np.argmax(is_off))]
    return [
        f"{int(is_off.sum())} jumps of external inputs are not at communication points, the first "
        f"one is that of {first.name} at t={first.time!r} s: in a step over a jump the polynomial "
        "has the right mean only, and a discrete input its old value; choose a step size that "
        "meets them, or an estimator"
    ]
