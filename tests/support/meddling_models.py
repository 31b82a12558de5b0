"""A Python model that changes the process around it, and a function that does."""

from __future__ import annotations

import atexit
import decimal
import locale
import logging
import os
import signal
import sys
import warnings

import numpy as np

from slave_node.model import Model, real

print("a line while the module is loaded")  # noqa: T201  as models of users do
if "pytest" not in sys.modules:
    atexit.register(print, "a line at the end of the process")


def meddle() -> None:
    """Change all that a process has one of."""
    print("a line on standard output")  # noqa: T201
    os.write(1, b"a line on descriptor 1\n")
    os.chdir("/")
    os.umask(0o777)
    os.environ["DOUBLESTEP_MEDDLED"] = "1"
    locale.setlocale(locale.LC_ALL, "C")
    logging.disable(logging.CRITICAL)
    np.seterr(all="raise")
    decimal.getcontext().prec = 3
    sys.setrecursionlimit(sys.getrecursionlimit() + 1)
    sys.path.insert(0, "/nowhere")
    warnings.simplefilter("ignore")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (1, 2):
        os.dup2(nowhere, descriptor)
    os.close(nowhere)
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: PTH123, SIM115


meddle()


class Meddler(Model):
    """x' = u - x, and a changed process."""

    inputs = (real("u", start=1.0),)
    states = (real("x"),)
    outputs = (real("y"),)

    def derivatives(self, t: float, x: list[float], u: list[float]) -> list[float]:
        """See `Model`."""
        del t
        meddle()
        return [u[0] - x[0]]

    def output_values(self, t: float, x: list[float], u: list[float]) -> list[float]:
        """See `Model`."""
        del t, u
        meddle()
        return [x[0]]


def overflowing(t: float) -> float:
    """A signal, and NumPy told to raise."""
    np.seterr(all="raise")
    return t
