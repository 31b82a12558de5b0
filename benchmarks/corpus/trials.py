"""Trials of one model, each in processes of its own, and their ends."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import asdict, dataclass
from enum import StrEnum
from math import isfinite
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.bounded import Bound, Outcome, run_bounded
from benchmarks.corpus.comparison import compare
from benchmarks.corpus.experiment import TOLERANCE, experiment_of
from benchmarks.corpus.models import CorpusModel
from master_node.results import Result
from protocol.errors import ResultsError

_ROOT = Path(__file__).parents[2]
_SLAVE = "model"
_REFUSALS = range(2, 8)
"""Exit codes of errors that the program tells in a sentence."""
_OUR_TRACEBACK = re.compile(
    r"Traceback \(most recent call last\)(?:.*\n)+?.*[/\\](?:master_node|slave_node|protocol)[/\\]"
)
_TRIALS_A_VALIDATION = 10
_REQUESTS_A_RUN = 4


class End(StrEnum):
    """The end of a trial."""

    DONE = "done"
    REFUSED = "refused"
    TRACEBACK = "traceback"
    CRASH = "crash"
    HANG = "hang"
    SLOW = "slow"
    MEMORY = "memory"
    LEFT_PROCESSES = "left processes"
    NOT_TRIED = "not tried"


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial.

    Attributes:
        end: how it ended.
        reason: the sentence of a refusal, or what else is known of the end.
        seconds: it took [s].
        warnings: that the program gave.
        numbers: that a run counts in its summary.
    """

    end: End
    reason: str = ""
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    numbers: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds on each trial: time [s], memory [B], and communication steps of a run."""

    seconds: float
    memory_bytes: float
    steps: int


NOT_TRIED = Trial(End.NOT_TRIED)


def try_model(model: CorpusModel, bounds: Bounds) -> dict[str, Any]:
    """All trials of a model, as plain data.

    * ``validate``: ``slave-node validate``.
    * ``fixed``: a run of the model alone, inputs held, with a fixed communication step size.
    * ``fmpy``: `fmpy.simulate_fmu` over the same steps, and ``comparison`` of both, bit for bit.
    * ``alone``: the same run with the defaults, over the bus.
    * ``coupled``: with the defaults, in a loop with `benchmarks.corpus.lag.Lag`.

    A model without a binary for 64-bit Linux is validated only.
    """
    record: dict[str, Any] = {
        "file": model.path.name,
        "sha256": model.sha256,
        "tool": model.tool,
        "version": model.version,
        "has_binary": model.has_binary,
    }
    with TemporaryDirectory(prefix="corpus-") as scratch:
        trials = _Trials(model.path, bounds, Path(scratch))
        record["validate"] = asdict(trials.validate())
        if not model.has_binary:
            return record
        record["experiment"] = asdict(trials.experiment)
        record["fixed"] = asdict(trials.fixed())
        record["fmpy"] = asdict(trials.fmpy())
        record["comparison"] = trials.comparison()
        alone = trials.alone()
        record["alone"] = asdict(alone)
        record["coupled"] = asdict(trials.coupled() if alone.end is End.DONE else NOT_TRIED)
    return record


class _Trials:
    """The trials of one model.

    Args:
        fmu: file or folder.
        bounds: on each trial.
        scratch: an empty directory.
    """

    def __init__(self, fmu: Path, bounds: Bounds, scratch: Path) -> None:
        self._fmu = fmu.resolve()
        self._bounds = bounds
        self._scratch = scratch
        self._columns_file = scratch / "fmpy.json"
        self.experiment = experiment_of(fmu, bounds.steps)

    def validate(self) -> Trial:
        """``slave-node validate``; a model that cannot be run is a refusal with its problem."""
        bound = self._bounds.seconds / _TRIALS_A_VALIDATION
        outcome = self._run(
            "slave_node", "validate", str(self._fmu), "--json", "--timeout", f"{bound:g}"
        )
        trial = judged(outcome)
        try:
            findings = json.loads(outcome.stdout)
        except ValueError:
            if trial.end is End.DONE:
                return Trial(End.CRASH, "its report is no JSON", trial.seconds)
            return trial
        problems = [f for f in findings if f["grade"] == "problem"]
        reason = "; ".join(f"{f['what']}: {f['result']}" for f in problems)
        notes = tuple(f"{f['what']}: {f['result']}" for f in findings if f["grade"] == "note")
        return Trial(trial.end, reason or trial.reason, trial.seconds, notes)

    def fixed(self) -> Trial:
        """The model alone with a fixed step size, in process."""
        settings = {
            "estimator": "none",
            "initial_step_size": self.experiment.step_size,
            "slave_tolerance": TOLERANCE,
        }
        return self._simulate("fixed", settings, "--in-process")

    def fmpy(self) -> Trial:
        """FMPy's loop; its columns are kept for the comparison."""
        experiment = self.experiment
        if not experiment.is_co_simulation:
            return Trial(End.NOT_TRIED, "model exchange: FMPy integrates it by other steps")
        arguments = {
            "start-time": experiment.start_time,
            "stop-time": experiment.stop_time,
            "step-size": experiment.step_size,
            "tolerance": TOLERANCE,
        }
        outcome = self._run(
            "benchmarks.corpus.fmpy_loop",
            str(self._fmu),
            f"--output={self._columns_file}",
            *(f"--{name}={value!r}" for name, value in arguments.items()),
        )
        if self._columns_file.is_file():
            return Trial(End.DONE, "", outcome.seconds)
        end = {Bound.TIME: End.HANG, Bound.MEMORY: End.MEMORY, None: End.REFUSED}[outcome.bound]
        how = _last_line(outcome.stderr) or f"ended with exit code {outcome.exit_code}"
        return Trial(end, how, outcome.seconds)

    def comparison(self) -> dict[str, Any] | None:
        """Comparison of both; None: one of them did not end."""
        result = self._result("fixed")
        if result is None or result.summary.get("outcome") != "completed":
            return None
        if not self._columns_file.is_file():
            return None
        columns = json.loads(self._columns_file.read_text(encoding="utf-8"))
        return asdict(compare(result, _SLAVE, columns))

    def alone(self) -> Trial:
        """The model alone with the defaults, over the bus."""
        return self._simulate("alone", {})

    def coupled(self) -> Trial:
        """The model with a lag between its first moving output and its first input."""
        tables = self._coupling()
        if not tables:
            return Trial(End.NOT_TRIED, "it has no continuous inputs or outputs")
        return self._simulate("coupled", {}, tables=tables)

    def _coupling(self) -> str:
        """The tables of the lag and its connections, scaled by what the outputs did alone."""
        experiment = self.experiment
        parameters = {"T": 5.0 * experiment.step_size}
        connections = []
        if experiment.outputs:
            output, offset, scale = self._moving_output()
            parameters |= {"offset": offset, "scale": scale}
            connections.append((f"{_SLAVE}.{output}", "lag.y"))
        if experiment.inputs:
            name, base = next(iter(experiment.inputs.items()))
            parameters |= {"base": base, "amplitude": 0.01 * max(1.0, abs(base))}
            connections.append(("lag.u", f"{_SLAVE}.{name}"))
        if not connections:
            return ""
        lag = Path(__file__).with_name("lag.py")
        values = ", ".join(f"{name} = {value!r}" for name, value in parameters.items())
        tables = [f"[slaves.lag]\nmodel = {_text(f'{lag}:Lag')}\nparameters = {{ {values} }}"]
        tables += [
            f"[[connections]]\nfrom = {_text(source)}\nto = {_text(target)}"
            for source, target in connections
        ]
        return "\n".join(tables)

    def _moving_output(self) -> tuple[str, float, float]:
        """The first continuous output that moved alone, its first value, and its range."""
        result = self._result("alone")
        found = None
        for name in self.experiment.outputs:
            full = f"{_SLAVE}.{name}"
            if result is None or full not in result:
                continue
            values = [v for v in result[full].tolist() if isinstance(v, float) and isfinite(v)]
            spread = max(values) - min(values) if values else 0.0
            found = found or (name, values[0] if values else 0.0, 1.0)
            if spread > 0.0:
                return name, values[0], spread
        return found or (self.experiment.outputs[0], 0.0, 1.0)

    def _simulate(
        self, name: str, settings: dict[str, Any], *options: str, tables: str = ""
    ) -> Trial:
        """``master-node run`` of the model."""
        times = {
            "start_time": self.experiment.start_time,
            "stop_time": self.experiment.stop_time,
        }
        lines = ["[simulation]", *(f"{k} = {_value(v)}" for k, v in (times | settings).items())]
        lines += ["[bus]", f"step_timeout = {self._bounds.seconds / _REQUESTS_A_RUN:g}"]
        lines += [f"[slaves.{_SLAVE}]", f"model = {_text(str(self._fmu))}", tables]
        file = self._scratch / f"{name}.toml"
        file.write_text("\n".join(lines), encoding="utf-8")
        directory = str(self._scratch / name)
        quiet = ("--quiet", "--no-plot")
        outcome = self._run(
            "master_node", "run", str(file), *quiet, *options, "--output", directory
        )
        trial = judged(outcome)
        result = self._result(name)
        if trial.end is End.HANG and result is not None and len(result.time) > 1:
            reached = f"t={result.time[-1]:g} s of {self.experiment.stop_time:g} s"
            return Trial(End.SLOW, f"reached {reached}", trial.seconds, trial.warnings)
        if result is None:
            return trial
        counted = ("outcome", "communication_steps", "rejected_double_steps", "round_trips")
        numbers = {key: result.summary.get(key) for key in counted}
        numbers["do_steps"] = result.summary.get("do_steps", {}).get(_SLAVE)
        return Trial(trial.end, trial.reason, trial.seconds, trial.warnings, numbers)

    def _result(self, name: str) -> Result | None:
        try:
            return Result.load(self._scratch / name)
        except ResultsError:
            return None

    def _run(self, module: str, *arguments: str) -> Outcome:
        """A module of this checkout, wherever the working directory is."""
        working = self._scratch / "working"
        working.mkdir(exist_ok=True)
        return run_bounded(
            [sys.executable, "-m", module, *arguments],
            working,
            {"PYTHONPATH": str(_ROOT)},
            self._bounds.seconds,
            self._bounds.memory_bytes,
        )


def judged(outcome: Outcome) -> Trial:
    """The end of a command of ours."""
    warnings = tuple(dict.fromkeys(re.findall(r"^WARNING:? (.*)$", outcome.stderr, re.M)))
    last = _last_line(outcome.stderr)
    if outcome.bound is Bound.MEMORY:
        end = End.MEMORY
    elif outcome.bound is Bound.TIME:
        end = End.HANG
    elif _OUR_TRACEBACK.search(outcome.stderr):
        end = End.TRACEBACK
    elif outcome.exit_code in _REFUSALS:
        end = End.REFUSED
    elif outcome.exit_code:
        end, last = End.CRASH, f"exit code {outcome.exit_code}: {last}"
    elif outcome.left:
        end, last = End.LEFT_PROCESSES, "; ".join(outcome.left)
    else:
        end, last = End.DONE, ""
    return Trial(end, last, outcome.seconds, warnings)


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    ours = [line for line in lines if line.startswith(("master-node: ", "slave-node: "))]
    return (ours or lines or [""])[-1][:1000]


def _value(value: object) -> str:
    return _text(value) if isinstance(value, str) else repr(value)


def _text(text: str) -> str:
    """A basic string of TOML."""
    return json.dumps(text)
