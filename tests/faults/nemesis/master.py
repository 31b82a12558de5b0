"""The ``master-node`` command, which tells of each attempt by a byte on a descriptor.

``python -m tests.faults.nemesis.master run SYSTEM --output DIRECTORY``, with the descriptor in the
environment.
"""

from __future__ import annotations

import os

from protocol.host.command_start import run_command

DESCRIPTOR = "NEMESIS_DESCRIPTOR"


def main() -> None:
    """Run the command, with a progress that tells of attempts."""
    from master_node.observing import progress  # noqa: PLC0415  it may be interrupted meanwhile

    descriptor = int(os.environ[DESCRIPTOR])

    class TellingBar(progress.ProgressBar):
        def attempted(self, attempt: progress.Attempt) -> None:
            super().attempted(attempt)
            os.write(descriptor, b".")

    progress.ProgressBar = TellingBar  # type: ignore[misc]
    from master_node.cli.app import main as run  # noqa: PLC0415

    run()


if __name__ == "__main__":
    run_command("master-node", "tests.faults.nemesis.master")
