"""Benchmark of one stream with many clients, some stalled: losses and latencies.

Run in a process of its own: ``python -m benchmarks.stream_clients URL --seconds 60``.
"""

import argparse
import asyncio
import json
import sys
import time
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

PERCENTILES: Final = (50.0, 90.0, 99.0, 99.9)
DISPLAY_HZ: Final = 50.0
BUNDLE_MS: Final = 20.0
STALL_S: Final = 60.0
"""How long a stalled client keeps its connection before it drops it and stalls on another."""


@dataclass
class Received:
    """Messages received by all clients of one kind.

    Args:
        clients: how many.
        messages: websocket messages.
        frames: frames in them.
        lost: exposures missing in the sequence numbers of a client that gets every frame.
        missed: messages that the service says it left out.
        without_position: points without a position.
        bytes: of all payloads.
        latencies_ns: from mid exposure to the payload in the client's hands, of the newest frame
            of each message.
    """

    clients: int = 0
    messages: int = 0
    frames: int = 0
    lost: int = 0
    missed: int = 0
    without_position: int = 0
    bytes: int = 0
    latencies_ns: list[int] = field(default_factory=list)


def percentiles(latencies_ns: list[int]) -> dict[str, float]:
    """Return the percentiles and the largest [ms]; empty without any."""
    if not latencies_ns:
        return {}
    values = np.array(latencies_ns) / 1e6
    found = {f"p{one:g}": float(np.percentile(values, one)) for one in PERCENTILES}
    return found | {"max": float(values.max())}


async def _frames(url: str, end: float, into: Received, *, every: bool) -> None:
    """Receive until ``end`` (monotonic); ``every``: a gap in the sequence numbers is a loss."""
    import msgpack
    from websockets.asyncio.client import connect

    into.clients += 1
    last: int | None = None
    async with connect(url, compression=None, max_size=None, max_queue=64) as socket:
        while time.monotonic() < end:
            payload = await socket.recv()
            now = time.time_ns()
            message: dict[str, Any] = msgpack.unpackb(payload)
            into.messages += 1
            into.bytes += len(payload)
            if message["type"] == "missed":
                into.missed += message["messages"]
            frames = message.get("frames") or ([message] if message["type"] == "frame" else [])
            if not frames:
                continue
            into.frames += len(frames)
            into.latencies_ns.append(now - frames[-1]["exposure_ns"])
            for frame in frames:
                into.without_position += sum(p["position_mm"] is None for p in frame["points"])
                if every and last is not None:
                    into.lost += frame["sequence"] - last - 1
                last = frame["sequence"]


async def _stalled(url: str, end: float, into: Received) -> None:
    """Connect and read nothing; reconnect after a while."""
    from websockets.asyncio.client import connect

    into.clients += 1
    while time.monotonic() < end:
        socket = await connect(
            url, compression=None, max_size=None, max_queue=1, ping_interval=None, close_timeout=0.1
        )
        await asyncio.sleep(min(STALL_S, max(0.0, end - time.monotonic())))
        socket.transport.abort()


async def _echoed(url: str, size: int, end: float, latencies_ns: list[int]) -> None:
    """Measure round-trip times of payloads of this size at an echo server."""
    from websockets.asyncio.client import connect

    async with connect(url, compression=None, max_size=None) as socket:
        while time.monotonic() < end:
            begin = time.monotonic_ns()
            await socket.send(bytes(size))
            await socket.recv()
            latencies_ns.append(time.monotonic_ns() - begin)
            await asyncio.sleep(1.0 / DISPLAY_HZ)


async def receive(
    stream: str, echo: str, seconds: float, displays: int, lossless: int, stalled: int
) -> dict[str, Any]:
    """Run all clients and return the statistics of each kind.

    Args:
        stream: the stream's URL with its device.
        echo: URL of a bare echo.
        seconds: for how long.
        displays: clients that take the newest frame DISPLAY_HZ times a second.
        lossless: clients that take every frame, in bundles.
        stalled: clients that read nothing, of every frame one by one.
    """
    end = time.monotonic() + seconds
    groups = {"display": Received(), "lossless": Received(), "stalled": Received()}
    echoed: list[int] = []
    size = 400  # a frame message with one point
    async with asyncio.TaskGroup() as tasks:
        for _ in range(displays):
            url = f"{stream}&rate_hz={DISPLAY_HZ:g}"
            tasks.create_task(_frames(url, end, groups["display"], every=False))
        for _ in range(lossless):
            url = f"{stream}&mode=lossless&bundle_ms={BUNDLE_MS:g}"
            tasks.create_task(_frames(url, end, groups["lossless"], every=True))
        for _ in range(stalled):
            tasks.create_task(_stalled(stream, end, groups["stalled"]))
        tasks.create_task(_echoed(echo, size, end, echoed))
    answer: dict[str, Any] = {}
    for name, group in groups.items():
        members = asdict(group)
        latencies = members.pop("latencies_ns")
        answer[name] = members | {"latency_ms": percentiles(latencies)}
    return answer | {"echo": {"messages": len(echoed), "latency_ms": percentiles(echoed)}}


def main(arguments: list[str] | None = None) -> int:
    """Print the statistics as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stream")
    parser.add_argument("echo")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--displays", type=int, default=40)
    parser.add_argument("--lossless", type=int, default=5)
    parser.add_argument("--stalled", type=int, default=5)
    chosen = parser.parse_args(arguments)
    figures = asyncio.run(
        receive(
            chosen.stream,
            chosen.echo,
            chosen.seconds,
            chosen.displays,
            chosen.lossless,
            chosen.stalled,
        )
    )
    json.dump(figures, sys.stdout)
    print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
