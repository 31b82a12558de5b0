"""A semi-active damper as an environment with the interface of Gymnasium, which is not needed.

An agent chooses the damping every 20 ms. `reset` goes back to a mark, so that an episode costs its
steps and nothing else.
"""

from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from master_node import load_system, open_run

SYSTEM = Path(__file__).parents[1] / "quarter_car" / "displacement_python.toml"
OBSERVED = ("chassis.x", "chassis.v", "wheel.x", "wheel.v")


class SemiActiveDamper:
    """The quarter car on a step of the road.

    Args:
        interval: time between two actions [s].
        steps: of an episode.
    """

    def __init__(self, interval: float = 0.02, steps: int = 50) -> None:
        self.interval, self.steps = interval, steps
        stop = interval * steps
        self._run = open_run(load_system(SYSTEM), in_process=True, stop_time=stop)
        self._begin = self._run.save()
        self._step = 0

    def reset(
        self,
        *,
        seed: int | None = None,  # noqa: ARG002  nothing is random
        options: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Begin an episode: the observation, and nothing more to tell."""
        self._run.restore(self._begin)
        self._step = 0
        return self._observation(), {}

    def step(self, action: float) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Damp by ``action`` [N.s/m] for one interval.

        Returns:
            Observation, reward (minus the square of the mean acceleration of the chassis), whether
            the episode is over by itself (never), whether its time is, and the time.
        """
        before = float(self._run["chassis.v"])
        self._run.set({"chassis.d": action, "wheel.d_c": action})
        self._step += 1
        self._run.until(self._step * self.interval)
        acceleration = (float(self._run["chassis.v"]) - before) / self.interval
        is_over = self._step >= self.steps
        return self._observation(), -(acceleration**2), False, is_over, {"time": self._run.time}

    def close(self) -> None:
        """End the run."""
        self._run.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _observation(self) -> NDArray[np.float64]:
        return np.array([self._run[name] for name in OBSERVED], dtype=np.float64)


def episode(environment: SemiActiveDamper, damping: float) -> float:
    """Sum of the rewards of an episode with one damping [N.s/m]."""
    total, is_over = 0.0, False
    environment.reset()
    while not is_over:
        _, reward, _, is_over, _ = environment.step(damping)
        total += reward
    return total


if __name__ == "__main__":
    with SemiActiveDamper() as environment:
        for damping in (300.0, 1000.0, 3000.0):
            print(f"d = {damping:.0f} N.s/m: {episode(environment, damping):.1f}")
