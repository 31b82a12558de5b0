"""Table ``[simulation]``: what of the method a user sets."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from math import inf
from typing import Annotated, Any, Literal, Self

from pydantic import (
    Field,
    StrictBool,
    StrictStr,
    field_validator,
    model_validator,
)

from master_node.numerics.dense_output import OutputGrid
from master_node.numerics.error_estimators import EST_MOD, ESTIMATORS
from master_node.numerics.extrapolation import InputPolynomial
from master_node.numerics.step_size_controller import EXPONENTS
from master_node.system.fields import (
    FrozenTable,
    NotNegative,
    Number,
    Positive,
    one_of,
)
from protocol.errors import ConfigurationError
from protocol.signals import MAX_ORDER

_SHORTEST_TIME = 1e-30
_LONGEST_TIME = 1e30
"""Bounds of the simulated time [s]: fifth powers of step sizes have to be numbers."""

_MAX_POINTS = 1e8
"""Largest number of results that may be asked for by their interval."""

_STEPS_AT_REST = 32
"""Number of steps that the simulated time is split into at least, where nothing asks for more."""

PAPER: Mapping[str, Any] = {
    "order": 1,
    "derivative_points": 0,
    "constants": "paper",
    "controller": "elementary",
    "discontinuities": False,
    "initial_history": "rest",
    "coupling": "explicit",
}
"""Settings that ``preset = "paper"`` stands for; keys that are given beside it win."""


class SimulationSettings(FrozenTable):
    """The ``[simulation]`` table.

    Attributes:
        preset: ``paper``: the method as Schierz, Arnold and Clauß have it: values only, the
            constants of an equidistant history, the elementary controller.
        start_time, stop_time: [s].
        initial_step_size: H_0 [s]; default: chosen by the system. With estimator ``none`` it is
            the step size of the whole run, by default a thousandth of the simulated time.
        order: degree k of the input polynomials, or ``auto``: chosen for each step.
        derivative_points: at how many of the newest points an input polynomial meets the
            derivatives of the outputs too, where slaves have them; default: 0 with a given
            ``order``, up to 2 with ``auto``.
        estimator: EST_Rich, EST_mod or none (a fixed step).
        constants: of the estimators: ``exact`` for the nodes there are, or the ``paper``'s.
        controller: of the step size: ``pi`` or ``elementary``.
        sequence: ``jacobi``: all slaves take a step at once, with extrapolated inputs;
            ``gauss-seidel``: one after the other, with what the earlier ones have found.
        coupling: ``explicit``: inputs are extrapolated; ``implicit``: each double step is iterated
            until its inputs agree with the outputs; ``auto``: that, where the coupling is stiff.
        evaluate_outputs: evaluate outputs with direct feed-through again at each communication
            point, with the inputs that are known there by then.
        discontinuities: find jumps of the coupled variables, step up to them, and cut the history.
        events: times at which something jumps [s]; a communication point is put there and the
            history cut.
        relative_tolerance, absolute_tolerance: RTOL and ATOL of equation (8) for all outputs;
            ATOL counts in units of a variable's nominal value.
        slave_tolerance: relative tolerance for the slaves' own solvers; default 0.01 RTOL.
        alpha, theta_min, theta_max: of the step size controller (the paper, section 3).
        smallest_step_size, largest_step_size: bounds of H [s]; defaults: 1e-9 of the simulated
            time, and half of it; but see `largest_at_rest`.
        initial_history: ``rest``: the system rested before the start, so order k is used from
            the first step; ``none``: the order grows as communication points come in. Default:
            ``none`` where the order is chosen, else ``rest``.
        output_interval: write results at start_time + i output_interval [s], by dense output,
            instead of at the communication points.
        recovery: ``auto``: a slave process that died is started again, restored, and the run goes
            on; ``off``: it ends the run.
        checkpoint_interval: wall-clock time between two checkpoints for ``master-node resume``
            [s]; 0: none are written.
        examine: let the slaves take trial steps before the first step, see ``examinations.py``.
    """

    preset: Literal["paper"] | None = None
    start_time: Number = 0.0
    stop_time: Number | None = None
    initial_step_size: Positive | None = None
    order: Literal[0, 1, 2, 3, "auto"] = "auto"
    derivative_points: Literal[0, 1, 2] | None = None
    estimator: Annotated[StrictStr, one_of(*ESTIMATORS, "none")] = EST_MOD.name
    constants: Literal["exact", "paper"] = "exact"
    controller: Annotated[StrictStr, one_of(*EXPONENTS)] = "pi"
    sequence: Literal["jacobi", "gauss-seidel"] = "jacobi"
    coupling: Literal["auto", "explicit", "implicit"] = "auto"
    evaluate_outputs: StrictBool = False
    discontinuities: StrictBool = True
    events: tuple[Number, ...] = ()
    relative_tolerance: NotNegative = 1e-4
    absolute_tolerance: Positive = 1e-4
    slave_tolerance: Positive | None = None
    alpha: Annotated[Number, Field(gt=0, lt=1)] = 0.85
    theta_min: Annotated[Number, Field(gt=0, lt=1)] = 0.3
    theta_max: Annotated[Number, Field(gt=1)] = 2.0
    smallest_step_size: Positive | None = None
    largest_step_size: Positive | None = None
    initial_history: Literal["rest", "none"] | None = None
    output_interval: Positive | None = None
    recovery: Literal["auto", "off"] = "auto"
    checkpoint_interval: NotNegative = 10.0
    examine: StrictBool = True

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, value: Any) -> Any:
        if isinstance(value, Mapping) and value.get("preset") == "paper":
            return {**PAPER, **value}
        return value

    @field_validator("order", "derivative_points", mode="before")
    @classmethod
    def _whole_number(cls, value: Any) -> Any:
        if isinstance(value, bool):
            raise ValueError("must be a whole number")  # noqa: TRY004  pydantic wants ValueError
        return value

    @model_validator(mode="after")
    def _polynomials(self) -> Self:
        if self.derivative_points:
            if self.constants == "paper":
                raise ValueError(
                    'constants = "paper" hold for values only: they need derivative_points = 0'
                )
            if self.order != "auto" and self.derivative_points > (self.order + 1) // 2:
                raise ValueError(
                    f"a polynomial of order {self.order} cannot meet derivatives at "
                    f"{self.derivative_points} points"
                )
        if self.events and self.estimator == "none":
            raise ValueError("events need an estimator: without one all steps have one size")
        if self.constants == "paper" and self.sequence == "gauss-seidel":
            raise ValueError('constants = "paper" hold for sequence = "jacobi" only')
        return self

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.stop_time is None:
            return self
        duration = self.stop_time - self.start_time
        if duration <= 0:
            raise ValueError(
                f"stop_time {self.stop_time:g} must be after start_time {self.start_time:g}"
            )
        if not _SHORTEST_TIME <= duration <= _LONGEST_TIME:
            raise ValueError(
                f"{duration:g} s from start_time to stop_time cannot be computed with: between "
                f"{_SHORTEST_TIME:g} and {_LONGEST_TIME:g} s can"
            )
        if self.output_interval is not None and self.output_interval * _MAX_POINTS < duration:
            raise ValueError(
                f"output_interval {self.output_interval:g} gives more than {_MAX_POINTS:g} result "
                "points"
            )
        smallest, initial, largest = self.smallest, self.initial_step_size, self.largest_step_size
        if largest is not None and smallest > largest:
            raise ValueError(
                f"smallest_step_size {smallest:g} is above largest_step_size {largest:g}"
            )
        if initial is not None and initial < smallest:
            raise ValueError(
                f"initial_step_size {initial:g} is below smallest_step_size {smallest:g}"
            )
        if initial is not None and largest is not None and initial > largest:
            raise ValueError(
                f"initial_step_size {initial:g} is above largest_step_size {largest:g}"
            )
        for event in self.events:
            if not self.start_time < event < self.stop_time:
                raise ValueError(f"the event at {event:g} is not between start and stop time")
        return self

    @property
    def end(self) -> float:
        """The stop time [s].

        Raises:
            ConfigurationError: it is not given.
        """
        if self.stop_time is None:
            raise ConfigurationError(
                "[simulation] stop_time is missing", remedy="give it there, or say --stop-time"
            )
        return float(self.stop_time)

    @property
    def step_size(self) -> float:
        """H_0 [s] as given; else a thousandth of the simulated time, within the bounds of H."""
        if self.initial_step_size is not None:
            return float(self.initial_step_size)
        default = max((self.end - self.start_time) * 1e-3, self.smallest_step_size or 0.0)
        return float(min(default, self.largest_step_size or default))

    @property
    def given_step_size(self) -> float | None:
        """H_0 [s], or that of all steps without an estimator; None: chosen at the start."""
        if self.initial_step_size is None and self.estimator != "none":
            return None
        return self.step_size

    @property
    def smallest(self) -> float:
        """Smallest communication step size [s]."""
        return float(
            self.smallest_step_size or min((self.end - self.start_time) * 1e-9, self.step_size)
        )

    @property
    def largest(self) -> float:
        """Largest communication step size [s]; by default two steps, also in decimal digits."""
        if self.largest_step_size:
            return float(self.largest_step_size)
        start, end = float(self.start_time), self.end
        in_decimals = (Fraction(repr(end)) - Fraction(repr(start))) / 2
        return max((end - start) / 2, float(in_decimals))

    @property
    def largest_at_rest(self) -> float:
        """Largest H that is chosen where no estimate bounds it [s]; infinite: none.

        A source that moves for longer than this is met by a communication point, however quiet all
        was before. A given ``largest_step_size`` or ``initial_step_size`` above it wins.
        """
        if self.largest_step_size is not None or self.constants == "paper":
            return inf
        part = (self.end - float(self.start_time)) / _STEPS_AT_REST
        return max(part, self.initial_step_size or 0.0)

    @property
    def polynomial(self) -> InputPolynomial:
        """The input polynomials to use, with ``auto`` the highest that may be chosen.

        Without an estimator there is nothing to choose by, so ``auto`` is order 1 then.
        """
        if self.order != "auto":
            return InputPolynomial(self.order, self.derivative_points or 0)
        if self.estimator == "none":
            return InputPolynomial(1, min(self.derivative_points or 0, 1))
        wanted = 2 if self.derivative_points is None else self.derivative_points
        return InputPolynomial(MAX_ORDER, 0 if self.constants == "paper" else wanted)

    @property
    def rests_before_start(self) -> bool:
        """True if the past of the system is that of one at rest."""
        if self.initial_history is not None:
            return self.initial_history == "rest"
        return self.order != "auto" or self.estimator == "none"

    @property
    def output_grid(self) -> OutputGrid | None:
        """Where results are wanted; None: at the communication points."""
        if self.output_interval is None:
            return None
        return OutputGrid(float(self.start_time), float(self.output_interval), self.end)

    @property
    def slave_relative_tolerance(self) -> float | None:
        """For the slaves' own solvers; None leaves them their default."""
        if self.slave_tolerance is not None:
            return float(self.slave_tolerance)
        return 0.01 * self.relative_tolerance if self.relative_tolerance else None
