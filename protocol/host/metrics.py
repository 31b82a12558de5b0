"""Numbers of a running process for Prometheus. The only file that knows `prometheus_client`.

Nothing is counted for it: a scrape reads what is counted anyway, or what `Metric` values say.
There is no authentication, so a stranger's share is bounded: connections, and their time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from socket import SOCK_STREAM, getaddrinfo
from socketserver import ThreadingMixIn
from typing import Any, Literal
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from protocol.errors import ConfigurationError, HostLimitError
from protocol.host.threads import start_thread

_AT_ONCE = 16


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


class _Handler(WSGIRequestHandler):
    """Waits a bounded time for what is asked, and says nothing of it in the log."""

    timeout = 5.0

    def log_message(self, *_: object) -> None:
        """Nothing."""


class _Server(ThreadingMixIn, WSGIServer):
    """Answers some at a time, each on a thread; who comes beyond that is turned away."""

    daemon_threads = True

    def __init__(self, host: str, port: int) -> None:
        family, *_, address = getaddrinfo(host, port, type=SOCK_STREAM)[0]
        self.address_family = family
        self._free = threading.BoundedSemaphore(_AT_ONCE)
        super().__init__((str(address[0]), port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """See `socketserver.BaseServer`."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """See `socketserver.ThreadingMixIn`."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, *_: object) -> None:
        """Clients may leave, or send what is no request: nothing is logged."""


@contextmanager
def metrics_served(port: int, host: str, read: Read) -> Iterator[str]:
    """Serve metrics over HTTP while the context lasts.

    Args:
        port: to listen on; 0: any that is free.
        host: address to listen on; there is no encryption and no authentication.
        read: gives the metrics.

    Yields:
        The URL.

    Raises:
        ConfigurationError: the address cannot be listened on.
    """
    registry = CollectorRegistry()
    registry.register(_Collector(read))
    try:
        server = _Server(host, port)
    except (OSError, OverflowError) as error:
        raise ConfigurationError(
            f"cannot serve metrics at {host}:{port}: {error}",
            remedy="another process may use the port: choose another with --metrics-port",
        ) from error
    server.set_app(make_wsgi_app(registry))
    try:
        thread = start_thread(server.serve_forever, "metrics")
    except HostLimitError:
        server.server_close()
        raise
    try:
        yield f"http://{host}:{server.server_port}/metrics"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
