"""Parameters of tests of which some are slow: `make test` runs the others, `make slow` all."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest
from _pytest.mark.structures import ParameterSet


def quick_at(quick: Collection[Any], values: Iterable[Any]) -> list[Any]:
    """Parameters of `pytest.mark.parametrize`: ``values``, slow where they are not in ``quick``.

    A test with several parameters is slow as soon as one of them is.
    """
    left = [value for value in quick if value not in list(values)]
    assert not left, f"no values of the test: {left}"
    return [value if value in quick else _slow(value) for value in values]


def _slow(value: Any) -> ParameterSet:
    # A tuple holds the values of several arguments.
    return pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.slow)
