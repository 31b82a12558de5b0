"""The exact outputs of the quarter car's slaves, in both couplings, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from examples.quarter_car.quarter_car import exact_solution

FloatArray = NDArray[np.float64]

_M_C, _M_W, _K_W, _K_C, _D_C, _Z = 400.0, 40.0, 150000.0, 15000.0, 1000.0, 0.1


def states(times: ArrayLike) -> FloatArray:
    """chassis.x, chassis.v, wheel.x, wheel.v at any times [s], shape (n, 4).

    The car rests at 0 until the road rises at t = 0.
    """
    return exact_solution(np.maximum(np.asarray(times, float), 0.0))


def outputs(names: Sequence[str], times: ArrayLike) -> FloatArray:
    """Outputs by their names, shape (n, len(names)), in m, m/s and N."""
    x_c, v_c, x_w, v_w = states(times).T
    force = _K_C * (x_w - x_c) + _D_C * (v_w - v_c)
    columns = {
        "chassis.x": x_c,
        "chassis.v": v_c,
        "wheel.x": x_w,
        "wheel.v": v_w,
        "wheel.F": force,
    }
    return np.column_stack([columns[name] for name in names])


def slopes(names: Sequence[str], times: ArrayLike) -> FloatArray:
    """The derivatives of `outputs`, the same shape; at t = 0 those just after the rise."""
    x_c, v_c, x_w, v_w = states(times).T
    force = _K_C * (x_w - x_c) + _D_C * (v_w - v_c)
    road = np.where(np.asarray(times, float) < 0.0, 0.0, _Z)
    a_c = force / _M_C
    a_w = (_K_W * (road - x_w) - force) / _M_W
    columns = {
        "chassis.x": v_c,
        "chassis.v": a_c,
        "wheel.x": v_w,
        "wheel.v": a_w,
        "wheel.F": _K_C * (v_w - v_c) + _D_C * (a_w - a_c),
    }
    return np.column_stack([columns[name] for name in names])
