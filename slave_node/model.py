"""`Model`: the base class of a slave that is written in Python.

::

    x' = f(t, x, u)      states,  shape (n_x,)
    y  = g(t, x, u)      outputs, shape (n_y,), of the inputs u, shape (n_u,)

A model declares its variables and writes f and g; n_x may be 0, and then there is only g::

    class Spring(Model):
        inputs = (real("x", "m"), real("v", "m/s"))
        outputs = (real("F", "N"),)
        parameters = (real("c", "N/m", start=1e3), real("d", "N.s/m", start=10.0))
        feed_through = {"F": ("x", "v")}

        def output_values(self, t, x, u):
            return [-self.c * u[0] - self.d * u[1]]
"""
# ruff: noqa: ARG002 - every model has the same signatures, whatever it needs of them

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from protocol.description import Capabilities, InputDerivatives, SlaveDescription, StateKind
from protocol.errors import ModelError
from protocol.signals import FloatArray
from protocol.text.names import nearest
from protocol.variables import Causality, Variable

Values = FloatArray | Sequence[float]
"""Values that a model may return: an array, or a list or tuple of numbers."""


def real(
    name: str,
    unit: str = "",
    *,
    start: float = 0.0,
    nominal: float = 1.0,
    description: str = "",
    tunable: bool = False,
) -> Variable:
    """Declare a real variable; where it is listed in the `Model` says what it is.

    Args:
        name: unique within the model.
        unit: such as ``N.s/m``.
        start: start value [unit]; not used for an output that is not a state.
        nominal: typical size [unit], positive; for a state it scales the absolute tolerance.
        description: one line for the user.
        tunable: whether it may change during a run, if it is a parameter.
    """
    return Variable(
        name,
        unit=unit,
        start=start,
        nominal=nominal,
        description=description,
        variability="tunable" if tunable else "continuous",
    )


class Model:
    """Base class of Python models. Subclasses fill in the class attributes and the methods.

    The methods must be functions of their arguments and the parameters alone, and must not write
    to their arguments: what a model remembered elsewhere would not be saved and restored with the
    slave's state. Where they have no value (a division by zero, a logarithm of a negative number)
    they may return NaN or raise an `ArithmeticError` or a `ValueError`: the step is rejected, and
    a smaller one may succeed. Any other exception ends the simulation.

    Attributes:
        inputs: real and continuous, n_u of them, in the order of u.
        outputs: real and continuous, n_y of them, in the order of y. A state is made an output
            by listing the same declaration here; ``outputs = states`` lists all.
        states: real and continuous, n_x of them, in the order of x.
        parameters: of any type. Each becomes an attribute of the instance, ``self.m``.
        feed_through: for each output the inputs that g itself uses. Outputs not named use none.
        max_step: longest communication step that is taken whole [s]; a longer one is discarded
            there. None or 0: any. May be a parameter.
        solver: name of SciPy's integrator: RK45, RK23 or DOP853, for stiff models Radau or BDF.
    """

    inputs: ClassVar[tuple[Variable, ...]] = ()
    outputs: ClassVar[tuple[Variable, ...]] = ()
    states: ClassVar[tuple[Variable, ...]] = ()
    parameters: ClassVar[tuple[Variable, ...]] = ()
    feed_through: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    max_step: float | None = None
    solver: ClassVar[str] = "RK45"

    def __init__(self) -> None:
        for parameter in self.parameters:
            setattr(self, parameter.name, parameter.start)
        index = {state.name: i for i, state in enumerate(self.states)}
        self._output_states = np.array([index.get(y.name, -1) for y in self.outputs], dtype=np.intp)

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """The parameters, for type checkers."""

    def prepare(self) -> None:
        """Compute what depends on the parameters alone. Called whenever they are set."""

    def derivatives(self, t: float, x: FloatArray, u: FloatArray) -> Values:
        """The right-hand side f: x', shape (n_x,), unit [x]/s. To be written if n_x > 0."""
        raise NotImplementedError

    def output_values(self, t: float, x: FloatArray, u: FloatArray) -> Values:
        """The outputs g: y, shape (n_y,). To be written unless every output is a state."""
        return x[self._output_states]

    def output_derivatives(
        self, t: float, x: FloatArray, u: FloatArray, dx: FloatArray, du: FloatArray
    ) -> Values:
        """The outputs' total time derivatives: y', shape (n_y,), unit [y]/s.

        ``dx`` is x', ``du`` is u'. Not written, and not every output a state: the slave has none.
        """
        return dx[self._output_states]


def describe(model: type[Model]) -> SlaveDescription:
    """Description of a model class for a master, after a check of its declarations.

    Variables come in the order inputs, outputs, states that are no outputs, parameters.

    Raises:
        ModelError: the declarations contradict each other, or a method is missing.
    """
    _check_variables(model)
    _check_feed_through(model)
    _check_methods(model)
    state_names = {state.name for state in model.states}
    output_names = {output.name for output in model.outputs}
    variables = (
        *(replace(v, causality=Causality.INPUT) for v in model.inputs),
        *(
            replace(v, causality=Causality.OUTPUT, start=v.start if v.name in state_names else None)
            for v in model.outputs
        ),
        *(
            replace(v, causality=Causality.LOCAL)
            for v in model.states
            if v.name not in output_names
        ),
        *(
            replace(
                v,
                causality=Causality.PARAMETER,
                variability="tunable" if v.variability == "tunable" else "fixed",
            )
            for v in model.parameters
        ),
    )
    local_states = [state.name for state in model.states if state.name not in output_names]
    has_output_derivatives = _overrides(model, "output_derivatives") or (
        output_names <= state_names and not _overrides(model, "output_values")
    )
    return SlaveDescription(
        model=model.__name__,
        kind="Python model",
        sha256=_source_sha256(model),
        variables=variables,
        capabilities=Capabilities(
            can_get_and_set_state=True,
            can_serialize_state=True,
            can_interpolate_inputs=True,
            max_output_derivative_order=1 if has_output_derivatives else 0,
            can_handle_variable_step_size=True,
            outputs_follow_inputs=True,
        ),
        feed_through={**dict.fromkeys(local_states, ()), **model.feed_through},
        initial_feed_through={**dict.fromkeys(local_states, ()), **model.feed_through},
        state_kind=StateKind.NATIVE,
        input_derivatives=InputDerivatives.NATIVE,
    )


def _overrides(model: type[Model], method: str) -> bool:
    return getattr(model, method) is not getattr(Model, method)


def _check_variables(model: type[Model]) -> None:
    seen: dict[str, Variable] = {}
    for kind in ("inputs", "states", "outputs", "parameters"):
        names = set()
        for v in getattr(model, kind):
            where = f"{model.__name__}.{kind}"
            if not isinstance(v, Variable):
                raise ModelError(f"{where}: {v!r} is not a variable", remedy="declare it by real()")
            where += f": '{v.name}'"
            is_output_state = kind == "outputs" and v in model.states
            if v.name in names or (v.name in seen and not is_output_state):
                raise ModelError(f"{where} is declared twice")
            names.add(v.name)
            seen[v.name] = v
            if kind == "parameters":
                if not v.name.isidentifier() or (hasattr(Model, v.name) and v.name != "max_step"):
                    raise ModelError(f"{where} cannot be the name of a parameter")
                if v.start is None:
                    raise ModelError(f"{where} has no start value")
            elif not v.is_continuous_real:
                raise ModelError(f"{where} is not real and continuous")
            elif not v.nominal > 0.0:
                raise ModelError(f"{where} has the nominal value {v.nominal!r}, which is not > 0")


def _check_feed_through(model: type[Model]) -> None:
    outputs = [v.name for v in model.outputs]
    inputs = [v.name for v in model.inputs]
    for output, used in model.feed_through.items():
        for kind, name, names in [
            ("output", output, outputs),
            *(("input", name, inputs) for name in used),
        ]:
            if name not in names:
                raise ModelError(
                    f"{model.__name__}.feed_through: no {kind} '{name}'{nearest(name, names)}"
                )


def _check_methods(model: type[Model]) -> None:
    if model.states and not _overrides(model, "derivatives"):
        raise ModelError(f"{model.__name__} has states but no method derivatives()")
    computed = [v.name for v in model.outputs if v not in model.states]
    if computed and not _overrides(model, "output_values"):
        raise ModelError(
            f"{model.__name__} has no method output_values(), and '{computed[0]}' is not a state"
        )


def _source_sha256(model: type[Model]) -> str:
    """Hash of the file that defines the class; of its qualified name where there is no file."""
    try:
        source = Path(inspect.getfile(model)).read_bytes()
    except (OSError, TypeError):
        source = f"{model.__module__}.{model.__qualname__}".encode()
    return hashlib.sha256(source).hexdigest()
