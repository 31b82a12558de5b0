"""Start values as a user gives them."""

from __future__ import annotations

import pytest

from master_node.system.start_values import start_values
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError
from protocol.variables import Variable, VariableType

DESCRIPTION = SlaveDescription(
    "test",
    "test",
    (
        Variable("m"),
        *(Variable(f"A[{i},{j}]") for i in (1, 2) for j in (1, 2, 3)),
        *(Variable(f"v[{i}]") for i in (1, 2)),
        Variable("data", type=VariableType.BINARY),
        Variable("name", type=VariableType.STRING),
    ),
)


def test_arrays_are_their_elements() -> None:
    """In rows, indices from 1; single elements and others beside them."""
    given = {"A": ((1, 2, 3), (4, 5, 6)), "v": (7.0, 8.0), "m": 9.0}
    assert start_values(DESCRIPTION, given) == {
        **{f"A[{i},{j}]": 3 * (i - 1) + j for i in (1, 2) for j in (1, 2, 3)},
        "v[1]": 7.0,
        "v[2]": 8.0,
        "m": 9.0,
    }


def test_texts_are_bytes_only_for_binary_variables() -> None:
    """Hexadecimal digits; a string stays one."""
    values = start_values(DESCRIPTION, {"data": "00ff", "name": "00ff"})
    assert values == {"data": b"\x00\xff", "name": "00ff"}
    with pytest.raises(ConfigurationError, match="'data' is of type Binary; it cannot be 'no'"):
        start_values(DESCRIPTION, {"data": "no"})


@pytest.mark.parametrize("value", [(1.0, 2.0, 3.0), ((1.0, 2.0),)])
def test_a_list_that_does_not_fit_names_the_element(value: object) -> None:
    """The first that the array does not have."""
    with pytest.raises(ConfigurationError, match=r"no variable 'v\["):
        start_values(DESCRIPTION, {"v": value})  # type: ignore[dict-item]
