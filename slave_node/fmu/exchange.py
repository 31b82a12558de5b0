"""Values and derivatives of some real variables of an FMU, exchanged without allocation.

The buffer and the addresses in it are made once; a transfer is one call of a C function whose
arguments are all converted beforehand.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.signals import MAX_ORDER, FloatArray, InputSignal
from protocol.variables import VariableType
from slave_node.fmu.variables import Place

VALUES_CALL = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p]
"""Argument types of fmi2GetReal and fmi2SetReal, without the component."""

Bind = Callable[..., Callable[[], int]]
"""Calls by full name, argument types and arguments, see
`FmuInstance.bound`."""

DERIVATIVES_CALL = [*VALUES_CALL, ctypes.c_void_p]
"""Argument types of fmi2SetRealInputDerivatives and fmi2GetRealOutputDerivatives."""


class Buffer:
    """One direction: inputs to set or outputs to get.

    Args:
        n: number of variables.

    Attributes:
        size: n.
        rows: row j holds the j-th derivatives, shape (MAX_ORDER + 1, n).
        first: ``first[r]`` is a view of the first r rows.
        transfer_values: transfers row 0; returns the FMU's status.
        transfer_derivatives: ``transfer_derivatives[k]()`` transfers row k, k >= 1. One call for
            each order: tools check the number of value references against that of the inputs.
        values_function, derivatives_function: what these call.
    """

    __slots__ = (
        "derivatives_function",
        "first",
        "rows",
        "size",
        "transfer_derivatives",
        "transfer_values",
        "values_function",
    )

    def __init__(self, n: int) -> None:
        self.size = n
        self.rows: FloatArray = np.zeros((MAX_ORDER + 1, n))
        self.first = [self.rows[:r] for r in range(MAX_ORDER + 2)]
        self.values_function = ""
        self.derivatives_function = ""
        self.transfer_values: Callable[[], int] = _nothing
        self.transfer_derivatives: Sequence[Callable[[], int]] = [_nothing] * (MAX_ORDER + 1)


class ExchangeBuffer(Buffer):
    """With the functions of FMI 1.0 and 2.0.

    Args:
        references: value references, shape (n,).
        bind: binds the arguments of a function.
        values: name of fmi2GetReal or fmi2SetReal.
        derivatives: name of fmi2SetRealInputDerivatives or fmi2GetRealOutputDerivatives; "":
            nothing is transferred.
    """

    __slots__ = ("_orders", "_references")

    def __init__(
        self,
        references: NDArray[np.uint32],
        bind: Bind,
        values: str,
        derivatives: str = "",
    ) -> None:
        n = len(references)
        super().__init__(n)
        self._references = references
        self._orders = _order_numbers(n)
        of = references.ctypes.data
        rows, orders = _row_addresses(self.rows), _row_addresses(self._orders)
        self.values_function = values
        self.transfer_values = bind(values, VALUES_CALL, of, n, rows[0])
        if not derivatives:
            return
        self.derivatives_function = derivatives
        self.transfer_derivatives = [
            bind(derivatives, DERIVATIVES_CALL, of, n, order, row)
            for order, row in zip(orders, rows, strict=True)
        ]


class InputPolynomials:
    """Inputs of an FMU that are set along their polynomials at times within a step.

    Args:
        given: holds the derivatives of all orders that are set, and zeros above.
        within: transfers values of the same variables.
    """

    def __init__(self, given: Buffer, within: Buffer) -> None:
        self._given = given
        self._within = within
        self.values_function = within.values_function

    def set(self, rows: int, offset: float) -> int:
        """Set the inputs of ``rows`` derivatives at ``offset`` [s] from where they were given."""
        if self._within.size == 0:
            return 0
        self._within.rows[0] = InputSignal(self._given.first[rows]).at(offset)
        return self._within.transfer_values()


VALUES_CALL_3 = [*VALUES_CALL, ctypes.c_size_t]
"""Argument types of fmi3GetFloat64 and its like, without the component."""

DERIVATIVES_CALL_3 = [*DERIVATIVES_CALL, ctypes.c_size_t]
"""Argument types of fmi3GetOutputDerivatives."""


class _WholeVariables:
    """Variables of one type with all their elements, of which some are columns of a buffer.

    Args:
        dtype: of the values.
        places: of the scalar variables.
        columns: where they stand in the buffer.
    """

    def __init__(self, dtype: Any, places: Sequence[Place], columns: Sequence[int]) -> None:
        sizes = {place.reference: place.size for place in places}
        begins = dict(zip(sizes, np.cumsum([0, *sizes.values()]).tolist(), strict=False))
        self.references = np.array(list(sizes), dtype=np.uint32)
        self.values = np.zeros(sum(sizes.values()), dtype=dtype)
        self.columns = np.array(columns)
        self.elements = np.array([begins[place.reference] + place.element for place in places])

    def call(self, bind: Bind, function: str) -> Callable[[], int]:
        """A call of fmi3GetFloat64 or its like for them."""
        return bind(
            function,
            VALUES_CALL_3,
            self.references.ctypes.data,
            len(self.references),
            self.values.ctypes.data,
            len(self.values),
        )


class ArrayExchangeBuffer(Buffer):
    """With the functions of FMI 3.0: Float64 and Float32, elements of arrays.

    Scalars of type Float64 go straight between buffer and FMU. Of an array all elements are
    transferred; those that are no columns keep the values that `fill` got.

    Args:
        places: of the scalar variables.
        bind: binds the arguments of a function.
        sets: whether the FMU is to take the values (inputs) or to give them (outputs).
        derivatives: whether outputs have them.
    """

    __slots__ = ("_kept", "_wholes")

    def __init__(
        self,
        places: Sequence[Place],
        bind: Bind,
        *,
        sets: bool,
        derivatives: bool,
    ) -> None:
        n = len(places)
        super().__init__(n)
        verb = "fmi3Set" if sets else "fmi3Get"
        self.values_function = f"{verb}Float64"
        self.derivatives_function = "fmi3GetOutputDerivatives"
        self._kept: list[Any] = []
        self._wholes: list[tuple[_WholeVariables, Callable[[], int], Callable[[], int]]] = []
        is_plain = all(p.type is VariableType.FLOAT64 and p.size == 1 for p in places)
        if is_plain:
            references = np.array([place.reference for place in places], dtype=np.uint32)
            self._kept.append(references)
            self.transfer_values = bind(
                self.values_function,
                VALUES_CALL_3,
                references.ctypes.data,
                n,
                self.rows.ctypes.data,
                n,
            )
        else:
            for kind, dtype in _FLOATS.items():
                columns = [i for i, place in enumerate(places) if place.type is kind]
                if columns:
                    whole = _WholeVariables(dtype, [places[i] for i in columns], columns)
                    get = whole.call(bind, f"fmi3Get{kind}")
                    transfer = whole.call(bind, f"{verb}{kind}")
                    self._wholes.append((whole, get, transfer))
            self.transfer_values = self._set if sets else self._get
        if derivatives:
            self.transfer_derivatives = self._derivatives(places, bind)

    def fill(self) -> int:
        """Get the elements of arrays that are no columns, for `transfer_values` to set again."""
        return max((get() for _, get, _ in self._wholes), default=0)

    def _get(self) -> int:
        worst = 0
        for whole, _, transfer in self._wholes:
            worst = max(worst, transfer())
            self.rows[0, whole.columns] = whole.values[whole.elements]
        return worst

    def _set(self) -> int:
        worst = 0
        for whole, _, transfer in self._wholes:
            with np.errstate(over="ignore"):  # beyond Float32 it is infinite
                whole.values[whole.elements] = self.rows[0, whole.columns]
            worst = max(worst, transfer())
        return worst

    def _derivatives(self, places: Sequence[Place], bind: Bind) -> Sequence[Callable[[], int]]:
        """The values are of type Float64 whatever the variables are."""
        whole = _WholeVariables(np.float64, places, range(len(places)))
        n, size = len(whole.references), len(whole.values)
        orders = _order_numbers(n)
        self._kept += [whole.references, orders, whole.values]
        calls = [
            bind(
                self.derivatives_function,
                DERIVATIVES_CALL_3,
                whole.references.ctypes.data,
                n,
                order,
                whole.values.ctypes.data,
                size,
            )
            for order in _row_addresses(orders)
        ]

        def transfer(k: int) -> int:
            status: int = calls[k]()
            self.rows[k] = whole.values[whole.elements]
            return status

        return [partial(transfer, k) for k in range(MAX_ORDER + 1)]


def _order_numbers(n: int) -> NDArray[np.int32]:
    """The order of each of n derivatives, shape (MAX_ORDER + 1, n): row k is k."""
    orders = np.empty((MAX_ORDER + 1, n), dtype=np.int32)
    orders[...] = np.arange(MAX_ORDER + 1)[:, np.newaxis]
    return orders


def _row_addresses(rows: NDArray[Any]) -> list[int]:
    """Where each row begins."""
    return [rows.ctypes.data + i * rows.strides[0] for i in range(len(rows))]


def _nothing() -> int:
    """For values that are not transferred."""
    return 0


_FLOATS = {VariableType.FLOAT64: np.float64, VariableType.FLOAT32: np.float32}
