"""Benchmark of the live pipeline at a client: frames, losses, latency."""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

PERCENTILES = (50.0, 90.0, 99.0, 99.9)


@dataclass(frozen=True)
class LiveFigures:
    """Frames, losses and latency at one client.

    Args:
        seconds: from the first frame's exposure to the last's.
        frames: frames received.
        frames_per_s: frames received per second of exposure.
        lost: exposures missing in the sequence numbers, wherever they were lost.
        missed: messages that the service says it left out for this client.
        without_position: points without a position.
        latency_ms: from the middle of the exposure to the message in the client's hands, by
            percentile, and the largest ("max"). Both clocks are this machine's.
    """

    seconds: float
    frames: int
    frames_per_s: float
    lost: int
    missed: int
    without_position: int
    latency_ms: dict[str, float]


def receive(url: str, seconds: float) -> Iterator[tuple[dict[str, Any], int]]:
    """Yield the frame messages of a stream and when each was received [ns], for some seconds.

    Args:
        url: the stream's, ``ws://HOST:PORT/api/v1/stream?device_id=...``; binary messages.
        seconds: measured from the first frame.

    Raises:
        RuntimeError: the device stopped, failed or is not running.
    """
    import msgpack
    from websockets.sync.client import connect

    with connect(url, compression=None, max_size=None, max_queue=None) as socket:
        end = None
        while end is None or time.monotonic() < end:
            payload = socket.recv(timeout=10.0)
            now = time.time_ns()
            message = msgpack.unpackb(payload)
            if end is None:
                end = time.monotonic() + seconds
            state = message.get("state", "running")
            if state != "running":
                raise RuntimeError(
                    f"device {message['device_id']} is {state}: {message['reason'] or 'start it'}"
                )
            yield message, now


def measure(
    url: str, seconds: float, progress: Callable[[float], None] | None = None
) -> LiveFigures:
    """Receive for some seconds and summarise; ``progress`` gets the elapsed seconds."""
    latencies: list[int] = []
    sequences: list[int] = []
    first = last = 0
    missed = missing = 0
    for message, now in receive(url, seconds):
        if message["type"] == "missed":
            missed += message["messages"]
        if message["type"] != "frame":
            continue
        first = first or message["exposure_ns"]
        last = message["exposure_ns"]
        latencies.append(now - last)
        sequences.append(message["sequence"])
        missing += sum(point["position_mm"] is None for point in message["points"])
        if progress is not None and len(sequences) % 100 == 0:
            progress((last - first) / 1e9)
    return summarise(sequences, latencies, first, last, missed, missing)


def summarise(
    sequences: list[int],
    latencies_ns: list[int],
    first_ns: int,
    last_ns: int,
    missed: int = 0,
    without_position: int = 0,
) -> LiveFigures:
    """Summarise sequence numbers, latencies, first and last exposure."""
    if len(sequences) < 2:
        raise RuntimeError(f"{len(sequences)} frames were received; two at least make a rate")
    milliseconds = np.array(latencies_ns) / 1e6
    latency = {
        f"p{percentile:g}": float(np.percentile(milliseconds, percentile))
        for percentile in PERCENTILES
    }
    latency["max"] = float(milliseconds.max())
    duration = (last_ns - first_ns) / 1e9
    return LiveFigures(
        duration,
        len(sequences),
        (len(sequences) - 1) / duration,
        sequences[-1] - sequences[0] + 1 - len(sequences),
        missed,
        without_position,
        latency,
    )


def main(arguments: list[str] | None = None) -> int:
    """Measure a running service: ``python -m benchmarks.live ws://... [--seconds 60]``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url", help="ws://HOST:PORT/api/v1/stream?device_id=sim")
    parser.add_argument("--seconds", type=float, default=60.0)
    chosen = parser.parse_args(arguments)
    figures = measure(chosen.url, chosen.seconds)
    json.dump(asdict(figures), sys.stdout, indent=2)
    print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
