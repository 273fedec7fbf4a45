"""Counts requests as they end; the routes' templates keep the number of series bounded."""

from typing import Final

from prometheus_client import CollectorRegistry, Counter, Histogram, disable_created_metrics

from service.logs.request_record import RequestRecord

_METHODS: Final = frozenset({"GET", "HEAD", "POST", "PATCH", "PUT", "DELETE", "OPTIONS"})
_OTHER: Final = "other"
_NO_ROUTE: Final = "none"
_CLIENT_GONE: Final = 499
_BUCKETS_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)

disable_created_metrics()  # type: ignore[no-untyped-call]  # a further series for each, of the moment when it was first counted


class RequestMetrics:
    """Requests and their durations."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._requests = Counter(
            "lumiline_http_requests",
            "Requests answered, by the route's template and the class of the status; opened "
            "websockets are 1xx.",
            ("method", "route", "status"),
            registry=registry,
        )
        self._durations = Histogram(
            "lumiline_http_request_duration_seconds",
            "From a request's first line to the end of its answer; of a websocket, until it is "
            "open.",
            ("method", "route"),
            buckets=_BUCKETS_S,
            registry=registry,
        )

    def ended(self, record: RequestRecord) -> None:
        """Count a request; one that was refused before the router saw it has no route."""
        if record.kind == "websocket":
            method = "WEBSOCKET"
        else:
            method = record.method if record.method in _METHODS else _OTHER
        route = record.route or _NO_ROUTE
        status = f"{(record.status or _CLIENT_GONE) // 100}xx"
        self._requests.labels(method, route, status).inc()
        self._durations.labels(method, route).observe(record.duration_s)
