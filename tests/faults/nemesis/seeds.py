"""A seed: a system, what happens to it, and the laws that hold for all of them."""

from __future__ import annotations

import json
import shutil
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import pyarrow
import pyarrow.parquet
import tomli_w

from master_node import load_system, simulate
from protocol.errors import ConfigurationError, DoublestepError, StepSizeError
from protocol.host.scratch import ScratchDirectory
from tests.faults.nemesis.cast import Cast
from tests.faults.nemesis.faults import Fault, draw_faults
from tests.faults.nemesis.systems import DrawnSystem, draw_system
from tests.support.waiting import BOUND

_DRAWS = 100
_MOST_ATTEMPTS = 200
_COUNTERS = ("outcome", "communication_steps", "rejected_double_steps", "discontinuities")
_ENDS = {"kill": {-9}, "interrupt": {130, -1, -2, -15}, "full disk": {7}}
"""Exit codes of a master by what happened to it."""

_SERVICES = ("node", "agent")


class BrokenLawError(AssertionError):
    """A law was broken."""


@dataclass
class Outcome:
    """Outcome of one seed.

    Attributes:
        system: that was run.
        faults: each with whether it found its victim.
        codes: exit codes of all masters.
        time: that it took [s], starts of all processes included.
    """

    system: DrawnSystem
    faults: list[tuple[Fault, bool]]
    codes: list[int]
    time: float


class _Counter:
    """An observer that counts attempted steps."""

    def __init__(self) -> None:
        self.attempts = 0

    def started(self, _: object) -> None:
        """See `Observer`."""

    def attempted(self, _: object) -> None:
        """See `Observer`; ends a run that is no small one."""
        self.attempts += 1
        if self.attempts > _MOST_ATTEMPTS:
            raise ConfigurationError("too many steps")

    def ended(self, _: object) -> None:
        """See `Observer`."""


@dataclass
class _Nemesis:
    """Lets faults happen as attempts are told."""

    faults: Sequence[Fault]
    attempts: int = 0
    happened: list[tuple[Fault, bool]] = field(default_factory=list)
    _threads: list[threading.Thread] = field(default_factory=list)

    def attempted(self) -> None:
        """Count; called at the first start, too."""
        for fault in self.faults:
            if fault.attempt == self.attempts:
                thread = threading.Thread(target=self._happen, args=(fault,), name=str(fault))
                self._threads.append(thread)
                thread.start()
        self.attempts += 1

    def watch(self, cast: Cast) -> None:
        """Keep the cast, to which the faults happen."""
        self._cast = cast

    def wait(self) -> None:
        """Until all that was begun is over."""
        for thread in self._threads:
            thread.join(BOUND)

    def _happen(self, fault: Fault) -> None:
        time.sleep(fault.delay)
        self.happened.append((fault, self._cast.suffer(fault)))


def run_seed(seed: int, fmus: Path, folder: Path, router: str) -> Outcome:
    """Run what a seed draws, undisturbed and disturbed, and compare.

    Args:
        seed: decides all but the very moment within a request.
        fmus: folder with the FMUs of each example in a folder.
        folder: empty, for what is written.
        router: endpoint of a router.

    Raises:
        BrokenLawError: a law did not hold; notes say what was run and how to repeat it.
    """
    random = Random(seed)
    system, attempts = _drawn(random, fmus, folder / "undisturbed")
    nemesis = _Nemesis(draw_faults(random, system, attempts))
    try:
        begin = time.monotonic()
        codes = _disturbed(system, nemesis, folder, router)
        return Outcome(system, nemesis.happened, codes, time.monotonic() - begin)
    except BaseException as error:
        error.add_note(f"seed {seed}: python -m benchmarks nemesis --seeds 1 --first {seed}")
        error.add_note(f"system: {system}")
        error.add_note(f"faults: {'; '.join(map(str, nemesis.faults))}")
        raise


def _drawn(random: Random, fmus: Path, out: Path) -> tuple[DrawnSystem, int]:
    """A system that runs undisturbed, and how many steps it attempts."""
    for _ in range(_DRAWS):
        system, counter = draw_system(random, fmus), _Counter()
        file = out.with_suffix(".toml")
        file.write_text(tomli_w.dumps(dict(system.tables)), encoding="utf-8")
        try:
            simulate(load_system(file), output=out, in_process=True, observers=(counter,))
        except DoublestepError as error:  # settings that do not go together
            shutil.rmtree(out, ignore_errors=True)
            if not isinstance(error, ConfigurationError | StepSizeError):
                raise
            continue
        return system, counter.attempts
    raise BrokenLawError("no settings go together")


def _disturbed(system: DrawnSystem, nemesis: _Nemesis, folder: Path, router: str) -> list[int]:
    cast = Cast(system, folder, router, nemesis.attempted)
    nemesis.watch(cast)
    codes = []
    try:
        nemesis.attempted()
        while not codes or not _is_completed(cast.out):
            codes.append(cast.run_master(again=(cast.out / "checkpoint").is_dir()))
            _law(len(codes) <= len(nemesis.faults) + 1, f"masters end again and again: {codes}")
    finally:
        cast.dismiss()
        nemesis.wait()
        ended = cast.close()
        left = cast.left()
    _law(_exit_codes(nemesis.faults, system) >= {*codes}, f"exit codes {codes}: {_errors(cast)}")
    of_services = {code for _, code in ended}
    _law(
        _codes_of_services(nemesis.faults, system) >= of_services,
        f"slaves or agents end so: {ended}",
    )
    _law(not left, f"processes are left: {left}")
    for name, text in cast.told().items():
        _law("Traceback" not in text, f"a traceback of {name}:\n{text}")
    _law(not _left_files(folder / "tmp"), f"files are left: {_left_files(folder / 'tmp')}")
    compare(folder / "undisturbed", cast.out)
    return codes


def _exit_codes(faults: Sequence[Fault], system: DrawnSystem) -> set[int]:
    """With which masters may end that these happened to, directly or not."""
    codes = {0}.union(*(_ENDS.get(fault.kind, set()) for fault in faults if fault.part == "master"))
    if any(fault.kind == "full disk" for fault in faults):
        codes |= {2, 3}  # a model cannot be extracted there, at the start or after a kill
    is_started_again = len(codes) > 1
    if any(f.kind == "kill" and _is_lost(f, system, is_started_again) for f in faults):
        codes.add(3)
    return codes


def _codes_of_services(faults: Sequence[Fault], system: DrawnSystem) -> set[int | None]:
    """Exit codes of slaves by hand and agents: 3 if a model's process died while it was loaded."""
    kills = [fault for fault in faults if fault.kind == "kill"]
    codes: set[int | None] = {0}
    if any(fault.part in _SERVICES for fault in kills):
        codes.add(-9)
    if system.way == "served" and any(f.part == "worker" and not f.attempt for f in kills):
        codes.add(3)
    return codes


def _is_lost(fault: Fault, system: DrawnSystem, is_started_again: bool) -> bool:
    """True if the master may not be able to replace what was killed, see docs/recovery.md."""
    if fault.part == "agent" or system.way == "in process":
        return True
    is_loading = fault.attempt == 0 or is_started_again
    return is_loading or (fault.part == "node" and system.way == "served")


def _is_completed(out: Path) -> bool:
    try:
        return _summary(out)["outcome"] == "completed" and not (out / "checkpoint").exists()
    except OSError:
        return False


def _summary(out: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    return summary


def _left_files(scratch: Path) -> list[Path]:
    """In the directory for temporary files, once a command came by that tidies up."""
    before, tempfile.tempdir = tempfile.tempdir, str(scratch)
    try:
        ScratchDirectory().close()
    finally:
        tempfile.tempdir = before
    return list(scratch.iterdir())


def _errors(cast: Cast) -> str:
    """Errors that masters ended with."""
    lines = cast.told().get("master", "").splitlines()
    return " | ".join(line for line in lines if line.startswith("master-node: "))


def compare(undisturbed: Path, disturbed: Path) -> None:
    """Compare all files of two runs: byte for byte, but Arrow and Parquet by their numbers.

    Raises:
        BrokenLawError: names the file that differs.
    """
    expected, found = _files(undisturbed), _files(disturbed)
    _law(expected.keys() == found.keys(), f"files {sorted(found)} in place of {sorted(expected)}")
    for name, path in found.items():
        _law(_content(expected[name]) == _content(path), f"{name} differs")
    counters = [{key: _summary(out)[key] for key in _COUNTERS} for out in (undisturbed, disturbed)]
    _law(counters[0] == counters[1], f"the summaries differ: {counters}")


def _files(out: Path) -> dict[str, Path]:
    """But for what differs between any two runs."""
    others = {"summary.json", "logs"}
    return {path.name: path for path in out.iterdir() if path.name not in others}


def _content(path: Path) -> object:
    """Batches may be others after a `resume`, the numbers must not."""
    match path.suffix:
        case ".arrow":
            with pyarrow.ipc.open_stream(path) as reader:
                return _columns(reader.read_all())
        case ".parquet":
            return _columns(pyarrow.parquet.read_table(path))
    return path.read_bytes()


def _columns(table: pyarrow.Table) -> dict[str, bytes]:
    """The bits of all numbers."""
    return {
        name: repr(table[name].type).encode()
        + table[name].combine_chunks().to_numpy(zero_copy_only=False).tobytes()
        for name in table.column_names
    }


def _law(holds: bool, otherwise: str) -> None:
    if not holds:
        raise BrokenLawError(otherwise)
