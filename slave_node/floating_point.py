"""The floating-point environment: rounding, traps, and what becomes of the smallest numbers.

A model may change it, by a call or by being loaded (what is compiled with ``-ffast-math`` does),
and it holds for the whole thread. All arithmetic of our own is to round to nearest and to trap
nothing, whatever model it stands beside: else results would depend on which process a model is in.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import partial

_BYTES = 512
"""More than a ``fenv_t`` has anywhere."""


def _restorer() -> Callable[[], object]:
    """Function that brings the present environment back; without one in C it does nothing."""
    if os.name != "posix":
        return lambda: None
    library = ctypes.CDLL(None)
    if not (hasattr(library, "fegetenv") and hasattr(library, "fesetenv")):
        return lambda: None
    environment = ctypes.create_string_buffer(_BYTES)
    library.fegetenv(environment)
    address = ctypes.c_void_p(ctypes.addressof(environment))
    _KEPT.append(environment)
    return partial(library.fesetenv, address)


_KEPT: list[object] = []

restore_floating_point = _restorer()
"""Bring back the environment that the process had when this module was imported."""
