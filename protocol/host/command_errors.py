"""Errors of a command: each becomes one line and an exit code."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable

from protocol.errors import DoublestepError
from protocol.host.logs import about, logs_json
from protocol.host.standard_output import guarded_standard_output
from protocol.host.terminal import say_error


def told_errors(name: str, command: Callable[[], None]) -> None:
    """Run a command; a `DoublestepError` of it is said, and ends the process with its exit code.

    Args:
        name: of the program; its messages are those of the package of that name.
        command: what the words of the command line ask for.
    """
    try:
        with guarded_standard_output():
            command()
    except DoublestepError as error:
        if logs_json():
            logging.getLogger(name.replace("-", "_")).error("%s", error, extra=about(error))
        else:
            say_error(name, error)
        sys.exit(error.exit_code)
