"""Values and derivatives of some real variables of an FMU, exchanged without allocation.

The buffer and the addresses in it are made once; a transfer is one call of a C function with all
its arguments bound.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.signals import MAX_ORDER

VALUES_CALL = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p]
"""Argument types of fmi2GetReal and fmi2SetReal."""

DERIVATIVES_CALL = [*VALUES_CALL, ctypes.c_void_p]
"""Argument types of fmi2SetRealInputDerivatives and fmi2GetRealOutputDerivatives."""


class ExchangeBuffer:
    """One direction: inputs to set or outputs to get.

    Args:
        component: the FMU instance.
        references: value references, shape (n,).
        values: fmi2GetReal or fmi2SetReal with ``VALUES_CALL``.
        derivatives: fmi2SetRealInputDerivatives or fmi2GetRealOutputDerivatives with
            ``DERIVATIVES_CALL``.

    Attributes:
        size: n.
        rows: row j holds the j-th derivatives, shape (MAX_ORDER + 1, n).
        first: ``first[r]`` is a view of the first r rows.
        transfer_values: transfers row 0; returns the FMU's status.
        transfer_derivatives: ``transfer_derivatives[k]()`` transfers rows 1 to k, k >= 1.
    """

    __slots__ = (
        "_orders",
        "_references",
        "first",
        "rows",
        "size",
        "transfer_derivatives",
        "transfer_values",
    )

    def __init__(
        self, component: int, references: NDArray[np.uint32], values: Any, derivatives: Any
    ) -> None:
        n = len(references)
        orders = range(1, MAX_ORDER + 1)
        self.size = n
        self.rows = np.zeros((MAX_ORDER + 1, n))
        self.first = [self.rows[:r] for r in range(MAX_ORDER + 2)]
        self._references = np.tile(references, MAX_ORDER)
        self._orders = np.repeat(np.array(orders, dtype=np.int32), n)
        of, address = self._references.ctypes.data, self.rows.ctypes.data
        self.transfer_values: Callable[[], int] = partial(values, component, of, n, address)
        order_numbers, row_1 = self._orders.ctypes.data, address + n * self.rows.itemsize
        self.transfer_derivatives: list[Callable[[], int]] = [
            partial(derivatives, component, of, k * n, order_numbers, row_1)
            for k in range(MAX_ORDER + 1)
        ]
