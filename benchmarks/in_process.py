"""An attempted double step in process against the same three do_steps in a loop on FMPy by hand."""

import tempfile
from pathlib import Path

from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave

from benchmarks.interleaved import Interleaved
from benchmarks.quarter_car import EXAMPLE, system
from master_node.coupling.coupled_system import resolve
from master_node.hosts.opening import slaves_in_process
from master_node.running.co_simulation import CoSimulation
from master_node.slaves.group import SlaveGroup

H = 1e-3


class HandWritten:
    """Two slaves, EST_mod's three do_steps with k = 1: what a user writes who knows FMPy.

    No control, no results, no checks of values; inputs from the last two communication points.
    """

    def __init__(self, directory: Path) -> None:
        self._slaves = [self._load(name, directory / name) for name in ("chassis", "wheel")]
        self._time = 0.0
        self._y = self._previous = ([0.0, 0.0], [0.0, 0.0])

    @staticmethod
    def _load(name: str, directory: Path) -> tuple[FMU2Slave, list[int], list[int]]:
        description = read_model_description(str(EXAMPLE / f"{name}.fmu"))
        extract(str(EXAMPLE / f"{name}.fmu"), unzipdir=str(directory))
        slave = FMU2Slave(
            guid=description.guid,
            unzipDirectory=str(directory),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName=name,
        )
        slave.instantiate()
        slave.setupExperiment(tolerance=1e-6, startTime=0.0)
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        references = {
            causality: [
                v.valueReference for v in description.modelVariables if v.causality == causality
            ]
            for causality in ("input", "output")
        }
        return slave, references["input"], references["output"]

    def double_step(self) -> None:
        """One double step with its comparison solution."""
        t, h = self._time, H
        y0, y1 = self._previous, self._y
        middle, states = [], []
        for i, (slave, inputs, outputs) in enumerate(self._slaves):
            u = y1[1 - i]
            du = [(a - b) / h for a, b in zip(u, y0[1 - i], strict=True)]
            state = slave.getFMUstate()
            slave.setReal(inputs, u)
            slave.setRealInputDerivatives(inputs, [1, 1], du)
            slave.doStep(t, h)
            middle.append(slave.getReal(outputs))
            halfway = slave.getFMUstate()
            slave.setReal(inputs, [a + h * b for a, b in zip(u, du, strict=True)])
            slave.setRealInputDerivatives(inputs, [1, 1], du)
            slave.doStep(t + h, h)
            slave.getReal(outputs)
            slave.setFMUstate(halfway)
            slave.freeFMUstate(halfway)
            states.append(state)
        end = []
        for i, (slave, inputs, outputs) in enumerate(self._slaves):
            u = middle[1 - i]
            du = [(a - b) / h for a, b in zip(u, y1[1 - i], strict=True)]
            slave.setReal(inputs, u)
            slave.setRealInputDerivatives(inputs, [1, 1], du)
            slave.doStep(t + h, h)
            end.append(slave.getReal(outputs))
            slave.freeFMUstate(states[i])
        self._time = (t + h) + h
        self._previous, self._y = tuple(middle), tuple(end)

    def close(self) -> None:
        """Free both."""
        for slave, _, _ in self._slaves:
            slave.terminate()
            slave.freeInstance()


def run() -> list[tuple[str, str, str, str]]:
    """Rows: configuration, median attempt, median by hand, ratio."""
    car = system(stop_time=60.0, largest_step_size=2e-3)
    with tempfile.TemporaryDirectory() as directory:
        by_hand = HandWritten(Path(directory))
        timing = Interleaved(by_hand.double_step)
        with slaves_in_process(car) as slaves:
            coupled = resolve(car, slaves.descriptions)
            CoSimulation(SlaveGroup(slaves.links), coupled, car, timing).run()
        by_hand.close()
    attempt, loop = timing.medians()
    return [("EST_mod, k = 1", f"{attempt:.0f} us", f"{loop:.0f} us", f"{attempt / loop:.2f}")]
