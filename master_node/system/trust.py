"""Trust in what a directory or package of others says is to be run.

A checkpoint names models and functions, which resuming runs as the user. So it must be the user's
own, or the user must say that it is trusted.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from pathlib import Path

from protocol.errors import ConfigurationError
from protocol.host.processes import user_id


def check_own(paths: Iterable[Path]) -> None:
    """Refuse files and folders that somebody else could have written. Those not there are passed.

    Raises:
        ConfigurationError: one is of another user, or everybody can write it.
    """
    if os.name != "posix":
        return
    for path in paths:
        try:
            status = path.lstat()
        except FileNotFoundError:
            continue
        cause = ""
        if status.st_uid != user_id():
            cause = f"is of another user (uid {status.st_uid})"
        elif status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            cause = "can be written by everybody"
        if cause:
            raise ConfigurationError(
                f"{path} {cause}, and resuming runs the models and functions that it names",
                phase="resume",
                remedy="look into checkpoint/system.json there, and say --trust if you would run "
                "all that",
            )
