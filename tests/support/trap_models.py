"""Python models that meet with an accident in mid step, once each, loaded by name."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from time import sleep
from typing import Any

from protocol.variables import Variable, VariableType
from slave_node.model import real
from slave_node.python.loading import load_model_class

_EXAMPLES = Path(__file__).parents[2] / "examples" / "quarter_car"
_Chassis: Any = load_model_class("quarter_car.py:Chassis", _EXAMPLES)


def _grandparent() -> int:
    """The process that started the parent."""
    status = Path(f"/proc/{os.getppid()}/status").read_text()
    (line,) = [line for line in status.splitlines() if line.startswith("PPid:")]
    return int(line.split()[1])


def _refuse() -> None:
    raise ValueError("not this step")


_ACCIDENTS = {
    "refuse": _refuse,
    "kill worker": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "kill node": lambda: os.kill(os.getppid(), signal.SIGKILL),
    "kill master": lambda: os.kill(_grandparent(), signal.SIGKILL),
    "interrupt master": lambda: os.kill(_grandparent(), signal.SIGINT),
    "crash": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "abort": os.abort,
    "leave": lambda: os._exit(7),
    "hang": lambda: sleep(3600.0),
}


class Trapped(_Chassis):
    """A chassis with ``traps``, such as ``"0.1 kill worker, 0.2 crash"``: time and accident.

    Each happens once, at the first evaluation at that time or later: a file in ``folder`` tells.
    What happens from the time ``always`` on happens again and again. Negative times are those of
    the initialization.
    """

    parameters = (
        *_Chassis.parameters,
        Variable("traps", type=VariableType.STRING, start=""),
        Variable("folder", type=VariableType.STRING, start=""),
        real("always", "s", start=1e300),
        Variable("what", type=VariableType.STRING, start="crash"),
    )

    def prepare(self) -> None:
        """Preparation as the chassis', if the accident lets it end."""
        super().prepare()
        self._meet(-1.0)

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The chassis' equations, if it lives to see them."""
        self._meet(t)
        return list(super().derivatives(t, x, u))

    def _meet(self, t: float) -> None:
        for number, trap in enumerate(filter(None, self.traps.split(","))):
            time, _, what = trap.strip().partition(" ")
            if t >= float(time):
                try:
                    Path(self.folder, f"trap {number}").touch(exist_ok=False)
                except FileExistsError:
                    continue
                _ACCIDENTS[what]()
                sleep(30.0)  # until it has happened
        if t >= self.always:
            _ACCIDENTS[self.what]()
