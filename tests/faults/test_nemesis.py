"""Drawn systems under drawn faults, with real processes: the same files as undisturbed.

Many more: ``python -m benchmarks nemesis --seeds 1000``.
"""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import pytest

from master_node import load_system, simulate
from tests.faults.fault_points import Router, router
from tests.faults.nemesis.cast import Cast
from tests.faults.nemesis.faults import draw_faults
from tests.faults.nemesis.seeds import BrokenLawError, compare, run_seed
from tests.faults.nemesis.systems import draw_system
from tests.faults.test_processes import system_file

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="uses signals, limits and /proc"),
    pytest.mark.usefixtures("no_process_left"),
]

QUICK = (7,)
SLOW = tuple(seed for seed in range(1, 21) if seed not in QUICK)


@pytest.fixture(scope="module")
def fmus(no_rollback_dir: Path, oscillator_dir: Path, tmp_path_factory: pytest.TempPathFactory):
    """The FMUs of the examples that are drawn from, each in its folder."""
    folder = tmp_path_factory.mktemp("fmus")
    (folder / "no_rollback").symlink_to(no_rollback_dir)
    (folder / "quarter_car").symlink_to(no_rollback_dir.parent / "quarter_car")
    (folder / "oscillators").symlink_to(oscillator_dir)
    return folder


@pytest.fixture(scope="module")
def shared_router() -> Iterator[Router]:
    """One for all seeds."""
    with router() as made:
        yield made


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Undisturbed runs warn of settings that are drawn."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize(
    "seed", [*QUICK, *(pytest.param(seed, marks=pytest.mark.slow) for seed in SLOW)]
)
def test_a_disturbed_run_ends_with_the_same_files(
    seed: int, fmus: Path, tmp_path: Path, shared_router: Router
) -> None:
    """Law: after kills, stops, interrupts, cuts and full disks, with `resume` where a run ended."""
    run_seed(seed, fmus, tmp_path, shared_router.endpoint)


def test_what_is_drawn_follows_from_the_seed(fmus: Path) -> None:
    """And all ways to run, states, formats and faults are drawn."""

    def drawn(seed: int):
        random = Random(seed)
        system = draw_system(random, fmus)
        return system, draw_faults(random, system, 100)

    seen = set()
    for seed in range(200):
        system, faults = drawn(seed)
        assert (system, faults) == drawn(seed)
        seen |= {system.way, *system.tables["results"]["formats"]}
        seen |= {slave.get("state") for slave in system.slaves.values()}
        seen |= {word for fault in faults for word in (fault.kind, fault.part)}
    assert seen >= {"in process", "launched", "routed", "served", "agent", "csv", "arrow"}
    assert seen >= {"parquet", "mat", "native", "fork", "replay", "none", "kill", "stop"}
    assert seen >= {"interrupt", "full disk", "cut", "stall", "delay", "node", "worker", "holder"}


# ---- What must be found -------------------------------------------------------------------------


def last_bit(folder: Path) -> None:
    """A number differs in its last digit."""
    text = (folder / "results.csv").read_bytes().rstrip()
    digit = b"1" if text.endswith(b"2") else b"2"
    (folder / "results.csv").write_bytes(text[:-1] + digit + b"\n")


def lost_row(folder: Path) -> None:
    """The last row is not there."""
    rows = (folder / "steps.csv").read_bytes().splitlines(keepends=True)
    (folder / "steps.csv").write_bytes(b"".join(rows[:-1]))


def lost_file(folder: Path) -> None:
    """A file is not there."""
    (folder / "results.arrow").unlink()


def further_file(folder: Path) -> None:
    """A file is left."""
    (folder / ".results.part").touch()


def other_numbers(folder: Path) -> None:
    """Columns are those of another run."""
    (folder / "results.parquet").write_bytes(
        (folder.parent / "other" / "results.parquet").read_bytes()
    )


@pytest.mark.parametrize("plant", [last_bit, lost_row, lost_file, further_file, other_numbers])
def test_a_difference_between_two_runs_is_found(
    plant: Callable[[Path], None], tmp_path: Path
) -> None:
    """Equal runs are equal; a bit, a row, a file, the numbers of a file."""
    system = load_system(system_file(tmp_path)).with_results(
        formats=("csv", "arrow", "parquet", "mat")
    )
    for name, stop_time in (("a", 0.02), ("b", 0.02), ("other", 0.04)):
        simulate(system, output=tmp_path / name, in_process=True, stop_time=stop_time)
    compare(tmp_path / "a", tmp_path / "b")
    plant(tmp_path / "b")
    with pytest.raises(BrokenLawError):
        compare(tmp_path / "a", tmp_path / "b")


@pytest.mark.slow
def test_a_process_that_is_left_is_found(
    fmus: Path, tmp_path: Path, shared_router: Router, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that a run left is ended, and the seed is named."""

    def leave_one(cast: Cast, _: object) -> bool:
        subprocess.run(["sh", "-c", "sleep 600 &"], env=cast._environment(), check=True)
        return True

    monkeypatch.setattr(Cast, "suffer", leave_one)
    monkeypatch.setattr("tests.faults.nemesis.cast._TIME_TO_END", 1.0)
    with pytest.raises(BrokenLawError, match=r"processes are left: .*sleep 600") as info:
        run_seed(QUICK[0], fmus, tmp_path, shared_router.endpoint)
    assert info.value.__notes__[0] == (
        f"seed {QUICK[0]}: python -m benchmarks nemesis --seeds 1 --first {QUICK[0]}"
    )
