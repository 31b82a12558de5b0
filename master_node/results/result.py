"""Result of a run, from memory or read back from its files."""

from __future__ import annotations

import difflib
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from master_node.results.columns import NOTHING_KNOWN, DiscreteArray, Known, Table
from master_node.results.files import (
    START_FILE,
    STEPS_FILE,
    SUMMARY_FILE,
    check_is_file,
)
from master_node.results.formats import FILES, read_results, read_results_file
from master_node.results.steps_file import Steps, read_steps
from master_node.results.summary import read_json
from protocol.signals import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

_NOTEBOOK_DPI = 80


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """Result of a run. ``result["wheel.x"]`` is a variable over ``result.time``.

    Attributes:
        names: ``slave.variable`` of the m outputs.
        units: of each name and of the discrete variables, "" where none is known.
        time: the n result points [s], shape (n,).
        outputs: row i is y at ``time[i]``, shape (n, m); column j belongs to ``names[j]``.
        steps: the attempts, accepted or not; structured array of ``STEPS_DTYPE``.
        summary: as in ``summary.json``; empty while there is none: until the run has ended, in
            whatever way, and after the master was killed.
        discrete: the discrete variables by name, shape (n,) each: float64, int64, bool, or objects
            that are str or bytes.
        enumerations: of discrete variables that are enumerations the number of each item by its
            name.
    """

    names: tuple[str, ...]
    units: Mapping[str, str]
    time: FloatArray
    outputs: FloatArray
    steps: NDArray[np.void]
    summary: Mapping[str, Any]
    discrete: Mapping[str, DiscreteArray] = field(default_factory=dict)
    enumerations: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    @classmethod
    def of(cls, table: Table, steps: Steps, summary: Mapping[str, Any]) -> Result:
        """From its parts."""
        columns = table.columns
        return cls(
            names=columns.names,
            units=columns.all_units,
            time=table.time,
            outputs=table.outputs,
            steps=steps.to_array(),
            summary=summary,
            discrete=dict(zip(columns.discrete_names, table.discrete, strict=True)),
            enumerations=columns.items,
        )

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name == "time":
            return self.time
        if name in self.discrete:
            return self.discrete[name]
        try:
            return self.outputs[:, self._columns[name]]
        except KeyError:
            names = tuple(self)
            near = difflib.get_close_matches(name, names, n=3, cutoff=0.4)
            near = near or [full for full in names if full.endswith("." + name)][:3]
            hint = f"did you mean {' or '.join(near)}?" if near else "see result.names"
            raise KeyError(f"no variable {name}; {hint}") from None

    def __contains__(self, name: object) -> bool:
        return name == "time" or name in self._columns or name in self.discrete

    def __iter__(self) -> Iterator[str]:
        return iter((*self.names, *self.discrete))

    def __len__(self) -> int:
        """Number of result points."""
        return len(self.time)

    def __repr__(self) -> str:
        rejected = int(np.count_nonzero(~self.steps["accepted"]))
        shown = [f"{name} [{unit}]" if unit else name for name, unit in self.units.items()]
        more = f", ... ({len(shown)} in all)" if len(shown) > 8 else ""
        span = f" from {self.time[0]:g} to {self.time[-1]:g} s" if len(self.time) else ""
        return (
            f"<Result {self.summary.get('outcome', 'without an end')}: "
            f"{len(self.time)} result points{span}, "
            f"{len(self.steps)} attempts, {rejected} rejected\n"
            f"  {', '.join(shown[:8])}{more}>"
        )

    def _repr_html_(self) -> str:
        """For notebooks: the words, and the picture where there is something to draw."""
        words = f"<pre>{escape(repr(self))}</pre>"
        if not len(self) or not len(self.names):
            return words
        file = BytesIO()
        self.plot().savefig(file, format="png", dpi=_NOTEBOOK_DPI)
        picture = b64encode(file.getvalue()).decode()
        return f'{words}<img alt="results over time" src="data:image/png;base64,{picture}">'

    def _ipython_key_completions_(self) -> list[str]:
        return ["time", *self]

    @cached_property
    def _columns(self) -> dict[str, int]:
        return {name: column for column, name in enumerate(self.names)}

    def item_names(self, name: str) -> NDArray[np.object_]:
        """The names of an enumeration's items over ``time``, shape (n,); numbers of none as texts.

        Raises:
            KeyError: the variable is no enumeration whose items are known.
        """
        names = {number: item for item, number in self.enumerations[name].items()}
        numbers = self.discrete[name].tolist()
        return np.array([names.get(number, str(number)) for number in numbers], dtype=object)

    def to_array(self) -> NDArray[np.void]:
        """All rows as a structured array, shape (n,): ``time`` first, then the names."""
        rows = np.empty(len(self.time), [(name, self[name].dtype) for name in ("time", *self)])
        for name in ("time", *self):
            rows[name] = self[name]
        return rows

    def to_pandas(self) -> DataFrame:
        """All rows as a data frame of pandas, with ``time`` [s] as its index.

        Columns are in the order of the names, units in ``attrs["units"]``. Enumerations are
        numbers, see `item_names`.

        Raises:
            ImportError: pandas is not installed; ``pip install doublestep[pandas]``.
        """
        from pandas import DataFrame, Index  # noqa: PLC0415  an extra

        frame = DataFrame({name: self[name] for name in self}, index=Index(self.time, name="time"))
        frame.attrs["units"] = dict(self.units)
        return frame

    def plot(
        self,
        path: Path | str | None = None,
        show: bool = False,
        variables: Sequence[str] | None = None,
    ) -> Figure:
        """Draw outputs, step sizes and error norms over time.

        Args:
            path: file to write, its suffix is the format; None writes none.
            show: open a window.
            variables: names to draw; None draws them all.

        Raises:
            KeyError: no such variable, or one that holds no numbers.
            ResultsError: the file cannot be written.
        """
        # matplotlib takes half a second to import, which a run without a plot need not pay
        from master_node.results.plots import plot_result  # noqa: PLC0415

        return plot_result(self, None if path is None else Path(path), show, variables)

    @classmethod
    def load(cls, source: Path | str) -> Result:
        """Read a results directory, or one file with ``time`` in its first column.

        A directory may come from a run that goes on or was killed: an unfinished last line or
        batch is left out, ``steps`` and ``summary`` are empty where their files are missing. Of
        several formats the first of CSV, Arrow, Parquet and MAT is read. A file is read by its
        suffix, see `master_node.results.formats`, and without a known one as CSV.

        Raises:
            ResultsError: there are no results, or a file is malformed; names file and line.
        """
        source = Path(source)
        if not source.is_dir():
            return cls.of(read_results_file(source, NOTHING_KNOWN), Steps(), {})
        for name in FILES:
            check_is_file(source / name)
        summary = read_json(source / SUMMARY_FILE)
        known = Known.of(summary or read_json(source / START_FILE))
        return cls.of(read_results(source, known), read_steps(source / STEPS_FILE), summary)
