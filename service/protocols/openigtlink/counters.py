"""Counters of the OpenIGTLink server, and their metrics."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from prometheus_client import Metric
from prometheus_client.registry import Collector

from service.protocols.metrics.collectors import Members, counter, members_of, single


@dataclass
class Counters:
    """Counts since the server's start; written in the event loop, read anywhere; see _COUNTS."""

    frames_sent: int = 0
    frames_replaced: int = 0
    frames_stale: int = 0
    poses_withheld: int = 0
    received: Counter[str] = field(default_factory=Counter)
    damaged: int = 0
    commands_refused: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    ended: Counter[str] = field(default_factory=Counter)


_COUNTS: Final[Members] = (
    ("frames_sent", "Frames given to clients, all clients together.", "frames_sent"),
    (
        "frames_replaced",
        "Frames that a newer one replaced before a client could take them.",
        "frames_replaced",
    ),
    ("frames_stale", "Frames that were too old to be sent.", "frames_stale"),
    ("poses_withheld", "Poses that are not OK in frames given to clients.", "poses_withheld"),
    (
        "messages_damaged",
        "Messages with a wrong checksum, or content that is none of their type.",
        "damaged",
    ),
    ("commands_refused", "Commands that were refused.", "commands_refused"),
)


class OpenIGTLinkCollector(Collector):
    """Metrics of OpenIGTLink: clients, messages sent, and refusals."""

    def __init__(self, counters: Counters, clients: Callable[[], int]) -> None:
        self._counters = counters
        self._clients = clients

    def collect(self) -> Iterator[Metric]:
        """Yield what there is."""
        counts = self._counters
        yield single("openigtlink_clients", "Connected OpenIGTLink clients.", self._clients())
        yield from members_of(_COUNTS, {(): counts}, (), "openigtlink_")
        for name, text, values, label in (
            ("messages_received", "Messages from clients, by type.", counts.received, "type"),
            ("connections_refused", "Connections that were refused.", counts.refused, "reason"),
            ("connections_ended", "Connections that ended, by reason.", counts.ended, "reason"),
        ):
            rows = (((word,), count) for word, count in sorted(values.items()))
            yield counter(f"openigtlink_{name}", text, rows, (label,))
