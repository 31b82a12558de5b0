"""Slaves whose states are saved in one way or another, and what tests do to them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import numpy as np

from protocol.calls import Configure, Initialize
from protocol.slave import Slave
from slave_node.loading import load_slave
from tests.support.places import SUPPORT

MODELS = SUPPORT / "state_models.py"


@contextmanager
def loaded(
    model: str | Path,
    kind: str,
    *,
    inputs: tuple[str, ...] = (),
    outputs: tuple[str, ...] = (),
    **start_values: object,
) -> Iterator[Slave]:
    """The slave at its first communication point, t = 0."""
    with TemporaryDirectory() as scratch:
        slave = load_slave(
            str(model), Path(), "slave", Path(scratch), configuration=Configure(state_kind=kind)
        )
        try:
            begin(slave, inputs, outputs, **start_values)
            yield slave
        finally:
            slave.close()


def begin(
    slave: Slave,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    discrete: tuple[tuple[str, ...], tuple[str, ...]] = ((), ()),
    **start_values: object,
) -> None:
    """From instantiated to t = 0; ``discrete`` inputs and outputs."""
    slave.initialize(
        Initialize(
            start_time=0.0,
            stop_time=None,
            relative_tolerance=1e-6,
            start_values=start_values,  # type: ignore[arg-type]
            inputs=inputs,
            outputs=outputs,
            discrete_inputs=discrete[0],
            discrete_outputs=discrete[1],
        )
    )
    slave.exit_initialization_mode()


def fragile(kind: str = "fork", **start_values: object):
    """The model that dies on demand."""
    return loaded(f"{MODELS}:Fragile", kind, inputs=("u",), outputs=("y",), **start_values)


def wheel(fmus: Path, kind: str):
    """The wheel of the quarter car."""
    return loaded(fmus / "wheel.fmu", kind, inputs=("x_c", "v_c"), outputs=("x", "v"))


def wander(slave: Slave, seed: int, steps: int) -> list[bytes]:
    """Save, restore, give up and step at random.

    Returns:
        The bits of all outputs that were read on the way.
    """
    random = Random(seed)
    time = 0.0
    saved: list[tuple[object, float]] = []
    seen = []
    for _ in range(steps):
        action = random.choice(("save", "restore", "restore and free", "free", *(["step"] * 4)))
        place = random.randrange(len(saved)) if saved else None
        if action == "step":
            step_size = random.uniform(1e-4, 1e-2)
            if random.random() < 0.8:
                rows = random.randint(1, 4)
                slave.set_inputs(np.array([[random.gauss(0.0, 0.1)] * 2 for _ in range(rows)]))
            slave.do_step(time, step_size, False)
            time += step_size
            if random.random() < 0.8:
                seen.append(slave.get_outputs(random.choice((0, 0, 1))).tobytes())
        elif action == "save" and len(saved) < 4:
            saved.append((slave.get_state(), time))
        elif place is None:
            continue
        elif action == "restore":
            state, time = saved[place]
            slave.set_state(state)
            seen.append(slave.get_outputs(0).tobytes())
        elif action == "restore and free":
            state, time = saved.pop(place)
            slave.set_state_and_free(state)
        elif action == "free":
            slave.free_state(saved.pop(place)[0])
    for state, _ in saved:
        slave.free_state(state)
    return seen
