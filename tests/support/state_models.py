"""Python models that do what hinders the saving of states, loaded by name."""

from __future__ import annotations

import os
import signal
import socket
from pathlib import Path
from time import sleep
from typing import Any

from protocol.variables import Variable, VariableType
from slave_node.model import Model, real


class Fragile(Model):
    """x' = u - x, as long as u is at most 1: up to 2 it dies, beyond that it never ends.

    ``sign``: a file that then gets its process id.
    """

    inputs = (real("u"),)
    outputs = (real("y"),)
    states = (real("x", start=1.0),)
    parameters = (Variable("sign", type=VariableType.STRING, start=""),)

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The state, or the end."""
        if u[0] > 2.0:
            if self.sign:
                Path(self.sign).write_text(str(os.getpid()))
            while True:
                sleep(1.0)
        if u[0] > 1.0:
            os.kill(os.getpid(), signal.SIGSEGV)
            sleep(10.0)
        return [u[0] - x[0]]

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """The state."""
        return [x[0]]


class Holder(Fragile):
    """Holds something open: a socket, a pipe, or a terminal."""

    parameters = (Variable("what", type=VariableType.STRING, start="socket"),)

    def prepare(self) -> None:
        """Open it."""
        self.sign = ""
        match self.what:
            case "socket":
                self.held: Any = socket.socket()
            case "pipe":
                self.held = os.pipe()
            case _:
                self.held = os.openpty()


class Reader(Model):
    """Its output is the next number in a file, eight characters each, at every evaluation."""

    outputs = (real("y"),)
    parameters = (Variable("file", type=VariableType.STRING, start=""),)

    def prepare(self) -> None:
        """Open the file, without a buffer."""
        self.descriptor = os.open(self.file, os.O_RDONLY)

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """The next one."""
        return [float(os.read(self.descriptor, 8) or b"-1")]
