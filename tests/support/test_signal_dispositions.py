"""The suite starts commands as a login shell does, whatever started the suite."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from tests.support.waiting import BOUND

pytestmark = pytest.mark.skipif(os.name != "posix", reason="uses signals")

NOHUP = """
import signal, subprocess, sys
from tests.support.signal_dispositions import default_dispositions

def of_a_command():
    code = "import signal; print(*(signal.getsignal(n).__repr__() for n in (1, 2)))"
    return subprocess.check_output([sys.executable, "-c", code], text=True).strip()

print(of_a_command())
with default_dispositions():
    print(of_a_command())
    signal.raise_signal(signal.SIGHUP)  # is outlived
print(of_a_command())
"""


def test_commands_can_be_interrupted_also_where_the_suite_runs_under_nohup() -> None:
    """SIGINT and SIGHUP are ignored here as under ``nohup ... &``, and not by what is started."""

    def ignore() -> None:
        for number in (signal.SIGHUP, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)

    said = subprocess.run(
        [sys.executable, "-c", NOHUP],
        preexec_fn=ignore,
        capture_output=True,
        text=True,
        check=True,
        timeout=BOUND,
    ).stdout.splitlines()
    ignored, meanwhile, after = said
    assert ignored.count("SIG_IGN") == 2
    assert "SIG_IGN" not in meanwhile
    assert after == ignored
