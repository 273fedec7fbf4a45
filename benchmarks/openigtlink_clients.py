"""Benchmark of an OpenIGTLink server: a pyigtl client while another client stalls.

Run in a process of its own: ``python -m benchmarks.openigtlink_clients PORT``. It ends when its
standard input does, and prints its figures as JSON.
"""

import json
import socket
import sys
import time
from collections import defaultdict
from dataclasses import dataclass, field
from threading import Event, Thread
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

STALLED_S: Final = 12.0
"""How long the other client reads nothing; longer than the server has patience with it."""
BETWEEN_S: Final = 1.0
PERCENTILES: Final = (50.0, 99.0, 99.9)


@dataclass
class Received:
    """Received messages of each tool.

    Args:
        numbers: of the frames, which the first coordinate of every pose is.
        sent_s: the exposures' times in the messages [s].
        received_s: when each message was in the client's hands [s].
        wrong_checksums: bodies that are not what their checksum is of; pyigtl does not look.
    """

    numbers: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    sent_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    received_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    wrong_checksums: int = 0


class _Kept(dict[str, Any]):
    """Replaces pyigtl's message store, which keeps the last of each name, and keeps all."""

    def __init__(self, into: Received) -> None:
        super().__init__()
        self._into = into

    def __setitem__(self, name: str, message: Any) -> None:
        self._into.received_s[name].append(time.time())
        self._into.numbers[name].append(round(float(message.matrix[0, 3])))
        self._into.sent_s[name].append(message.timestamp)


def _check_checksums(into: Received) -> None:
    from pyigtl import messages

    base = messages.MessageBase
    parse, unpack = base.parse_header, base.unpack

    def parse_header(header: bytes) -> dict[str, Any]:
        fields: dict[str, Any] = parse(header)
        return fields | {"checksum": int.from_bytes(header[50:58], "big")}

    def unpack_body(self: Any, fields: dict[str, Any], body: bytes) -> None:
        into.wrong_checksums += messages.CRC64(body) != fields["checksum"]
        unpack(self, fields, body)

    base.parse_header = staticmethod(parse_header)
    base.unpack = unpack_body


def _stall(port: int, ended: Event, times: list[float]) -> None:
    """Connect, read nothing, disconnect; repeatedly."""
    while not ended.is_set():
        with socket.create_connection(("127.0.0.1", port)):
            begin = time.monotonic()
            ended.wait(STALLED_S)
            times.append(time.monotonic() - begin)
        ended.wait(BETWEEN_S)


def figures(received: Received) -> dict[str, Any]:
    """Return counts, order, the largest gap, latencies and jitter [ms], of all tools together."""
    numbers = [np.array(one) for one in received.numbers.values()]
    sent = [np.array(one) for one in received.sent_s.values()]
    came = [np.array(one) for one in received.received_s.values()]
    steps = np.concatenate([np.diff(one) for one in numbers]) if numbers else np.empty(0)
    late_ms = _all([1e3 * (b - a) for a, b in zip(sent, came, strict=True)])
    jitter_ms = _all(
        [1e3 * np.abs(np.diff(b) - np.diff(a)) for a, b in zip(sent, came, strict=True)]
    )
    gaps_ms = _all([1e3 * np.diff(one) for one in came])
    return {
        "messages": {name: len(one) for name, one in sorted(received.numbers.items())},
        "first": min((int(one[0]) for one in numbers), default=None),
        "out_of_order": int((steps <= 0).sum()),
        "missed": int((steps[steps > 1] - 1).sum()),
        "largest_gap_ms": float(gaps_ms.max()) if gaps_ms.size else None,
        "wrong_checksums": received.wrong_checksums,
        "latency_ms": _percentiles(late_ms),
        "jitter_ms": _percentiles(jitter_ms),
    }


def _all(parts: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate(parts) if parts else np.empty(0)


def _percentiles(values: NDArray[np.float64]) -> dict[str, float]:
    if not values.size:
        return {}
    found = {f"p{one:g}": float(np.percentile(values, one)) for one in PERCENTILES}
    return found | {"max": float(values.max())}


def main() -> int:
    """Receive until standard input ends; ``--alone`` omits the stalling client."""
    import pyigtl

    port, alone = int(sys.argv[1]), "--alone" in sys.argv
    received, ended, stalls = Received(), Event(), list[float]()
    _check_checksums(received)
    client = pyigtl.OpenIGTLinkClient(port=port, start_now=False)
    client.incoming_messages = _Kept(received)
    client.start()
    other = Thread(target=_stall, args=(port, ended, stalls))
    if not alone:
        other.start()
    sys.stdin.read()
    ended.set()  # not client.stop(): that waits until nothing has come for 10 ms
    if not alone:
        other.join()
    json.dump(figures(received) | {"stalls": len(stalls)}, sys.stdout)
    print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
