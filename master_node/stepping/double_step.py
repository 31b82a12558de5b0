"""The double step T_n -> T_n + H -> T_n + 2H with its comparison solution: steps (A) to (H).

Everything up to the first small step depends only on what the master knows at T_n, so it is one
request; only (G) needs an answer first. Two round trips, whatever k, the estimator and the number
of slaves, when all slaves take their steps at once:

    EST_Rich  1: GetState, SetInputs(u~), DoStep(T, 2H), SetState, SetInputs(u), DoStep(T, H)
              2: SetInputs(u_new), DoStep(T+H, H)
    EST_mod   1: GetState, SetInputs(u), DoStep(T, H), GetState, SetInputs(u), DoStep(T+H, H)
              2: SetState and free, SetInputs(u_new), DoStep(T+H, H)

In front of request 1 stands what the last attempt calls for: after an accepted step the state is
saved (over the old one, which is freed with that), after a rejected one the old one is restored.
In a Gauss-Seidel sequence each of both requests is one round trip for each slave.

External inputs are known: each small step has its own polynomial of them. The comparison solution
has the one over the whole double step, so that the estimates see what polynomials leave of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.discrete import DiscreteValues
from master_node.coupling.outputs import NO_OUTPUTS, Outputs
from master_node.coupling.result_points import Reached, ReachedPoint
from master_node.coupling.scheme import CouplingScheme
from master_node.numerics.collocation import Collocation
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.error_estimators import Comparison, ErrorEstimator
from master_node.numerics.extrapolation import CouplingHistory, Polynomials, StepInputs
from master_node.numerics.interface_jacobian import Secants
from master_node.slaves.group import SlaveGroup
from master_node.stepping.discrete_requests import step_requests
from master_node.stepping.requests import (
    RESTORE_HALFWAY,
    RESTORE_HALFWAY_AND_KEEP,
    RESTORE_POINT,
    SAVE_HALFWAY,
    BrokenOffError,
    FailedStep,
    Piece,
    RequestForm,
    StepForm,
)
from protocol.calls import DoStep, GetOutputs
from protocol.errors import StepRejectedError
from protocol.signals import FloatArray, InputSignal


class Iteration(NamedTuple):
    """Iteration by which the inputs of a double step were found.

    Attributes:
        collocation: their polynomial.
        secants: of each slave, for the next iteration.
        number: of evaluations.
        loop_gain: spectral radius of the interface Jacobian as far as it is known; infinite where
            nothing is known of a slave.
    """

    collocation: Collocation
    secants: tuple[Secants, ...]
    number: int
    loop_gain: float


class DoubleStep(NamedTuple):
    """The solution of a double step and what it is compared with.

    Output arrays have one row of values, shape (1, m), or a second one of derivatives, which are
    0 for outputs that have none.

    Attributes:
        times: of the double step.
        polynomials: of the inputs, for each kind.
        middle, end: outputs of the two small steps at T_n + H and T_n + 2H.
        comparison: values of the comparison solution at T_n + 2H, shape (m,).
        history: inputs at the communication points up to T_n + H.
        end_inputs: at T_n + 2H, shape (rows, n).
        foreseen: the inputs at T_n + H and T_n + 2H as their polynomials said, shape (n,) each.
        input_difference: of the comparison solution's inputs from those of the double step, in the
            mean over the time in which they differ, shape (n,).
        discrete: discrete outputs at T_n + H and T_n + 2H.
        iteration: how the inputs were found; None: they were extrapolated.
    """

    times: DoubleStepTimes
    polynomials: Polynomials
    middle: FloatArray
    end: FloatArray
    comparison: FloatArray
    history: CouplingHistory
    end_inputs: FloatArray
    foreseen: tuple[FloatArray, FloatArray]
    input_difference: FloatArray
    discrete: tuple[DiscreteValues, DiscreteValues] = ((), ())
    iteration: Iteration | None = None

    @property
    def begin(self) -> float:
        """T_n [s]."""
        return self.times.begin

    @property
    def step_size(self) -> float:
        """H [s]."""
        return self.times.step_size

    @property
    def reached(self) -> Reached:
        """Both communication points that it leads to."""
        d_middle, d_end = self.discrete
        return (
            ReachedPoint(self.times.middle, self.middle, d_middle),
            ReachedPoint(self.times.end, self.end, d_end),
        )

    @property
    def outputs(self) -> Outputs:
        """Outputs at T_n + 2H."""
        return Outputs(self.end, self.discrete[1])

    @property
    def iterations(self) -> int:
        """Number of evaluations that it took to find the inputs; 0: they were extrapolated."""
        return 0 if self.iteration is None else self.iteration.number


class DoubleStepper:
    """Takes double steps with one estimator; holds only what the slaves have saved.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        scheme: how they are coupled within a step.
        estimator: which comparison solution to compute.

    Attributes:
        requests: to the slaves.
    """

    def __init__(
        self,
        group: SlaveGroup,
        coupled: CoupledSystem,
        scheme: CouplingScheme,
        estimator: ErrorEstimator,
    ) -> None:
        self._coupled = coupled
        self._external = coupled.external
        self._scheme = scheme
        self._is_long_step = estimator.comparison is Comparison.LONG_STEP
        self.requests = step_requests(group, coupled, scheme)
        forms = self.requests.forms
        solution, comparison = scheme.get_outputs, (GetOutputs(),) * len(coupled.parts)
        if scheme.known_ahead:
            comparison = solution
        if self._is_long_step:
            first = StepForm(None, comparison, records=False), StepForm((RESTORE_POINT,), solution)
            second = careful = StepForm((), solution)
        else:
            first = StepForm(None, solution), StepForm((SAVE_HALFWAY,), comparison, records=False)
            second = StepForm((RESTORE_HALFWAY,), solution)
            careful = StepForm((RESTORE_HALFWAY_AND_KEEP,), solution)
        self._first_request, self._second_request = forms(*first), forms(second)
        self._careful_first_requests = [form for step in first for form in forms(step)]
        self._careful_second_request = forms(careful)
        self._is_careful = False

    def attempt(
        self,
        history: CouplingHistory,
        times: DoubleStepTimes,
        polynomials: Polynomials,
        begin: Outputs = NO_OUTPUTS,
        *,
        careful: bool = False,
    ) -> DoubleStep | FailedStep:
        """One double step from the newest point of ``history``.

        Args:
            history: inputs at the communication points up to T_n.
            times: of the double step.
            polynomials: of the inputs, for each kind.
            begin: outputs at T_n, for the discrete inputs.
            careful: whether a first step from a restored state that returns early is taken again,
                which costs a round trip and keeps one more state.

        Returns:
            The solution, or why there is none. Unless `accepted` follows, the next attempt goes
            back to T_n first.

        Raises:
            DoublestepError: a slave is lost, or failed in a way that a smaller step cannot help.
        """
        self._is_careful = careful
        try:
            return self._attempt(history, times, polynomials, begin)
        except BrokenOffError as broken_off:
            return broken_off.failed
        except StepRejectedError as error:  # of an external input, before anything was sent
            return FailedStep("", None, float("nan"), error.cause)

    def accepted(self) -> None:
        """Go on from the end: the state saved at T_n is not needed any more."""
        self.requests.forget()

    def _attempt(
        self,
        history: CouplingHistory,
        times: DoubleStepTimes,
        polynomials: Polynomials,
        outputs: Outputs,
    ) -> DoubleStep:
        begin, middle, end, first, second, _ = times
        discrete = self._coupled.discrete
        held = discrete.held(outputs.y[0], outputs.d, begin)
        external = self._external.over(begin, middle)
        external_second = self._external.over(middle, end)
        external_long = self._external.over(begin, end)
        in_first: StepInputs
        in_second: StepInputs
        in_long: StepInputs

        def first_inputs(known: FloatArray) -> FloatArray:
            nonlocal in_first
            in_first = self._inputs(history, polynomials, (begin, middle), first, known)
            return in_first.begin

        def second_inputs(known: FloatArray) -> FloatArray:
            nonlocal in_second
            in_second = self._inputs(pushed, polynomials, (middle, end), second, known)
            return in_second.begin

        small_piece = Piece(first_inputs, external, held, DoStep(begin, first, True))
        if self._is_long_step:
            past, size = history.every_second(), times.long

            def long_inputs(known: FloatArray) -> FloatArray:
                nonlocal in_long
                in_long = self._inputs(past, polynomials, (begin, end), size, known)
                return in_long.begin

            comparison_piece = Piece(
                long_inputs,
                external_long,
                held,
                DoStep(begin, size, True),
            )
            comparison, at_middle = self._first_steps(comparison_piece, small_piece)
        else:
            comparison_piece = Piece(
                lambda _: in_first.end,
                external_long.shifted(first),
                held,
                DoStep(middle, second, False),
            )
            at_middle, comparison = self._first_steps(small_piece, comparison_piece)

        y_middle = at_middle.y
        d_middle = discrete.filled(at_middle.d, outputs.d)
        pushed = history.pushed(middle, self._coupled.inputs_of(y_middle))
        if self._scheme.extrapolation.known(polynomials, pushed) != polynomials:
            raise BrokenOffError(self._without_derivative(y_middle))
        second_piece = Piece(
            second_inputs,
            external_second,
            discrete.held(y_middle[0], d_middle, middle),
            DoStep(middle, second, False),
        )
        if self._is_careful:
            (at_end,) = self._carefully(self._careful_second_request, second_piece)
        else:
            (at_end,) = self.requests.take(self._second_request, (second_piece,))
        if self._is_long_step:
            small = InputSignal(in_first.begin).mean(first) + InputSignal(in_second.begin).mean(
                second
            )
            difference = InputSignal(in_long.begin).mean(size) - 0.5 * small
        else:
            difference = InputSignal(in_first.end - in_second.begin).mean(second)
        return DoubleStep(
            times,
            polynomials,
            y_middle,
            at_end.y,
            comparison.y[0],
            pushed,
            self._coupled.inputs_of(at_end.y),
            (in_first.end[0], in_second.end[0]),
            difference,
            (d_middle, discrete.filled(at_end.d, d_middle)),
        )

    def _first_steps(self, first: Piece, second: Piece) -> list[Outputs]:
        """All that depends only on what is known at T_n."""
        if not self._is_careful:
            return self.requests.take(self._first_request, (first, second))
        pairs = zip(self._careful_first_requests, (first, second), strict=True)
        return [outputs for form, piece in pairs for outputs in self._carefully([form], piece)]

    def _carefully(self, forms: Sequence[RequestForm], piece: Piece) -> list[Outputs]:
        """A step by itself; once more if a slave returns early in it right behind a restore."""
        try:
            return self.requests.take(forms, (piece,))
        except BrokenOffError as broken_off:
            if not broken_off.failed.has_doubtful_event:
                raise
        return self.requests.take(forms, (piece,))

    def _without_derivative(self, middle: FloatArray) -> FailedStep:
        """The second small step cannot have the polynomials of the first one."""
        is_missing = self._scheme.has_derivative & ~np.isfinite(middle[1])
        name = self._coupled.output_names[int(is_missing.argmax())]
        reason = f"the derivative of {name} is not finite"
        return FailedStep("", None, float("nan"), reason, missing=middle)

    def _inputs(
        self,
        history: CouplingHistory,
        polynomials: Polynomials,
        ends: tuple[float, float],
        step_size: float,
        known: FloatArray,
    ) -> StepInputs:
        """In a step from the newest point of ``history``, with what is ``known`` at its end."""
        ahead = self._scheme.known_ahead
        if ahead:
            history = history.pushed(ends[1], self._coupled.inputs_of(known))
        return self._scheme.extrapolation.in_step(history, polynomials, step_size, ahead)


class PartialDoubleStepper(DoubleStepper):
    """Takes the double steps of the slaves that can go back, where not all can.

    Their inputs from the others have the polynomial through the communication points up to T_n in
    all steps: no newer value is known, and the comparison solution cannot tell its error. Output
    columns of the others are 0.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        scheme: how they are coupled within a step.
        estimator: which comparison solution to compute.
    """

    def __init__(
        self,
        group: SlaveGroup,
        coupled: CoupledSystem,
        scheme: CouplingScheme,
        estimator: ErrorEstimator,
    ) -> None:
        super().__init__(group, coupled, scheme, estimator)
        kinds = np.array([kind.late for kind in scheme.extrapolation.kinds])
        self._late_inputs = np.flatnonzero(kinds[scheme.extrapolation.kind_of_input])

    def _attempt(
        self,
        history: CouplingHistory,
        times: DoubleStepTimes,
        polynomials: Polynomials,
        outputs: Outputs,
    ) -> DoubleStep:
        self._begin = times.begin
        self._from_begin = self._scheme.extrapolation.signal(history, polynomials)
        return super()._attempt(history, times, polynomials, outputs)

    def _inputs(
        self,
        history: CouplingHistory,
        polynomials: Polynomials,
        ends: tuple[float, float],
        step_size: float,
        known: FloatArray,
    ) -> StepInputs:
        found = super()._inputs(history, polynomials, ends, step_size, known)
        for derivatives, time in zip(found, ends, strict=True):
            late = self._from_begin.shifted(time - self._begin).derivatives
            derivatives[:, self._late_inputs] = late[:, self._late_inputs]
        return found
