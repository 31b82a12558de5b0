"""Logs for people or for programs: text, or one JSON object on each line.

What a message is about (run, slave, request, t) is given beside it, with ``extra``, and becomes
fields of the object.
"""

from __future__ import annotations

import json
import logging
import math
import sys
from collections.abc import Mapping
from datetime import datetime
from enum import StrEnum
from typing import Any

from protocol.errors import DoublestepError
from protocol.text.plain_text import printable


class LogFormat(StrEnum):
    """Format of a command's log."""

    TEXT = "text"
    JSON = "json"


FIELDS = ("run", "slave", "request", "phase", "t", "H")
"""Fields of a JSON line beside time, level, logger and message, where they are known: id of the
run, name of the slave, ``claim:sequence``, call, communication point [s], step size [s]."""


_PACKAGES = ("protocol", "slave_node", "master_node")


class JsonFormatter(logging.Formatter):
    """One JSON object on one line.

    Args:
        known: fields that all messages have.
    """

    def __init__(self, known: Mapping[str, object]) -> None:
        super().__init__()
        self._known = dict(known)

    def add(self, fields: Mapping[str, object]) -> None:
        """Fields that all later messages have."""
        self._known |= fields

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter`."""
        when = datetime.fromtimestamp(record.created).astimezone()
        line: dict[str, object] = {
            "time": when.isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": printable(record.getMessage()),
            **self._known,
        }
        for name in FIELDS:
            value = getattr(record, name, None)
            if value not in (None, ""):
                line[name] = _plain(value)
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, allow_nan=False)


class TextFormatter(logging.Formatter):
    """One line for a message: what is in it cannot begin another."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  named by logging
        """See `logging.Formatter`."""
        return printable(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802  as above
        """See `logging.Formatter`: indented, as it has several lines."""
        return "\n".join(f"  {printable(t)}" for t in super().formatException(ei).splitlines())


def formatter(style: LogFormat, text_format: str, **known: object) -> logging.Formatter:
    """Formatter of lines; arguments as of `configure_logs`."""
    return JsonFormatter(known) if style is LogFormat.JSON else TextFormatter(text_format)


def configure_logs(style: LogFormat, text_format: str, **known: object) -> None:
    """Write the log of this process to standard error, in place of what was configured before.

    Of libraries warnings and errors only.

    Args:
        style: text or JSON.
        text_format: of `logging`, for text.
        **known: fields that all JSON lines have.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(formatter(style, text_format, **known))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    for package in _PACKAGES:
        logging.getLogger(package).setLevel(logging.INFO)


def add_log_fields(**fields: object) -> None:
    """Fields that all JSON lines of this process have from here on."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler.formatter, JsonFormatter):
            handler.formatter.add(fields)


def logs_json() -> bool:
    """True if this process writes JSON lines."""
    return any(isinstance(h.formatter, JsonFormatter) for h in logging.getLogger().handlers)


def about(error: DoublestepError) -> dict[str, object]:
    """Where an error happened, as ``extra`` of a message."""
    return {"slave": error.slave, "phase": error.phase, "t": error.time, "H": error.step_size}


def _plain(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if isinstance(value, int | float | bool) else printable(str(value))
