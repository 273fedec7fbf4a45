"""Metrics: the registry of one application, and what is read into it."""

import platform

from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector
from prometheus_client.core import InfoMetricFamily
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from service.logs.request_record import RequestRecord
from service.protocols.metrics.requests import RequestMetrics
from service.version import package_version


class Metrics:
    """Each application has its own: several may be in one process."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._requests = RequestMetrics(self._registry)
        ProcessCollector(registry=self._registry)
        GCCollector(registry=self._registry)
        self._registry.register(_Build())

    def request_ended(self, record: RequestRecord) -> None:
        """Count a request."""
        self._requests.ended(record)

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


class _Build(Collector):
    def collect(self) -> list[InfoMetricFamily]:
        text = "This server's version."
        labels = {"version": package_version(), "python": platform.python_version()}
        return [InfoMetricFamily("lumiline_build", text, value=labels)]
