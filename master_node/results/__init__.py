"""Results: written while the run goes on, recorded in memory, read back.

A results directory holds, as far as ``[results] formats`` asks for it,

* ``results.csv``: ``time``, then ``slave.variable`` in the order of the run; one row per
  communication point, T_0 first;
* ``results.arrow``: the same as an Arrow IPC stream;
* ``results.parquet`` and ``results.mat``: the same as Parquet, and as MAT version 4 in the layout
  of Dymola, written at the end;

and always

* ``steps.csv``: one row per attempted step, the fields of ``Attempt``;
* ``summary.json``: counters and settings, written last. Where it is missing the run did not get
  to its end; the files that are written on the way are then complete up to the last flush.

In the CSV files numbers are written with ``repr``, the shortest text that reads back to the same
bits: equal numbers give equal files, byte for byte.
"""

from master_node.results.completion import finish, is_complete
from master_node.results.exclusive import exclusive
from master_node.results.files import (
    PLOT_FILE,
    STEPS_FILE,
    SUMMARY_FILE,
)
from master_node.results.recording import Recording
from master_node.results.result import Result
from master_node.results.selection import SelectedResults, SelectionMemory, check_variables
from master_node.results.steps_file import STEPS_DTYPE
from master_node.results.summary import summarize
from master_node.results.writer import ResultsWriter

__all__ = [
    "PLOT_FILE",
    "STEPS_DTYPE",
    "STEPS_FILE",
    "SUMMARY_FILE",
    "Recording",
    "Result",
    "ResultsWriter",
    "SelectedResults",
    "SelectionMemory",
    "check_variables",
    "exclusive",
    "finish",
    "is_complete",
    "summarize",
]
