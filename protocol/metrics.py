"""Numbers of a running process for Prometheus. The only file that knows `prometheus_client`.

Nothing is counted for it: a scrape reads what is counted anyway, or what `Metric` values say.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from protocol.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class Metric:
    """A number, or one for each slave.

    Attributes:
        name: without prefix and without ``_total``.
        description: in words, with the unit.
        kind: ``counter`` only grows, ``gauge`` is as it is now.
        values: by slave name; a single one under "".
    """

    name: str
    description: str
    kind: Literal["counter", "gauge"]
    values: Mapping[str, float]


Read = Callable[[], Iterable[Metric]]
"""Called at each scrape, on a thread of the server."""


class _Collector(Collector):
    def __init__(self, read: Read) -> None:
        self._read = read

    def collect(self) -> Iterator[CounterMetricFamily | GaugeMetricFamily]:
        for metric in self._read():
            family = CounterMetricFamily if metric.kind == "counter" else GaugeMetricFamily
            labels = [] if set(metric.values) == {""} else ["slave"]
            made = family(f"doublestep_{metric.name}", metric.description, labels=labels)
            for slave, value in metric.values.items():
                made.add_metric([slave] if labels else [], value)
            yield made


@contextmanager
def metrics_served(port: int, host: str, read: Read) -> Iterator[str]:
    """Serve metrics over HTTP while the context lasts.

    Args:
        port: to listen on; 0: any that is free.
        host: address to listen on; there is no encryption and nobody is asked who he is.
        read: gives the metrics.

    Yields:
        The URL.

    Raises:
        ConfigurationError: the address cannot be listened on.
    """
    registry = CollectorRegistry()
    registry.register(_Collector(read))
    try:
        server, thread = start_http_server(port, addr=host, registry=registry)
    except (OSError, OverflowError) as error:
        raise ConfigurationError(
            f"cannot serve metrics at {host}:{port}: {error}",
            remedy="another process may use the port: choose another with --metrics-port",
        ) from error
    try:
        yield f"http://{host}:{server.server_port}/metrics"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
