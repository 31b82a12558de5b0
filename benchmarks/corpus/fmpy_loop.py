"""FMPy's own loop over one co-simulation FMU: ``python -m benchmarks.corpus.fmpy_loop FMU ...``.

`fmpy.simulate_fmu` with the same start, stop, step size and tolerance as the run that is compared
with it. FMI 3.0 in event mode where the FMU has one, and with early return, as Doublestep does.
Writes one JSON object: ``time``, and the outputs at these times by name.
"""

from __future__ import annotations

import json
import os
from argparse import ArgumentParser
from math import isclose
from pathlib import Path

import fmpy
import numpy as np


def main() -> None:
    """Run the loop; whatever goes wrong ends the process before the file is written."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("fmu")
    parser.add_argument("--output", type=Path, required=True)
    for name in ("start-time", "stop-time", "step-size", "tolerance"):
        parser.add_argument(f"--{name}", type=float, required=True)
    options = parser.parse_args()
    description = fmpy.read_model_description(options.fmu, validate=False)
    co_simulation = description.coSimulation
    result = fmpy.simulate_fmu(
        options.fmu,
        validate=False,
        fmi_type="CoSimulation",
        start_time=options.start_time,
        stop_time=options.stop_time,
        output_interval=options.step_size,
        relative_tolerance=options.tolerance,
        output=[v.name for v in description.modelVariables if v.causality == "output"],
        model_description=description,
        use_event_mode=bool(getattr(co_simulation, "hasEventMode", False)),
        early_return_allowed=bool(getattr(co_simulation, "mightReturnEarlyFromDoStep", False)),
    )
    rows = regular_rows(result["time"], options.start_time, options.step_size)
    columns = {"time": result["time"][rows].tolist()}
    for name in result.dtype.names[1:]:
        columns |= scalars(name, result[name][rows])
    options.output.write_text(json.dumps(columns), encoding="utf-8")
    os._exit(0)  # what an FMU left running is no part of the result


def regular_rows(time: np.ndarray, start: float, h: float) -> list[int]:
    """The last row of each communication point start + n h: FMPy also records at events."""
    rows: dict[int, int] = {}
    for row, t in enumerate(time):
        n = round((t - start) / h)
        if isclose(t, start + n * h, rel_tol=1e-9, abs_tol=1e-9 * h):
            rows[n] = row
    return list(rows.values())


def scalars(name: str, values: np.ndarray) -> dict[str, list[object]]:
    """The elements of an array by name, ``name[1,2]``; a scalar by its own."""
    if values.ndim == 1:
        return {name: values.tolist()}
    return {
        f"{name}[{','.join(str(i + 1) for i in index)}]": values[:, *index].tolist()
        for index in np.ndindex(values.shape[1:])
    }


if __name__ == "__main__":
    main()
