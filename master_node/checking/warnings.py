"""Warnings that are gathered while a system is checked."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

_LOGGER = logging.getLogger("master_node")


class _Gathering(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep it."""
        self.records.append(record)


@contextmanager
def gathered_warnings() -> Iterator[list[str]]:
    """Messages of the master's warnings, each once, known behind the ``with``.

    They are not logged, unless an error ends the ``with``: then nothing else would tell them.
    """
    gathering, messages = _Gathering(), list[str]()
    propagated = _LOGGER.propagate
    _LOGGER.addHandler(gathering)
    _LOGGER.propagate = False
    try:
        yield messages
    except BaseException:
        _LOGGER.propagate = propagated
        _LOGGER.removeHandler(gathering)
        for record in gathering.records:
            _LOGGER.handle(record)
        raise
    finally:
        _LOGGER.propagate = propagated
        _LOGGER.removeHandler(gathering)
        messages += dict.fromkeys(record.getMessage() for record in gathering.records)
