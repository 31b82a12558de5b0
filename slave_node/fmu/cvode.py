"""SUNDIALS CVode (BDF, dense Newton) on the bindings of fmpy.

What fmpy.sundials does not bind is bound here. The solver forgets everything when it is restarted,
so that what follows depends on nothing but the arguments of `CVode.restart`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from enum import Enum, auto
from typing import Any

import numpy as np
from fmpy.sundials import (
    NV_DATA_S,
    CVodeSetLinearSolver,
    N_VDestroy_Serial,
    N_VNew_Serial,
    SUNDenseMatrix,
    SUNErrHandlerFn,
    SUNLinSol_Dense,
)
from fmpy.sundials import cvode as bindings
from fmpy.sundials.cvode import (
    CV_BDF,
    CV_ROOT_RETURN,
    CV_SUCCESS,
    CVodeCreate,
    CVodeFree,
    CVodeInit,
    CVodeReInit,
    CVodeRootInit,
    CVodeSetMaxNumSteps,
    CVodeSetMaxStep,
    CVodeSetNoInactiveRootWarn,
    CVodeSVtolerances,
    CVRhsFn,
    CVRootFn,
)
from fmpy.sundials.libraries import sundials_core, sundials_cvode
from fmpy.sundials.sundials_context import SUNContext_Create, SUNContext_PushErrHandler
from fmpy.sundials.sundials_types import SUN_COMM_NULL, SUNContext

from protocol.errors import StepRejectedError
from protocol.signals import FloatArray

_ONE_STEP = 2
_STOP_RETURN = 1
_RECOVERABLE, _UNRECOVERABLE = 1, -1


def _bound(library: Any, name: str, result: Any, *arguments: Any) -> Any:
    function = getattr(library, name)
    function.argtypes = list(arguments)
    function.restype = result
    return function


_ADDRESS, _DOUBLE, _INT = ctypes.c_void_p, ctypes.c_double, ctypes.c_int
_set_first_step = _bound(sundials_cvode, "CVodeSetInitStep", _INT, _ADDRESS, _DOUBLE)
_set_stop_time = _bound(sundials_cvode, "CVodeSetStopTime", _INT, _ADDRESS, _DOUBLE)
_set_max_warnings = _bound(sundials_cvode, "CVodeSetMaxHnilWarns", _INT, _ADDRESS, _INT)
_get_first_step = _bound(
    sundials_cvode, "CVodeGetActualInitStep", _INT, _ADDRESS, ctypes.POINTER(_DOUBLE)
)
_clear_handlers = _bound(sundials_core, "SUNContext_ClearErrHandlers", _INT, SUNContext)
_free_context = _bound(sundials_core, "SUNContext_Free", _INT, ctypes.POINTER(SUNContext))
_free_matrix = _bound(sundials_core, "SUNMatDestroy", None, _ADDRESS)
_free_linear_solver = _bound(sundials_core, "SUNLinSolFree", _INT, _ADDRESS)

Evaluation = Callable[[float, Any, Any], None]
"""Called with the time [s], a pointer to the states, and one to what is to be calculated."""


class Outcome(Enum):
    """End of an internal step."""

    STEP = auto()
    STOP = auto()
    """The stop time is reached."""
    ROOT = auto()
    """A root function changed its sign; the time is just behind that."""


class CVode:
    """Integrates x' = f(t, x), and locates the roots of g(t, x).

    Args:
        n: number of states, at least 1.
        n_roots: number of root functions.
        right_hand_side: evaluates f. A `StepRejectedError` makes the solver try a smaller step,
            all other exceptions come out of `step`.
        roots: evaluates g.

    Attributes:
        x: the states, shape (n,), a view of the solver's own.
    """

    def __init__(
        self, n: int, n_roots: int, right_hand_side: Evaluation, roots: Evaluation
    ) -> None:
        self._failure: Exception | None = None
        self._message = ""
        self._size = n
        self._functions = (
            CVRhsFn(self._guarded_right_hand_side(right_hand_side)),
            CVRootFn(self._guarded_roots(roots)),
            SUNErrHandlerFn(self._keep_message),
        )
        self._context = SUNContext()
        self._require(SUNContext_Create(SUN_COMM_NULL, ctypes.byref(self._context)))
        self._require(_clear_handlers(self._context))
        self._require(SUNContext_PushErrHandler(self._context, self._functions[2], None))
        self._states = N_VNew_Serial(n, self._context)
        self._tolerances = N_VNew_Serial(n, self._context)
        self.x: FloatArray = np.ctypeslib.as_array(NV_DATA_S(self._states), (n,))
        self._absolute = np.ctypeslib.as_array(NV_DATA_S(self._tolerances), (n,))
        self.x[:] = 0.0
        self._absolute[:] = 1.0
        self._memory = CVodeCreate(CV_BDF, self._context)
        self._matrix = SUNDenseMatrix(n, n, self._context)
        self._linear_solver = SUNLinSol_Dense(self._states, self._matrix, self._context)
        memory = self._memory
        self._require(CVodeInit(memory, self._functions[0], 0.0, self._states))
        self._require(CVodeSVtolerances(memory, 1e-6, self._tolerances))
        self._require(CVodeSetLinearSolver(memory, self._linear_solver, self._matrix))
        if n_roots:
            self._require(CVodeRootInit(memory, n_roots, self._functions[1]))
        self._require(CVodeSetMaxNumSteps(memory, -1))  # who calls `step` counts
        self._require(CVodeSetNoInactiveRootWarn(memory))
        self._require(_set_max_warnings(memory, -1))

    def restart(
        self,
        time: float,
        relative_tolerance: float,
        absolute_tolerance: FloatArray,
        *,
        first_step: float = 0.0,
        largest_step: float = 0.0,
    ) -> None:
        """Begin at ``time`` [s] with what ``x`` holds.

        Args:
            time: see above.
            relative_tolerance: of the states.
            absolute_tolerance: of each of them, shape (n,).
            first_step: internal step to try first [s], 0: the solver chooses it.
            largest_step: bound on internal steps [s], 0: none.
        """
        self._absolute[:] = absolute_tolerance
        memory = self._memory
        self._require(CVodeReInit(memory, time, self._states))
        self._require(CVodeSVtolerances(memory, relative_tolerance, self._tolerances))
        self._require(_set_first_step(memory, first_step))
        self._require(CVodeSetMaxStep(memory, largest_step))

    def step(self, stop_time: float) -> tuple[Outcome, float]:
        """One internal step, at most to ``stop_time`` [s]; ``x`` belongs to the time returned.

        Raises:
            StepRejectedError: the solver failed.
        """
        self._failure, self._message = None, ""
        time = ctypes.c_double()
        memory = self._memory
        self._require(_set_stop_time(memory, stop_time))
        flag = bindings.CVode(memory, stop_time, self._states, ctypes.byref(time), _ONE_STEP)
        if flag < CV_SUCCESS:
            raise self._error(flag)
        if not np.isfinite(self.x).all():
            raise StepRejectedError(f"CVode: the states are not finite at t={time.value!r} s")
        outcomes = {CV_ROOT_RETURN: Outcome.ROOT, _STOP_RETURN: Outcome.STOP}
        return outcomes.get(flag, Outcome.STEP), time.value

    @property
    def first_step(self) -> float:
        """The first internal step that was taken since the last restart [s]."""
        value = ctypes.c_double()
        self._require(_get_first_step(self._memory, ctypes.byref(value)))
        return value.value

    def close(self) -> None:
        """Free all memory. Idempotent."""
        if self._memory is None:
            return
        self.x = np.zeros(self._size)
        CVodeFree(ctypes.byref(ctypes.c_void_p(self._memory)))
        self._memory = None
        _free_linear_solver(self._linear_solver)
        _free_matrix(self._matrix)
        N_VDestroy_Serial(self._tolerances)
        N_VDestroy_Serial(self._states)
        _free_context(ctypes.byref(self._context))

    def _error(self, flag: int) -> Exception:
        if self._failure is not None:
            return self._failure
        return StepRejectedError(f"CVode failed: {self._message or f'flag {flag}'}")

    def _require(self, flag: int) -> None:
        if flag != CV_SUCCESS:
            raise self._error(flag)

    def _keep_message(
        self, _line: int, _function: bytes, _file: bytes, text: bytes, *_: Any
    ) -> None:
        self._message = (text or b"").decode(errors="replace").strip()

    def _guarded_right_hand_side(self, evaluate: Evaluation) -> Callable[..., int]:
        """Nothing may be raised through C, and nothing that is not finite may be returned."""

        def guarded(time: float, x: Any, dx: Any, _data: Any) -> int:
            try:
                values = NV_DATA_S(dx)
                evaluate(time, NV_DATA_S(x), values)
                if not np.isfinite(np.ctypeslib.as_array(values, (self._size,))).all():
                    raise StepRejectedError(f"a derivative is not finite at t={time!r} s")
            except StepRejectedError as error:
                self._failure = error
                return _RECOVERABLE
            except Exception as error:  # comes out of `step`
                self._failure = error
                return _UNRECOVERABLE
            return 0

        return guarded

    def _guarded_roots(self, evaluate: Evaluation) -> Callable[..., int]:
        def guarded(time: float, x: Any, values: Any, _data: Any) -> int:
            try:
                evaluate(time, NV_DATA_S(x), values)
            except Exception as error:  # comes out of `step`
                self._failure = error
                return _UNRECOVERABLE
            return 0

        return guarded
