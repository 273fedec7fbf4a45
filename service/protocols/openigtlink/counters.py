"""Counters of the OpenIGTLink server, for the metrics."""

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Counters:
    """Counts since the server's start; written in the event loop, read anywhere.

    Args:
        frames_sent: frames given to clients, of all clients together.
        frames_replaced: frames that a newer one replaced before a client could take them.
        frames_stale: frames that were too old to be sent.
        poses_withheld: poses that were not OK and not sent, of all clients together.
        received: messages by type; ``other``: those of types that are skipped.
        damaged: messages with a wrong checksum, or content that is none of their type.
        commands_refused: commands that were refused.
        refused: connections that were refused, by reason.
        ended: connections that ended, by reason.
    """

    frames_sent: int = 0
    frames_replaced: int = 0
    frames_stale: int = 0
    poses_withheld: int = 0
    received: Counter[str] = field(default_factory=Counter)
    damaged: int = 0
    commands_refused: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    ended: Counter[str] = field(default_factory=Counter)
