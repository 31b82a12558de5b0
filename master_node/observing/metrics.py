"""Metrics of a run, for Prometheus."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from master_node.observing.observers import Attempt, RunEnd, RunStart, SlaveStatistics
from protocol.host.metrics import Metric


class RunMetrics:
    """An observer that keeps the last numbers of a run for whoever asks."""

    def __init__(self) -> None:
        self._statistics: Mapping[str, SlaveStatistics] = {}
        self._attempts = 0
        self._rejected = 0
        self._start_time = self._time = 0.0
        self._step_size = self._error_norm = float("nan")

    def started(self, start: RunStart) -> None:
        """See `Observer`."""
        self._statistics = start.statistics
        self._start_time = self._time = start.start_time

    def attempted(self, attempt: Attempt) -> None:
        """See `Observer`."""
        self._attempts += 1
        self._step_size, self._error_norm = attempt.step_size, attempt.error_norm
        if not attempt.accepted:
            self._rejected += 1
        if attempt.points:
            self._time = attempt.points[-1].time

    def ended(self, end: RunEnd) -> None:
        """See `Observer`."""
        self._time = end.statistics.time

    def read(self) -> Iterator[Metric]:
        """The metrics as they are now."""
        for name, description, kind, value in (
            ("attempts", "Attempted double steps, or steps", "counter", self._attempts),
            ("rejected_attempts", "Of these, rejected ones", "counter", self._rejected),
            ("simulated_time_seconds", "Simulated so far", "gauge", self._time - self._start_time),
            ("step_size_seconds", "H of the last attempt", "gauge", self._step_size),
            ("error_norm", "ERR of the last attempt", "gauge", self._error_norm),
        ):
            yield Metric(name, description, kind, {"": float(value)})  # type: ignore[arg-type]
        slaves = dict(self._statistics)
        for name, description in (
            ("do_steps", "Steps of a slave"),
            ("rollbacks", "How often a slave went back to a saved state"),
            ("requests", "Requests that a slave answered"),
            ("compute_time", "Time that a slave computed [s]"),
            ("transport_time", "Time of requests to a slave beyond that [s]"),
        ):
            name_in_seconds = name.replace("_time", "_seconds")
            values = {slave: float(getattr(s, name)) for slave, s in slaves.items()}
            yield Metric(name_in_seconds, description, "counter", values)
