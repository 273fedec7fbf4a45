"""Metrics: the Prometheus registry of one application, and GET /metrics."""

import platform
from typing import Final

from fastapi import APIRouter, Request
from prometheus_client import (
    CollectorRegistry,
    Counter,
    GCCollector,
    Histogram,
    Info,
    ProcessCollector,
    disable_created_metrics,
)
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector
from starlette.responses import Response

from service.logs import RequestRecord
from service.version import package_version

_METHODS: Final = frozenset({"GET", "HEAD", "POST", "PATCH", "PUT", "DELETE", "OPTIONS"})
_OTHER: Final = "other"
_NO_ROUTE: Final = "none"
_CLIENT_GONE: Final = 499
_BUCKETS_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)

disable_created_metrics()  # type: ignore[no-untyped-call]  # a further series for each, of the moment when it was first counted


class Metrics:
    """Each application has its own: several may be in one process."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._requests = Counter(
            "lumiline_http_requests",
            "Requests answered, by the route's template and the class of the status; opened "
            "websockets are 1xx.",
            ("method", "route", "status"),
            registry=self._registry,
        )
        self._durations = Histogram(
            "lumiline_http_request_duration_seconds",
            "From a request's first line to the end of its answer; of a websocket, until it is "
            "open.",
            ("method", "route"),
            buckets=_BUCKETS_S,
            registry=self._registry,
        )
        ProcessCollector(registry=self._registry)
        GCCollector(registry=self._registry)
        build = Info("lumiline_build", "This server's version.", registry=self._registry)
        build.info({"version": package_version(), "python": platform.python_version()})

    def request_ended(self, record: RequestRecord) -> None:
        """Count a request; one that was refused before the router saw it has no route."""
        if record.kind == "websocket":
            method = "WEBSOCKET"
        else:
            method = record.method if record.method in _METHODS else _OTHER
        route = record.route or _NO_ROUTE
        status = f"{(record.status or _CLIENT_GONE) // 100}xx"
        self._requests.labels(method, route, status).inc()
        self._durations.labels(method, route).observe(record.duration_s)

    def add(self, *collectors: Collector) -> None:
        """Read these, too."""
        for collector in collectors:
            self._registry.register(collector)

    def text(self, accept: str) -> tuple[bytes, str]:
        """Return all in the format that the header ``Accept`` asks for, and its media type."""
        try:
            encoder, media_type = choose_encoder(accept)
        except (TypeError, ValueError):  # a version that is none
            encoder, media_type = choose_encoder("")
        return encoder(self._registry), media_type


router = APIRouter(tags=["server"])


@router.get(
    "/metrics",
    operation_id="get-metrics",
    summary="Figures for Prometheus",
    response_class=Response,
    responses={
        200: {
            "content": {
                "text/plain": {"schema": {"type": "string"}},
                "application/openmetrics-text": {"schema": {"type": "string"}},
            }
        }
    },
)
def get_metrics(request: Request) -> Response:
    """All figures in Prometheus's text format, or OpenMetrics where `Accept` asks for it.

    docs/how-to/operation.md says which to watch.
    """
    metrics: Metrics = request.app.state.metrics
    content, media_type = metrics.text(request.headers.get("accept", ""))
    return Response(content, media_type=media_type)
