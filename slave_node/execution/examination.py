"""Trial steps that show what a slave is: its derivatives, its saved states, its clock, its steps.

Inputs are held, but for ramps that show what derivatives are worth. Each test begins where the
slave stands, and afterwards it stands there again. The tests are in the order in which one says
something about the next: input derivatives that are refused and outputs that do not repeat come
before saved states, these before all that goes back to see something else.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from protocol.calls import Examine, SetInputs
from protocol.description import Examination, StateKind, StateVerdict
from protocol.errors import FatalSlaveError, SlaveError
from protocol.slave import Slave
from slave_node.trials.clock import SlowError, internal_clock
from slave_node.trials.input_derivatives import highest_order_below, highest_order_used
from slave_node.trials.output_derivatives import Pair, poor_derivatives
from slave_node.trials.states import GOES_BACK, States, compare
from slave_node.trials.step_dependence import step_counters, step_dependence
from slave_node.trials.steps import Place, Trial, TrialError, freed

_SHRINKS = 4
_SHRINK = 0.1
"""So often, and by so much, the trial steps are made smaller if the slave does not take them."""


def examine(slave: Slave, call: Examine) -> Examination:
    """Take trial steps and go back.

    Args:
        slave: at a communication point, with the discrete inputs that it is to have.
        call: what to try, with which inputs and tolerances.

    Raises:
        FatalSlaveError: the slave must not be called any more.
    """
    trial = Trial(slave, call)
    try:
        if slave.description.state_kind is StateKind.NONE:
            return _without_rollback(trial)
        return _with_rollback(trial)
    except TrialError as error:
        return Examination(state_reason=str(error), has_moved=True)
    except FatalSlaveError:
        raise
    except SlaveError as error:
        return Examination(StateVerdict.BROKEN, str(error), has_moved=True)


def _refused(order: int, refusal: str) -> Examination:
    return Examination(has_moved=True, input_order=order, input_refusal=refusal)


def _refusal(error: SlaveError) -> str:
    """Answer to input derivatives; raises an error that is about something else."""
    if isinstance(error, FatalSlaveError) or error.phase != SetInputs.verb:
        raise error
    return error.cause


def _without_rollback(trial: Trial) -> Examination:
    """Trial of inputs; of steps only those that derivatives of outputs call for."""
    call, reason = trial.call, trial.slave.description.state_reason
    try:
        trial.set_inputs(call.input_order)
    except SlaveError as error:
        refusal = _refusal(error)
        return _refused(*highest_order_below(trial, call.input_order, refusal, lambda: None))
    if not trial.reads_slopes or not trial.outputs:
        return Examination(state_reason=reason)
    now = call.communication_point

    def pair_of(size: float) -> Pair:
        nonlocal now
        readings = []
        for i in range(2):
            _ramp_inputs(trial, size, i)
            readings.append(trial.step(now, size))
            now += size
        return Pair(size, *readings)

    poor = poor_derivatives(trial, pair_of)
    return Examination(state_reason=reason, has_moved=True, poor_derivatives=poor)


def _ramp_inputs(trial: Trial, size: float, number: int) -> None:
    """Let the inputs move from step to step of ``size`` [s], where the slave follows them."""
    if trial.follows_inputs:
        trial.slave.set_inputs(trial.ramp(size, number * size))


def _with_rollback(trial: Trial) -> Examination:
    call = trial.call
    if not call.inputs or not call.input_order:
        trial.set_inputs(0)
        with freed(Place(trial, call.communication_point)) as origin:
            return _with_known_inputs(trial, origin)
    with freed(Place(trial, call.communication_point)) as before:
        try:
            trial.set_inputs(call.input_order)
            origin = Place(trial, call.communication_point)  # a fork is told of its inputs by then
        except SlaveError as error:
            refusal = _refusal(error)

            def accepts() -> None:
                Place(trial, call.communication_point).free()

            order, refusal = highest_order_below(
                trial, call.input_order, refusal, accepts, before.restored
            )
            with freed(Place(trial, call.communication_point)) as place:
                return _refused(*_used(place, order, refusal, call.step_size))
        with freed(origin):
            return _with_known_inputs(trial, origin)


def _with_known_inputs(trial: Trial, origin: Place) -> Examination:
    """Trial with input derivatives of all orders, to which nothing is said."""
    call = trial.call
    try:
        states, size = _test_states(trial, origin)
    except TrialError as error:
        if not call.inputs or not call.input_order:
            raise

        def takes_step() -> None:
            trial.step(call.communication_point, call.step_size)

        order, refusal = highest_order_below(
            trial, call.input_order, str(error), takes_step, origin.restored
        )
        return _refused(*_used(origin, order, refusal, call.step_size))
    if states.verdict not in GOES_BACK or not trial.takes_any_step:
        return _examination(trial, states)
    if call.inputs and call.input_order:
        order, refusal = _used(origin, call.input_order, "", size)
        if refusal:
            return _refused(order, refusal)
    return _with_steps_of_any_size(trial, origin, states, size)


def _used(place: Place, order: int, refusal: str, size: float) -> tuple[int, str]:
    """Up to which order input derivatives are made use of, and why not beyond that.

    Args:
        place: where the slave stands.
        order: the highest one that is taken.
        refusal: of the next higher one; "" if none was refused.
        size: of the steps to take [s].
    """
    with suppress(TrialError):
        used = highest_order_used(place, order, size)
        if used < order:
            return used, f"those of order {used + 1} change nothing"
    return order, refusal


def _test_states(trial: Trial, origin: Place) -> tuple[States, float]:
    """Worth of saved states, and the size of steps that the slave takes [s].

    Raises:
        TrialError: it takes none.
    """
    fixed = trial.slave.description.fixed_step_size
    size = trial.call.step_size
    if fixed is not None:
        size = fixed * max(1, round(size / fixed))
    reasons = []
    for _ in range(_SHRINKS if trial.takes_any_step else 1):
        try:
            return compare(trial, origin, size), size
        except TrialError as error:
            reasons.append(str(error))
            size *= _SHRINK
            origin.restored()
    raise TrialError(f"no trial step succeeded, the first one: {reasons[0]}")


def _with_steps_of_any_size(
    trial: Trial, origin: Place, states: States, size: float
) -> Examination:
    """All that goes back again and again, with steps of many sizes.

    Args:
        trial: of the slave.
        origin: where it stands.
        states: what its saved states are worth: it goes back.
        size: of steps that it takes [s].
    """
    counters = step_counters(origin)
    if counters:
        return Examination(has_moved=True, not_repeating=(*trial.call.not_repeating, *counters))
    poor = _poor_derivatives(trial, origin, repeat=states.slopes_repeat)
    trial.reads_slopes = False
    clock: float | None = None
    dependence: tuple[float, float | None] = (0.0, None)
    not_tried: list[str] = []
    try:
        clock = internal_clock(origin)
    except SlowError as error:
        not_tried.append(f"no clock was looked for with steps of {error}")
    if clock is not None and size < clock <= 0.5 * trial.largest_step:
        origin.restored()
        with suppress(TrialError):
            states = compare(trial, origin, clock)
            if states.verdict not in GOES_BACK:
                return _examination(trial, states)
    if clock is None:
        try:
            dependence = step_dependence(origin)
        except SlowError as error:
            not_tried.append(f"steps of {error} were not compared with two of half the size")
    origin.restored()
    return replace(
        _examination(trial, states),
        internal_clock=clock,
        step_dependence=dependence[0],
        largest_substep=dependence[1],
        poor_derivatives=poor,
        not_tried="; ".join(not_tried),
    )


def _poor_derivatives(trial: Trial, origin: Place, *, repeat: bool) -> dict[str, str]:
    """The outputs whose derivatives cannot be used; ``repeat``: whether they did so far."""
    if not repeat:
        return trial.of_all("others when the same step is taken again")
    if not trial.reads_slopes:
        return {}

    def pair_of(size: float) -> Pair:
        origin.restored()
        readings = []
        for i in range(2):
            _ramp_inputs(trial, size, i)
            readings.append(origin.step(size))
        return Pair(size, *readings)

    return poor_derivatives(trial, pair_of)


def _examination(trial: Trial, states: States) -> Examination:
    """Findings about a slave by its saved states."""
    return Examination(
        states.verdict,
        states.reason,
        states.verdict is not StateVerdict.EXACT,
        states.difference,
        not_repeating=(*trial.call.not_repeating, *states.not_repeating),
    )
