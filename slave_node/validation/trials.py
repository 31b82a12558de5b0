"""``slave-node validate``: what a model can do, found out by doing it, and what follows from that.

The model runs in a process of its own, which is started anew after whatever ends it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import factorial
from pathlib import Path

import numpy as np

from protocol.calls import (
    Call,
    Configure,
    DoStep,
    Examine,
    ExitInitializationMode,
    GetDiscreteOutputs,
    GetOutputs,
    Initialize,
    Reply,
    Reset,
    SetInputs,
    StepResult,
    StepStatus,
    Terminate,
)
from protocol.description import (
    Examination,
    InputDerivatives,
    SlaveDescription,
    StateKind,
    StateVerdict,
)
from protocol.errors import (
    DeadlineError,
    DoublestepError,
    FatalSlaveError,
    SlaveCrashedError,
    SlaveError,
    StepRejectedError,
)
from protocol.host.files import is_fmu
from protocol.signals import MAX_ORDER, FloatArray
from protocol.variables import Causality
from protocol.wire.programs import encode_program
from protocol.wire.replies import decode_reply
from slave_node.trials.steps import STEPS
from slave_node.worker.process import ModelReference, Worker, WorkerProcess

DEFAULT_STEP_SIZE = 1e-2
DEFAULT_TIMEOUT = 60.0
"""For each trial [s]; where nothing hangs none takes a fraction of that."""

_STEPS = 10
_SHRINKS = 4
_SHRINK = 0.1
"""So often, and by so much, steps are made smaller that the model does not take."""

_KEEPS_ZERO_STEPS = "FMI 3.0 co-simulation"
"""Whose adapter has nothing to ask the FMU for in a step of size zero."""

_LADDER = (StateKind.NATIVE, StateKind.FORK, StateKind.REPLAY, StateKind.NONE)


class Grade(StrEnum):
    """Grade of a finding."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report.

    Attributes:
        what: was tried.
        grade: ``PROBLEM``: the model cannot be run; ``NOTE``: not as well as it could.
        result: what was seen.
        consequence: what Doublestep does about it.
    """

    what: str
    grade: Grade
    result: str
    consequence: str = ""


def validate(
    model: str,
    base: Path,
    step_size: float | None = None,
    *,
    timeout: float = DEFAULT_TIMEOUT,
    worker: Callable[[ModelReference], Worker] = WorkerProcess,
) -> Iterator[Finding]:
    """Try a model and report, finding by finding.

    Args:
        model: see `slave_node.loading.load_slave`.
        base: directory to which its path is relative.
        step_size: of the trial steps [s]; None: what the model recommends, or 10 ms.
        timeout: bound on each trial [s], after which the worker is killed.
        worker: makes the one that runs it.

    Raises:
        ModelError: the model is missing or cannot be read.
    """
    if is_fmu(model, base):
        yield _description((base / model).resolve())
    trial = _Trial(worker(ModelReference(model, base, "validated")), timeout)
    try:
        description = trial.start()
        size = step_size or description.fixed_step_size or description.default_step_size
        yield from _Validation(trial, description, size or DEFAULT_STEP_SIZE).findings()
    except DoublestepError as error:
        yield Finding("load", Grade.PROBLEM, error.cause, error.remedy or "it cannot be run here")
    finally:
        trial.stop()


def _description(fmu: Path) -> Finding:
    from slave_node.fmu.validation import check_description  # noqa: PLC0415  only for FMUs

    problems, has_parsed_names = check_description(fmu)
    if not problems:
        result = "valid" if has_parsed_names else "valid; too many names to parse all of them"
        return Finding("model description", Grade.OK, result)
    more = f"; and {len(problems) - 3} more" if len(problems) > 3 else ""
    text = "; ".join(problem[:160].rstrip(".") for problem in problems[:3])
    return Finding("model description", Grade.NOTE, text + more, "it is read as far as it goes")


class _Trial:
    """A model that is loaded again and again: what it does to one trial no other one sees."""

    def __init__(self, worker: Worker, timeout: float) -> None:
        self._worker = worker
        self._timeout = timeout
        self._is_fresh = True

    def start(self) -> SlaveDescription:
        return self._worker.start()

    def stop(self) -> None:
        self._worker.stop()

    def run(self, *calls: Call) -> Reply:
        """Execute calls; the death of the process is the reply's error, and so is no answer."""
        is_late = threading.Event()

        def end() -> None:
            is_late.set()
            self._worker.kill()

        timer = threading.Timer(self._timeout, end)
        timer.start()
        try:
            return decode_reply(calls, self._worker.execute(encode_program(calls)))
        except DoublestepError as error:
            if is_late.is_set():
                late = DeadlineError(f"no answer within {self._timeout:g} s", phase=calls[-1].verb)
                return Reply([], late, 0.0)
            return Reply([], error, 0.0)
        finally:
            timer.cancel()

    def again(self, *calls: Call, configuration: Configure | None = None) -> Reply:
        """Execute calls on the model as it was loaded."""
        if not self._is_fresh and self.run(Reset(loads=True)).error is not None:
            self._worker.start()
        self._is_fresh = False
        if configuration is not None:
            reply = self.run(configuration)
            if reply.error is not None:
                return reply
        return self.run(*calls)


class _Validation:
    """The tests of one model.

    Args:
        trial: the model.
        description: of it.
        step_size: h [s].
    """

    def __init__(self, trial: _Trial, description: SlaveDescription, step_size: float) -> None:
        self._trial = trial
        self._description = description
        self._h = step_size
        self._variables = {v.name: v for v in description.variables}
        self._inputs = tuple(
            v.name for v in description.of(Causality.INPUT) if v.is_continuous_real
        )
        outputs = description.of(Causality.OUTPUT)
        self._outputs = tuple(v.name for v in outputs if v.is_continuous_real)
        discrete = tuple(v.name for v in outputs if v.is_discrete)
        self._output_names = (*self._outputs, *discrete)
        self._starts = np.array(
            [[float(self._variables[name].start or 0.0) for name in self._inputs]]
        )
        self._not_repeating: tuple[str, ...] = ()
        self._poor: set[str] = set()
        self._reads_derivatives = True
        self._begin: tuple[Call, ...] = (
            Initialize(inputs=self._inputs, outputs=self._outputs, discrete_outputs=discrete),
            SetInputs(self._starts),
            ExitInitializationMode(),
        )

    def findings(self) -> Iterator[Finding]:
        """All of them, as they come; after a problem no more."""
        for remark in self._description.remarks:
            yield Finding("remark", Grade.NOTE, remark)
        for test in (self._initialization, self._steps):
            finding = test()
            yield finding
            if finding.grade is Grade.PROBLEM:
                return
        yield self._variable_steps()
        yield self._zero_step()
        yield self._wrong_point()
        yield self._input_derivatives()
        yield self._output_derivatives()
        yield from self._states()
        yield self._end()

    # --- the tests ------------------------------------------------------------------------------

    def _initialization(self) -> Finding:
        reply = self._trial.again(*self._begin, GetOutputs(), GetDiscreteOutputs())
        if reply.error is not None:
            consequence = "it cannot be run with its start values; give others in parameters"
            if isinstance(reply.error, FatalSlaveError):
                consequence = "it cannot be run here: the FMU gave up"
            result = f"{reply.error.phase}: {reply.error.cause}"
            return Finding("initialize", Grade.PROBLEM, result, consequence)
        y: FloatArray = reply.results[-2]  # type: ignore[assignment]
        bad = [name for name, value in zip(self._outputs, y[0], strict=True) if value - value != 0]
        if bad:
            return Finding(
                "initialize", Grade.PROBLEM, f"{bad[0]} is not finite", "a run would not start"
            )
        inputs, outputs = map(self._description.of, (Causality.INPUT, Causality.OUTPUT))
        return Finding("initialize", Grade.OK, f"inputs: {len(inputs)}, outputs: {len(outputs)}")

    def _steps(self) -> Finding:
        """Also finds a size of steps that the model takes, for what is tried after this."""
        what = f"{_STEPS} steps of {self._h:g} s"
        reply = self._trial.again(*self._begin, *self._equal_steps(_STEPS))
        problem = _failure(reply)
        if problem is None:
            return Finding(what, Grade.OK, "taken")
        if not _is_not_completed(reply):
            return Finding(
                what, Grade.PROBLEM, problem, "try another --step-size, or look at the FMU's log"
            )
        for _ in range(_SHRINKS if self._takes_any_step else 0):
            self._h *= _SHRINK
            if _failure(self._trial.again(*self._begin, *self._equal_steps(_STEPS))) is None:
                result = f"{problem}; steps of {self._h:g} s are taken"
                return Finding(what, Grade.NOTE, result, "steps not completed are made smaller")
        return Finding(
            what, Grade.PROBLEM, f"{problem}; no smaller ones either", "try another --step-size"
        )

    def _variable_steps(self) -> Finding:
        what = "steps of changing size"
        if not self._takes_any_step:
            fixed = self._description.fixed_step_size
            consequence = "give step_size, or use --estimator none"
            if fixed is not None:
                consequence = f"communication steps are multiples of {fixed:g} s"
            return Finding(what, Grade.NOTE, "not declared", consequence)
        sizes = (self._h, 0.5 * self._h, 0.7 * self._h, 1.3 * self._h)
        calls, time = [], 0.0
        for size in sizes:
            calls.append(DoStep(time, size))
            time += size
        problem = _failure(self._trial.again(*self._begin, *calls))
        if problem is None:
            return Finding(what, Grade.OK, "taken")
        return Finding(what, Grade.NOTE, problem, "give step_size or step_multiple")

    def _zero_step(self) -> Finding:
        what, consequence = "a step of size zero", "none is ever asked for"
        if self._description.kind == _KEEPS_ZERO_STEPS:
            return Finding(what, Grade.OK, "does not reach the FMU", consequence)
        reply = self._trial.again(*self._begin, DoStep(0.0, 0.0))
        result = "taken" if _failure(reply) is None else "refused"
        return Finding(what, Grade.OK, result, consequence)

    def _wrong_point(self) -> Finding:
        reply = self._trial.again(
            *self._begin, DoStep(0.0, self._h), DoStep(1.5 * self._h, self._h)
        )
        result = "not noticed" if _failure(reply) is None else "refused"
        return Finding("a step from elsewhere", Grade.OK, result, "none is ever asked for")

    def _input_derivatives(self) -> Finding:
        what = "input derivatives"
        kind = self._description.input_derivatives
        if not self._inputs:
            return Finding(what, Grade.OK, "no continuous inputs")
        if kind is not InputDerivatives.NATIVE:
            consequence = {
                InputDerivatives.EMULATED: "inputs are followed in substeps",
                InputDerivatives.NONE: "inputs are constant in each step",
            }[kind]
            return Finding(what, Grade.NOTE, "not taken by the model", consequence)
        refusal = ""
        for order in range(MAX_ORDER, 0, -1):
            rows = np.zeros((order + 1, len(self._inputs)))
            rows[0], rows[1:] = self._starts[0], 1e-3
            reply = self._trial.again(*self._begin, SetInputs(rows), DoStep(0.0, self._h))
            problem = _failure(reply)
            if problem is None:
                break
            refusal = problem
        else:
            order = 0
        used = self._highest_order_used(order)
        if used < order:
            order, refusal = used, f"those of order {used + 1} change nothing"
        if order == MAX_ORDER:
            return Finding(what, Grade.OK, f"up to order {order}")
        return Finding(
            what,
            Grade.NOTE,
            f"up to order {order}, then: {refusal}",
            "where higher ones are wanted, inputs are followed in substeps",
        )

    def _highest_order_used(self, order: int) -> int:
        """Up to which order derivatives change what a step leads to.

        ``order`` too where the inputs change nothing at all.
        """
        held = np.zeros((order + 1, len(self._inputs)))
        held[0] = self._starts[0]

        def behind(inputs: FloatArray) -> bytes:
            reply = self._trial.again(
                *self._begin, SetInputs(inputs), DoStep(0.0, self._h), GetOutputs()
            )
            outputs = reply.results[-1] if reply.error is None else None
            return outputs.tobytes() if isinstance(outputs, np.ndarray) else b""

        def is_used(k: int) -> bool:
            inputs = held.copy()
            inputs[k] += self._changes() * factorial(k) / self._h**k
            return behind(inputs) != without

        without = behind(held)
        if not order or not is_used(0):
            return order
        return next((k - 1 for k in range(1, order + 1) if not is_used(k)), order)

    def _output_derivatives(self) -> Finding:
        what = "output derivatives"
        if not self._description.capabilities.max_output_derivative_order or not self._outputs:
            return Finding(what, Grade.OK, "none", "input polynomials meet values only")
        if not self._takes_any_step:
            return Finding(what, Grade.OK, "not compared: that takes steps of any size")
        reply = self._trial.again(
            *self._begin,
            GetOutputs(1),
            Examine(
                0.0, self._h, inputs=tuple(self._moved()[0]), input_changes=tuple(self._changes())
            ),
            configuration=Configure(state_kind=StateKind.NONE),
        )
        if reply.error is not None:
            self._reads_derivatives = False
            problem = f"{reply.error.phase}: {reply.error.cause}"
            return Finding(what, Grade.NOTE, problem, "they are not used")
        examination = reply.results[-1]
        assert isinstance(examination, Examination)
        poor = examination.poor_derivatives
        self._poor = set(poor)
        if poor:
            return Finding(what, Grade.NOTE, _reasons(poor), "they are not used")
        return Finding(what, Grade.OK, "agree with differences", "input polynomials meet them")

    def _states(self) -> Iterator[Finding]:
        """Each way to save states, from the model's best one down to the first that can be used."""
        for kind in _LADDER[_LADDER.index(self._description.state_kind) :]:
            what = f"saved states, {kind}"
            if kind is StateKind.NONE:
                yield Finding(
                    what,
                    Grade.NOTE,
                    self._description.state_reason or "no way to save states",
                    "steps cannot be taken back: its coupling is controlled by input defects",
                )
                return
            reply = self._examined(kind)
            known = self._not_repeating
            while set(_clocks(reply)) > set(self._not_repeating):
                self._not_repeating = _clocks(reply)
                reply = self._examined(kind)
            clocks = [n for n in self._output_names if n in {*self._not_repeating} - {*known}]
            if clocks:
                yield Finding(
                    f"outputs that do not repeat, {kind}",
                    Grade.NOTE,
                    ", ".join(clocks),
                    "compared with nothing, and kept out of ERR, if nothing is connected to them",
                )
            if isinstance(reply.error, DeadlineError):
                yield Finding(
                    what,
                    Grade.NOTE,
                    f"{reply.error.cause} {self._in_trial_steps}",
                    "in a run steps are waited for up to step_timeout",
                )
                return
            if reply.error is not None:
                ended = isinstance(reply.error, SlaveCrashedError)
                result = reply.error.cause + (f" {self._in_trial_steps}" if ended else "")
                yield Finding(what, Grade.NOTE, result, "the next way is taken")
                continue
            examination: Examination = reply.results[-1]  # type: ignore[assignment]
            yield _verdict(what, examination)
            if examination.state_verdict is StateVerdict.NOT_TESTED:
                return
            if examination.state_verdict in (StateVerdict.EXACT, StateVerdict.RESTARTS_SOLVER):
                poor = examination.poor_derivatives
                more = {name: reason for name, reason in poor.items() if name not in self._poor}
                if more:
                    what = "output derivatives, going back"
                    yield Finding(what, Grade.NOTE, _reasons(more), "they are not used")
                yield from _behaviour(examination, takes_any_step=self._takes_any_step)
                return

    def _examined(self, kind: StateKind) -> Reply:
        """Trial steps with states that are saved in this way."""
        return self._trial.again(
            *self._begin,
            SetInputs(self._moved()),
            Examine(
                0.0,
                self._h,
                inputs=tuple(self._moved()[0]),
                input_changes=tuple(self._changes()),
                output_derivatives=self._reads_derivatives,
                not_repeating=self._not_repeating,
            ),
            configuration=Configure(state_kind=kind, not_repeating=self._not_repeating),
        )

    @property
    def _in_trial_steps(self) -> str:
        return f"in trial steps of up to {STEPS * self._h:g} s"

    @property
    def _takes_any_step(self) -> bool:
        return self._description.capabilities.can_handle_variable_step_size

    def _moved(self) -> FloatArray:
        """The start values a little moved: at an equilibrium nothing moves."""
        return self._starts + self._changes()

    def _changes(self) -> FloatArray:
        """By how much the inputs may be moved, shape (n,)."""
        nominal = [self._variables[name].nominal for name in self._inputs]
        changes: FloatArray = 0.01 * np.maximum(np.abs(self._starts[0]), nominal)
        return changes

    def _end(self) -> Finding:
        """Behind a reset a model begins where it began before."""
        what, instead = "terminate and reset", "it is loaded anew instead"
        begin, step = self._begin, DoStep(0.0, self._h)
        once = (*begin, GetOutputs(), step, Terminate())
        reply = self._trial.again(*once)
        if reply.error is not None:
            return Finding(what, Grade.NOTE, f"{reply.error.phase}: {reply.error.cause}", instead)
        again = self._trial.run(Reset(), *begin, GetOutputs())
        if again.error is not None:
            problem = f"its reset is broken: {again.error.phase}: {again.error.cause}"
            return Finding(what, Grade.NOTE, problem, instead)
        before, after = reply.results[len(begin)], again.results[-1]
        assert isinstance(before, np.ndarray)
        assert isinstance(after, np.ndarray)
        clocks = [i for i, name in enumerate(self._outputs) if name in self._not_repeating]
        if not np.array_equal(np.delete(before, clocks, 1), np.delete(after, clocks, 1)):
            problem = "its reset is broken: its outputs at the start are others than before"
            return Finding(what, Grade.NOTE, problem, instead)
        return Finding(what, Grade.OK, "done")

    def _equal_steps(self, number: int) -> Iterator[Call]:
        time = 0.0
        for _ in range(number):
            yield DoStep(time, self._h)
            yield GetOutputs()
            time += self._h


def _failure(reply: Reply) -> str | None:
    """Why not all was done as it should be; None if it was."""
    if reply.error is not None:
        return f"{reply.error.phase}: {reply.error.cause}"
    for result in reply.results:
        if isinstance(result, StepResult) and result.status is not StepStatus.OK:
            return f"do_step: {result.status} at t={result.time:g} s"
        if isinstance(result, np.ndarray) and not np.isfinite(result).all():
            return "an output is not finite"
    return None


def _clocks(reply: Reply) -> tuple[str, ...]:
    """The outputs that do not repeat, as trial steps showed."""
    examination = reply.results[-1] if reply.error is None else None
    return examination.not_repeating if isinstance(examination, Examination) else ()


def _reasons(poor: Mapping[str, str]) -> str:
    """Reason why the derivatives of outputs cannot be used."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in poor.items():
        by_reason.setdefault(reason, []).append(name)
    return "; ".join(f"those of {', '.join(names)} are {r}" for r, names in by_reason.items())


def _is_not_completed(reply: Reply) -> bool:
    """True if the last step was rejected or ended early: a run repeats that, smaller."""
    if reply.error is not None:
        return isinstance(reply.error, StepRejectedError)
    return bool(reply.results) and isinstance(reply.results[-1], StepResult)


def _verdict(what: str, examination: Examination) -> Finding:
    verdict, reason = examination.state_verdict, examination.state_reason
    match verdict:
        case StateVerdict.EXACT:
            if reason:
                return Finding(what, Grade.NOTE, f"exact to the bit; {reason}", "used")
            return Finding(what, Grade.OK, "exact to the bit", "steps can be taken back")
        case StateVerdict.RESTARTS_SOLVER:
            result = f"repeats, but restarts the solver: {reason} ({examination.difference:.1g})"
            return Finding(what, Grade.NOTE, result, "used, with a warning")
        case StateVerdict.NOT_TESTED:
            return Finding(what, Grade.NOTE, f"not tested: {reason}", "used, with a warning")
        case _:
            return Finding(what, Grade.NOTE, f"{verdict}: {reason}", "the next way is taken")


def _behaviour(examination: Examination, *, takes_any_step: bool) -> Iterator[Finding]:
    """Findings of trials with steps of several sizes, if the model takes them."""
    if not takes_any_step:
        return
    clock = examination.internal_clock
    if clock is not None:
        yield Finding(
            "internal clock",
            Grade.NOTE,
            f"outputs move only at multiples of {clock:g} s",
            "communication steps are multiples of that",
        )
        return
    dependence = examination.step_dependence
    if dependence > 1.0:
        largest = examination.largest_substep
        yield Finding(
            "one step against two",
            Grade.NOTE,
            f"differ by {dependence:.2g} times the tolerance 1e-4",
            "use EST_Rich" if largest is None else f"its steps are split into {largest:.2g} s",
        )
    else:
        yield Finding("one step against two", Grade.OK, "agree")


def is_usable(findings: list[Finding]) -> bool:
    """True if the model can be run."""
    return all(finding.grade is not Grade.PROBLEM for finding in findings)


def unusable(model: str) -> SlaveError:
    """Error with which the command ends for a model that cannot be run."""
    return SlaveError(f"{model} cannot be run", remedy="see the problem in the report")
