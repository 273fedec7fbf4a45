"""OpenIGTLinkCollector: counters of the OpenIGTLink server as metrics."""

from collections.abc import Iterator

from prometheus_client import Metric
from prometheus_client.registry import Collector

from service.protocols.metrics.families import counter, single
from service.protocols.openigtlink.server import OpenIGTLinkServer


class OpenIGTLinkCollector(Collector):
    """Clients, what they were sent, and what was refused.

    Args:
        server: whose counters are read.
    """

    def __init__(self, server: OpenIGTLinkServer) -> None:
        self._server = server

    def collect(self) -> Iterator[Metric]:
        """Yield what there is."""
        counts = self._server.counters
        yield single("openigtlink_clients", "Connected OpenIGTLink clients.", self._server.clients)
        for name, text, value in (
            (
                "frames_sent",
                "Frames given to clients, all clients together.",
                counts.frames_sent,
            ),
            (
                "frames_replaced",
                "Frames that a newer one replaced before a client could take them.",
                counts.frames_replaced,
            ),
            ("frames_stale", "Frames that were too old to be sent.", counts.frames_stale),
            (
                "poses_withheld",
                "Poses that are not OK in frames given to clients.",
                counts.poses_withheld,
            ),
            (
                "messages_damaged",
                "Messages with a wrong checksum, or content that is none of their type.",
                counts.damaged,
            ),
            ("commands_refused", "Commands that were refused.", counts.commands_refused),
        ):
            yield counter(f"openigtlink_{name}", text, [((), float(value))], ())
        for name, text, values, label in (
            ("messages_received", "Messages from clients, by type.", counts.received, "type"),
            ("connections_refused", "Connections that were refused.", counts.refused, "reason"),
            ("connections_ended", "Connections that ended, by reason.", counts.ended, "reason"),
        ):
            found = [((word,), float(count)) for word, count in sorted(values.items())]
            yield counter(f"openigtlink_{name}", text, found, (label,))
