"""``steps.csv``: one row per attempted step, the fields of ``Attempt``."""

from __future__ import annotations

import csv
from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from master_node.observing.observers import Attempt
from master_node.results.csv_file import finished, opened
from master_node.results.files import LineFile, cannot_read, malformed, one_field

STEPS_DTYPE = np.dtype(
    [
        ("time", np.float64),
        ("step_size", np.float64),
        ("order", np.int64),
        ("derivative_points", np.int64),
        ("iterations", np.int64),
        ("error_norm", np.float64),
        ("accepted", np.bool_),
        ("limiting_variable", np.object_),
    ]
)
"""``Result.steps`` and the columns of ``steps.csv``; ``limiting_variable`` holds str."""

_COLUMNS = tuple(STEPS_DTYPE.names or ())


class StepsFile(LineFile):
    """The file while a run goes on.

    Args:
        path: of the file.
        output_names: what the limiting variable is most of the time.
        rows: how many rows of it count; None: it is a new one.
    """

    def __init__(self, path: Path, output_names: Sequence[str], rows: int | None = None) -> None:
        super().__init__(path, ",".join(_COLUMNS) + "\n", rows)
        self._quoted = {name: one_field(name) for name in output_names}

    def append(self, attempt: Attempt) -> None:
        """Hold one row back for the next ``flush``."""
        name = attempt.limiting_variable
        self._add(
            f"{float(attempt.time)!r},{float(attempt.step_size)!r},{attempt.order:d},"
            f"{attempt.derivative_points:d},{attempt.iterations:d},"
            f"{float(attempt.error_norm)!r},{'true' if attempt.accepted else 'false'},"
            f"{self._quoted.get(name) or one_field(name)}\n"
        )


class Steps:
    """Attempts in growing arrays; 56 bytes each, whatever the text."""

    def __init__(self) -> None:
        self._numbers = array("d")
        self._texts: list[str] = []
        self._known: dict[str, str] = {}

    def append(self, attempt: Attempt) -> None:
        """Note one attempt, but for its points."""
        a = attempt
        self._numbers.extend(
            (
                a.time,
                a.step_size,
                a.order,
                a.derivative_points,
                a.iterations,
                a.error_norm,
                a.accepted,
            )
        )
        self._texts.append(self._known.setdefault(a.limiting_variable, a.limiting_variable))

    def __len__(self) -> int:
        """Number of attempts."""
        return len(self._texts)

    def cut(self, number: int) -> None:
        """Keep only the first ``number`` attempts."""
        del self._texts[number:], self._numbers[number * (len(_COLUMNS) - 1) :]

    def to_array(self) -> NDArray[np.void]:
        """A copy of ``STEPS_DTYPE``."""
        numbers = np.array(self._numbers).reshape(-1, len(_COLUMNS) - 1)
        steps = np.empty(len(numbers), STEPS_DTYPE)
        for column, name in enumerate(_COLUMNS[:-1]):
            steps[name] = numbers[:, column]
        steps[_COLUMNS[-1]] = self._texts
        return steps


def read_steps(path: Path) -> Steps:
    """The attempts in a file; none where it is missing.

    Raises:
        ResultsError: it cannot be read or is malformed; names the line.
    """
    steps = Steps()
    flags = {"true": True, "false": False}
    try:
        with opened(path) as file:
            reader = csv.reader(finished(file))
            if next(reader, list(_COLUMNS)) != list(_COLUMNS):
                raise malformed(path, f"the columns must be {','.join(_COLUMNS)}", 1)
            for row in reader:
                try:
                    time, step_size, order, points, iterations, error_norm, accepted, text = row
                    attempt = Attempt(
                        float(time),
                        float(step_size),
                        int(order),
                        int(points),
                        float(error_norm),
                        flags[accepted],
                        text,
                        iterations=int(iterations),
                    )
                except (ValueError, KeyError):
                    what = f"expected an attempted step, found {','.join(row)[:80]!r}"
                    raise malformed(path, what, reader.line_num) from None
                steps.append(attempt)
    except FileNotFoundError:
        pass
    except csv.Error as error:
        raise malformed(path, str(error), reader.line_num) from error
    except OSError as error:
        raise cannot_read(path, error) from error
    return steps
