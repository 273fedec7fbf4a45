"""NdiCollector: counters of the NDI server as metrics."""

from collections.abc import Iterator

from prometheus_client import Metric
from prometheus_client.registry import Collector

from service.protocols.metrics.families import counter, single
from service.protocols.ndi.server import NdiServer


class NdiCollector(Collector):
    """Clients, and what was answered.

    Args:
        server: whose counters are read.
    """

    def __init__(self, server: NdiServer) -> None:
        self._server = server

    def collect(self) -> Iterator[Metric]:
        """Yield what there is."""
        counts = self._server.totals()
        yield single("ndi_clients", "Connected NDI clients.", self._server.clients)
        for name, text, value in (
            ("connections", "Connections of NDI clients that were taken.", counts.connections),
            ("connections_refused", "Those that were turned away.", counts.rejected_connections),
            ("commands", "Commands of NDI clients that were carried out.", counts.commands),
            ("commands_refused", "Those that were refused, and what was none.", counts.refused),
        ):
            yield counter(f"ndi_{name}", text, [((), float(value))], ())
