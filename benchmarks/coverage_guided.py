"""Hostile messages that are guided by coverage, with Atheris: against the codec, and a slave.

``python -m benchmarks coverage_guided --runs 1000000``. Needs ``pip install 'doublestep[fuzz]'``.
Ends with an error if a message made codec or slave do what they must not do; it is named then.
"""

import re
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from importlib.util import find_spec
from pathlib import Path

_SCRIPT = Path(__file__).parents[1] / "tests" / "faults" / "fuzz" / "coverage_guided.py"
_HANG_TIME = 60
_MEMORY_MB = 500
_STATUS = re.compile(r"#(\d+)\s+DONE\s+cov: (\d+) .*rss: (\d+)Mb")


def main(words: list[str]) -> None:
    """Run and print a table.

    Raises:
        SystemExit: Atheris is not installed, or a law of `tests.faults.fuzz.harness` did not hold.
    """
    parser = ArgumentParser(prog="python -m benchmarks coverage_guided", description=__doc__)
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(words)
    if find_spec("atheris") is None:
        raise SystemExit("Atheris is not installed: pip install 'doublestep[fuzz]'")
    print("\n### Hostile messages, guided by coverage\n")
    print("| against | messages | branches reached | resident memory | crashes, hangs |")
    print("|---|---|---|---|---|", flush=True)
    for target in ("codec", "service"):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, str(_SCRIPT), target, f"{folder}/corpus"]
            command += [f"-runs={options.runs}", f"-seed={options.seed}", "-print_final_stats=1"]
            command += [f"-timeout={_HANG_TIME}", f"-rss_limit_mb={_MEMORY_MB}", "-max_len=65536"]
            done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
            found = _STATUS.search(done.stderr)
            if done.returncode or found is None:
                raise SystemExit(f"{target}: exit code {done.returncode}\n{done.stderr[-5000:]}")
        print(f"| {target} | {found[1]} | {found[2]} | {found[3]} MB | 0 |", flush=True)
