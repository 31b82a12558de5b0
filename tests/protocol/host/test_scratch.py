"""Temporary directories: none of a living process is touched, and none of a dead one stays."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from protocol.host import scratch
from protocol.host.scratch import PREFIX, ScratchDirectory
from tests.faults.test_processes import (
    BOUND,
    FOREVER,
    Command,
    has_stepped,
    system_file,
    wait_until,
)

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="locks of directories are those of POSIX"),
    pytest.mark.usefixtures("no_process_left"),
]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary directories are made."""
    folder = tmp_path / "place"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder


HOLD = """
from protocol.host.scratch import ScratchDirectory
made = ScratchDirectory()
(made.path / "folder").mkdir()
(made.path / "folder" / "file").write_text("full")
print(made.path, flush=True)
input()
"""


@pytest.fixture
def holder(place: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """Another process with a directory."""
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", HOLD], stdin=pipe, stdout=pipe, text=True) as made:
        assert made.stdout is not None
        yield made, Path(made.stdout.readline().strip())
        made.kill()


def test_what_a_killed_process_leaves_is_removed_by_the_next(
    holder: tuple[subprocess.Popen[str], Path], place: Path
) -> None:
    """Its directory stays as long as it lives, then the next who makes one removes it."""
    process, left = holder
    assert left.parent == place
    with ScratchDirectory() as own:
        assert left.exists()
        assert own.parent == place
    process.kill()
    process.wait(BOUND)
    assert (left / "folder" / "file").exists()
    with ScratchDirectory() as own:
        assert list(place.iterdir()) == [own]
    assert list(place.iterdir()) == []


@pytest.mark.slow
def test_what_is_not_ours_stays(place: Path, tmp_path: Path) -> None:
    """Other names, files, links with what is behind them, and directories of other users."""
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "file").write_text("precious")
    (place / "doublestep-other").mkdir()
    (place / f"{PREFIX}file").write_text("")
    (place / f"{PREFIX}link").symlink_to(outside)
    if os.getuid() == 0:
        (place / f"{PREFIX}foreign").mkdir()
        os.chown(place / f"{PREFIX}foreign", 12345, 12345)
    before = sorted(place.iterdir())
    with ScratchDirectory():
        pass
    assert sorted(place.iterdir()) == before
    assert (outside / "file").read_text() == "precious"


@pytest.mark.parametrize("answer", [None, BlockingIOError])
def test_a_directory_that_is_taken_for_abandoned_while_it_is_made(
    place: Path, monkeypatch: pytest.MonkeyPatch, answer: type[OSError] | None
) -> None:
    """Before its lock is there another process may remove it: another one is made."""
    lock, removed = scratch.lock_directory, []

    def lock_late(directory: Path) -> int | None:
        if removed:
            return lock(directory)
        shutil.rmtree(directory)
        removed.append(directory)
        if answer is not None:
            raise answer
        return lock(directory)

    monkeypatch.setattr(scratch, "lock_directory", lock_late)
    with ScratchDirectory() as own:
        assert own.exists()
        assert own not in removed
    assert list(place.iterdir()) == []


def test_a_killed_master_and_its_slaves_leave_nothing_for_ever(tmp_path: Path, place: Path) -> None:
    """SIGKILL of a master with launched slaves; the next run removes what they left."""
    file = system_file(tmp_path, simulation=FOREVER)
    master = Command(place, "master_node", "run", file, "--output", tmp_path / "a", "--no-plot")
    try:
        wait_until(lambda: has_stepped(tmp_path / "a"))
        family = [master.process, *master.process.children(recursive=True)]
        master.process.kill()
        psutil.wait_procs(family, timeout=BOUND)
    finally:
        master.close()
    assert list(place.iterdir()), "nothing was left: it proves nothing"
    options = ("--stop-time", 0.01, "--in-process", "--no-plot")
    after = Command(place, "master_node", "run", file, "--output", tmp_path / "b", *options)
    try:
        assert after.wait() == 0, after.text
    finally:
        after.close()
    assert list(place.iterdir()) == []
