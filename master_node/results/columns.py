"""The columns of results, and a table of them as the files' readers give it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from master_node.observing.observers import DiscreteType, DiscreteValue, RunStart
from protocol.signals import FloatArray

DiscreteArray = NDArray[np.float64] | NDArray[np.int64] | NDArray[np.bool_] | NDArray[np.object_]
"""Values of one discrete variable, shape (n,); str and bytes are held as objects."""

DISCRETE_TYPES: tuple[DiscreteType, ...] = get_args(DiscreteType)

DTYPES: Mapping[DiscreteType, np.dtype[Any]] = {
    "float": np.dtype(np.float64),
    "integer": np.dtype(np.int64),
    "boolean": np.dtype(np.bool_),
    "string": np.dtype(np.object_),
    "binary": np.dtype(np.object_),
}


@dataclass(frozen=True, slots=True)
class Columns:
    """Columns beside ``time`` [s], in this order.

    Attributes:
        names, units: of the m outputs; "" where no unit is known.
        discrete_names, discrete_units, discrete_types: of the d discrete variables.
        items: of enumerations: the number of each item by its name, by the name of the column.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    discrete_names: tuple[str, ...] = ()
    discrete_units: tuple[str, ...] = ()
    discrete_types: tuple[DiscreteType, ...] = ()
    items: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    @classmethod
    def of(cls, start: RunStart) -> Columns:
        """Those of a run."""
        return cls(
            start.output_names,
            start.output_units,
            start.discrete_names,
            start.discrete_units or ("",) * len(start.discrete_names),
            start.discrete_types,
            {name: start.items[name] for name in start.discrete_names if name in start.items},
        )

    @property
    def all_units(self) -> dict[str, str]:
        """The units by name."""
        names = self.names + self.discrete_names
        return dict(zip(names, self.units + self.discrete_units, strict=True))

    @property
    def types(self) -> dict[str, DiscreteType]:
        """The types of the discrete variables by name."""
        return dict(zip(self.discrete_names, self.discrete_types, strict=True))


@dataclass(frozen=True, slots=True)
class Known:
    """Units and types of columns that a file to be read does not tell itself.

    Attributes:
        units: by name.
        types: of the discrete variables by name; all others are outputs.
        items: of enumerations by name.
    """

    units: Mapping[str, str]
    types: Mapping[str, DiscreteType]
    items: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    @classmethod
    def of(cls, tables: Mapping[str, Any]) -> Known:
        """From ``summary.json``, or what was written at the start in its place."""
        units, types, items = (
            table if isinstance(table := tables.get(key), Mapping) else {}
            for key in ("units", "discrete_types", "enumerations")
        )
        return cls(
            {str(name): str(unit) for name, unit in units.items()},
            {str(name): type_ for name, type_ in types.items() if type_ in DISCRETE_TYPES},
            {
                str(name): {str(item): int(number) for item, number in numbers.items()}
                for name, numbers in items.items()
                if isinstance(numbers, Mapping)
                and all(type(number) is int for number in numbers.values())
            },
        )

    def columns(self, names: Sequence[str]) -> Columns:
        """Columns of a file with these names beside ``time``."""
        outputs = tuple(name for name in names if name not in self.types)
        discrete = tuple(name for name in names if name in self.types)
        return Columns(
            outputs,
            tuple(self.units.get(name, "") for name in outputs),
            discrete,
            tuple(self.units.get(name, "") for name in discrete),
            tuple(self.types[name] for name in discrete),
            {name: self.items[name] for name in discrete if name in self.items},
        )


NOTHING_KNOWN = Known({}, {})


@dataclass(frozen=True, eq=False)
class Table:
    """n rows of results.

    Attributes:
        columns: what stands beside the time.
        time: [s], shape (n,).
        outputs: shape (n, m); in Fortran order, as columns are what users take.
        discrete: d arrays of shape (n,) and of the dtypes in ``DTYPES``.
    """

    columns: Columns
    time: FloatArray
    outputs: FloatArray
    discrete: tuple[DiscreteArray, ...] = ()

    @classmethod
    def of_rows(
        cls,
        columns: Columns,
        rows: ArrayLike,
        discrete: Sequence[Sequence[DiscreteValue]],
    ) -> Table:
        """From numbers row by row, time and outputs in each, and columns of discrete values."""
        table = np.array(rows, np.float64).reshape(-1, 1 + len(columns.names))
        return cls(
            columns,
            table[:, 0].copy(),
            np.asfortranarray(table[:, 1:]),
            tuple(
                np.array(values, DTYPES[type_])
                for values, type_ in zip(discrete, columns.discrete_types, strict=True)
            ),
        )
