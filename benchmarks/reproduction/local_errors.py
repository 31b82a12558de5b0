"""Local errors without any assumption: one double step that starts from exact values.

The slaves start in the exact state at T_n and the history holds exact inputs, so what the outputs
at T_n + 2H are off is the local error, but for what the slaves' own solvers add: they get the
smallest tolerance that makes sense.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from benchmarks.reproduction.exact_quarter_car import FloatArray, outputs, slopes, states
from master_node import System
from master_node.coupling.coupled_system import resolve
from master_node.coupling.scheme import CouplingScheme
from master_node.hosts.opening import Slaves, slaves_in_process
from master_node.judging.comparison import ErrorControl
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.error_estimators import ESTIMATORS
from master_node.numerics.extrapolation import CouplingHistory, InputPolynomial
from master_node.preparing.initialization import initialize
from master_node.slaves.group import SlaveGroup
from master_node.stepping.double_step import DoubleStep, DoubleStepper
from protocol.calls import Reset

SLAVE_TOLERANCE = 1e-13


class LocalError(NamedTuple):
    """The error of one double step and what is said of it, shape (m,) each, unit [y].

    Attributes:
        true: outputs at T_n + 2H minus the exact ones.
        paper: the estimate with the paper's constants.
        exact: the estimate with the constants of the nodes that there were.
    """

    true: FloatArray
    paper: FloatArray
    exact: FloatArray


class ExactStarts:
    """Double steps of one quarter car from exact values.

    Args:
        system: the car, in any coupling; its slaves have ``x`` and ``v`` to start with.
        slaves: of it, instantiated, in process.
    """

    def __init__(self, system: System, slaves: Slaves) -> None:
        self._system = system
        self._group = SlaveGroup(slaves.links)
        self._coupled = resolve(system, slaves.descriptions)
        self._is_used = False
        self.names = self._coupled.output_names

    def local_error(
        self,
        time: float,
        step_size: float,
        polynomial: InputPolynomial,
        estimator: str,
        spacing: float | None = None,
    ) -> LocalError:
        """The local error of a double step of H from T_n.

        Args:
            time: T_n [s].
            step_size: H [s].
            polynomial: of the inputs.
            estimator: ``rich`` or ``mod``.
            spacing: of the communication points before T_n [s]; None: H as well.
        """
        spacing = step_size if spacing is None else spacing
        system = self._started_at(time, polynomial, estimator)
        scheme = CouplingScheme.of(self._coupled, system)
        kind = ESTIMATORS[estimator]
        if self._is_used:
            self._group.execute_all([(Reset(),)] * len(self._group), time)
        self._is_used = True
        initialize(self._group, self._coupled, system, scheme.get_outputs)
        depth = kind.points(polynomial.points) + 1  # and T_n + H, later
        past = np.array([time - i * spacing for i in range(depth)])
        history = self._exact_history(past, scheme.output_rows)
        step = DoubleStepper(self._group, self._coupled, scheme, kind).attempt(
            history,
            DoubleStepTimes.from_step_size(time, step_size),
            scheme.extrapolation.polynomials(polynomial, polynomial.points),
        )
        if not isinstance(step, DoubleStep):
            raise step.error or RuntimeError(step.reason)
        paper, exact = (
            ErrorControl(self._coupled, scheme, kind, constants).judge(step).estimate
            for constants in ("paper", "exact")
        )
        (truth,) = outputs(self.names, [step.times.end])
        return LocalError(step.end[0] - truth, paper, exact)

    def _exact_history(self, times: FloatArray, rows: int) -> CouplingHistory:
        """Exact inputs at ``times``, newest first [s]; with derivatives if ``rows`` is 2."""
        known = [outputs(self.names, times), slopes(self.names, times)][:rows]
        inputs = [self._coupled.inputs_of(row) for row in np.stack(known, axis=1)]
        history = CouplingHistory.start(float(times[-1]), inputs[-1], len(times))
        for time, row in zip(times[-2::-1].tolist(), inputs[-2::-1], strict=True):
            history = history.pushed(time, row)
        return history

    def _started_at(self, time: float, polynomial: InputPolynomial, estimator: str) -> System:
        """The system with start values of the exact solution at ``time`` [s]."""
        system = self._system
        x_c, v_c, x_w, v_w = states([time])[0].tolist()
        start = {"chassis": {"x": x_c, "v": v_c}, "wheel": {"x": x_w, "v": v_w}}
        return System(
            simulation={
                "start_time": time,
                "stop_time": time + 1.0,
                "order": polynomial.order,
                "derivative_points": polynomial.derivative_points,
                "estimator": estimator,
                "slave_tolerance": SLAVE_TOLERANCE,
            },
            slaves={
                name: {"model": slave.model, "parameters": {**slave.parameters, **start[name]}}
                for name, slave in system.slaves.items()
            },
            connections=system.connections,
            base=system.base,
        )


@contextmanager
def exact_starts(system: System) -> Iterator[ExactStarts]:
    """Load the slaves once for many double steps."""
    with slaves_in_process(system) as slaves:
        yield ExactStarts(system, slaves)
