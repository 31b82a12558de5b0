"""Faults of slaves, disks, clocks and users, with real processes: see docs/reliability.md."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from master_node import Result, load_system, resume, simulate
from tests.faults.fault_points import router, run_point
from tests.faults.test_processes import (
    FOREVER,
    Command,
    Gates,
    MainCommand,
    Start,
    assert_summary,
    command,
    has_stepped,
    slave_processes,
    start,
    system_file,
    worker_of,
)
from tests.support.slow import quick_at
from tests.support.waiting import BOUND, wait_until

__all__ = ["command", "start"]  # the fixtures

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals and limits"),
    pytest.mark.usefixtures("no_process_left"),
]


def in_process_files(file: Path, directory: Path) -> list[bytes]:
    """The results of an undisturbed run."""
    simulate(load_system(file), output=directory, in_process=True)
    return files_of(directory)


def files_of(directory: Path) -> list[bytes]:
    """Results and steps of a run."""
    return [(directory / name).read_bytes() for name in ("results.csv", "steps.csv")]


# ---- A slave stops, crashes, hangs --------------------------------------------------------------


@pytest.mark.parametrize("victim", ["node", pytest.param("worker", marks=pytest.mark.slow)])
def test_a_slave_stopped_for_a_second_changes_nothing(
    victim: str, start: Start, tmp_path: Path, fmu_dir: Path
) -> None:
    """SIGSTOP for 1 s in mid run: the master waits, and the results are the same bytes."""
    gates = Gates(tmp_path, 0.03, 0.06)
    file = system_file(
        tmp_path,
        gates.model,
        fmu_dir / "wheel.fmu",
        simulation="stop_time = 0.1\n",
        chassis_parameters=gates.parameters,
    )
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out")
    gates.wait_at(0)
    node = slave_processes(master)["wheel"]
    process = node if victim == "node" else worker_of(node)
    process.suspend()
    gates.open(0)
    time.sleep(1.0)
    assert not gates.is_at(1), "it went on without its slave"
    process.resume()
    gates.wait_at(1)
    gates.open(1)
    assert master.wait() == 0, master.text
    assert files_of(tmp_path / "out") == in_process_files(file, tmp_path / "undisturbed")


@pytest.mark.parametrize(
    ("victim", "bus", "exit_code", "words"),
    [
        ("node", "reconnect_time = 1.0\n", 3, r"was lost and did not come back within 1 s"),
        ("worker", "step_timeout = 1.0\n", 5, r"no reply within 1 s"),
    ],
)
@pytest.mark.slow
def test_a_slave_stopped_for_ever_ends_the_run(  # noqa: PLR0917
    victim: str,
    bus: str,
    exit_code: int,
    words: str,
    start: Start,
    tmp_path: Path,
    fmu_dir: Path,
) -> None:
    """SIGSTOP without an end: slave, t, H and cause after the time that the user gave."""
    file = system_file(
        tmp_path,
        fmu_dir / "chassis.fmu",
        fmu_dir / "wheel.fmu",
        simulation=FOREVER + 'recovery = "off"\n',
        bus=bus,
    )
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out")
    master.wait_for("simulating")
    wait_until(lambda: has_stepped(tmp_path / "out"))
    node = slave_processes(master)["wheel"]
    (node if victim == "node" else worker_of(node)).suspend()
    assert master.wait() == exit_code, master.text
    last = master.text.splitlines()[-1]
    assert re.match(rf"master-node: wheel: do_step at t=.* s, H=.* s: .*{words}", last), last
    assert_summary(tmp_path / "out", "failed")


def lag_file(folder: Path, fmu: Path, *, bus: str = "", slave: str = "") -> Path:
    """One lag alone, 1 s with steps of 10 ms at most."""
    path = folder / "lag.toml"
    path.write_text(
        "[simulation]\nstop_time = 1.0\ninitial_step_size = 1e-2\nlargest_step_size = 1e-2\n"
        f'smallest_step_size = 1e-4\n[slaves.lag]\nmodel = "{fmu}"\n{slave}[bus]\n{bus}'
    )
    return path


@pytest.mark.parametrize(
    ("fmu", "exit_code", "words"),
    [
        ("crashes", 4, r"lag: do_step at t=.* s, H=.* s: the process that held the model died by"),
        ("hangs", 5, r"lag: do_step at t=.* s, H=.* s: no reply within 1 s"),
        ("not_finite", 4, r".*lag\.y.* is not finite"),
    ],
)
def test_a_faulty_fmu_ends_the_run_and_nothing_else(  # noqa: PLR0917
    fmu: str, exit_code: int, words: str, command: MainCommand, tmp_path: Path, capability_dir: Path
) -> None:
    """SIGSEGV, an endless loop, infinity: cause and place in one line, results up to there."""
    file = lag_file(tmp_path, capability_dir / f"{fmu}.fmu", bus="step_timeout = 1.0\n")
    options = ("--no-examine", "--no-plot", "--output", tmp_path / "out")
    code, text = command("run", file, *options)
    assert code == exit_code, text
    last = text.splitlines()[-1]
    assert re.search(f"^master-node: {words}", last), last
    assert "SIGSEGV" in last or fmu != "crashes"
    result = Result.load(tmp_path / "out")
    assert result.summary["outcome"] == "failed"
    assert 0.1 < result.time[-1] <= 0.25
    assert all(map(float, result["lag.y"]))


# ---- The user's machine -------------------------------------------------------------------------


def test_a_full_disk_ends_the_run_with_readable_results(tmp_path: Path) -> None:
    """Exit code 7 naming the file; what was written before is whole. The limit is the system's.

    When there is room again, ``resume`` goes on to the bytes of a run that always had room.
    """
    file = system_file(
        tmp_path,
        simulation="stop_time = 0.6\nlargest_step_size = 1e-3\ncheckpoint_interval = 0.1\n",
    )
    expected = in_process_files(file, tmp_path / "undisturbed")
    limit = len(expected[0]) // 2
    code = (
        f"import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}));"
        f"sys.argv = ['master-node', 'run', {str(file)!r}, '--in-process', '--no-plot',"
        f" '--output', {str(tmp_path / 'out')!r}];"
        "from master_node.cli.app import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=BOUND, check=False
    )
    assert done.returncode == 7, done.stderr
    last = done.stderr.splitlines()[-1]
    assert re.match(r"master-node: cannot write .*\.csv: File too large; choose", last), last
    result = Result.load(tmp_path / "out")
    assert len(result.time) > 100
    assert result.summary["outcome"] == "failed"
    resume(tmp_path / "out")
    assert files_of(tmp_path / "out") == expected


def test_a_second_run_into_one_directory_is_refused(
    start: Start, command: MainCommand, tmp_path: Path
) -> None:
    """Exit code 7, of ``resume`` too; the first run goes on and loses nothing."""
    file, out = system_file(tmp_path, simulation=FOREVER), tmp_path / "out"
    options = ("--in-process", "--no-plot", "--output", out)
    first = start("master_node", "run", file, *options)
    wait_until(lambda: has_stepped(out))
    for words in (("run", file, *options), ("resume", out)):
        code, text = command(*words)
        assert code == 7
        assert f"another run is writing into {out}; wait for its end" in text
    first.send(signal.SIGINT)
    assert first.wait() == 130
    assert_summary(out, "interrupted")


JUMPING = """
import os, time
_wall = time.time
_jumps = [0]
def time_of_day():
    _jumps[0] += 1
    return _wall() + (86400.0 if _jumps[0] % 2 else -86400.0)
time.time = time_of_day
open(os.path.join(os.path.dirname(__file__), f"jumped-{os.getpid()}"), "w").close()
"""


def test_a_jump_of_the_wall_clock_changes_nothing(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In all processes the time of day jumps by a day at every look; no wait depends on it."""
    file = system_file(tmp_path, simulation="stop_time = 0.2\n")
    expected = in_process_files(file, tmp_path / "undisturbed")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(JUMPING)
    path = os.pathsep.join([str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path.rstrip(os.pathsep))
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out")
    assert master.wait() == 0, master.text
    assert files_of(tmp_path / "out") == expected
    assert len(list((tmp_path / "site").glob("jumped-*"))) >= 5, "a master, two nodes, two workers"


STUBBORN = '''
from pathlib import Path
from time import sleep
from slave_node.model import Model, real

class Stubborn(Model):
    """Hears no interrupt."""

    states = (real("x"),)
    outputs = states

    def derivatives(self, t, x, u):
        Path(__file__).with_name("begun").touch()
        while True:
            try:
                sleep(60.0)
            except KeyboardInterrupt:
                Path(__file__).with_name("ignored").touch()
'''


@pytest.mark.parametrize("number", quick_at([signal.SIGINT], [signal.SIGINT, signal.SIGTERM]))
def test_a_second_ctrl_c_kills(number: signal.Signals, start: Start, tmp_path: Path) -> None:
    """The second Ctrl-C ends a run that the first cannot, as a model in process swallows it."""
    (tmp_path / "stubborn.py").write_text(STUBBORN)
    file = tmp_path / "stubborn.toml"
    file.write_text(
        "[simulation]\nstop_time = 1.0\n[slaves.stubborn]\n"
        f'model = "{tmp_path / "stubborn.py"}:Stubborn"\n'
    )
    options = ("--in-process", "--no-examine", "--output", tmp_path / "out")
    master: Command = start("master_node", "run", file, *options)
    wait_until((tmp_path / "begun").exists)
    master.send(number)
    wait_until((tmp_path / "ignored").exists)
    master.send(number)
    assert master.wait() == -number


# ---- The wrong model ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        pytest.param((), id="launched", marks=pytest.mark.slow),
        pytest.param(("--in-process",), id="in process"),
    ],
)
def test_a_model_with_another_hash_is_refused(
    options: tuple[str, ...], command: MainCommand, tmp_path: Path, fmu_dir: Path
) -> None:
    """Exit code 2 before a step, with both hashes; with the right one, in any case, it runs."""
    file = system_file(tmp_path, fmu_dir / "chassis.fmu", fmu_dir / "wheel.fmu")
    text = file.read_text()
    right = hashlib.sha256((fmu_dir / "wheel.fmu").read_bytes()).hexdigest()
    for given, exit_code in (("0" * 64, 2), (right.upper(), 0)):
        file.write_text(text.replace("[slaves.wheel]", f'[slaves.wheel]\nsha256 = "{given}"'))
        out = tmp_path / f"out {exit_code}"
        code, said = command("run", file, "--no-plot", "--output", out, *options)
        assert code == exit_code, said
        if exit_code:
            last = said.splitlines()[-1]
            assert f"[slaves.wheel] sha256 = '{given}'" in last
            assert right in last
            assert not (out / "results.csv").exists()


# ---- Drawn points -------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="uses signals and /proc")
def test_a_process_that_is_killed_stopped_or_cut_off_at_a_drawn_point(
    tmp_path: Path, fmu_dir: Path
) -> None:
    """One point of each kind; ``python -m benchmarks fault_points`` goes through 50 of them."""
    with router() as shared:
        points = []
        for number in (13, 26, 39):
            (tmp_path / str(number)).mkdir()
            points.append(run_point(number, fmu_dir, tmp_path / str(number), shared))
    assert [str(point.fault) for point in points] == [
        "kill worker of wheel",
        "stop node of wheel",
        "cut router",
    ]
