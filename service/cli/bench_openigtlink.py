"""`lumiline bench openigtlink`: ten tools to pyigtl while another client stalls and leaves."""

import asyncio
import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Thread
from typing import Any, Final

import numpy as np

from compute.pose.rigid_body import PoseStatus, ToolPose
from service.cli.bench_service import Figures, run_benchmark
from service.cli.output import console, make_table, progress, spec
from service.pipeline.frame_batch import LatestPoses, PoseEntry
from service.protocols.openigtlink.counters import Counters
from service.protocols.openigtlink.host import Landmark, Outcome, ServerSettings, WireTool
from service.protocols.openigtlink.server import OpenIGTLinkServer

TITLE: Final = "ten tools at 200 Hz to pyigtl, while another client connects, stalls and leaves"
TOOLS: Final = tuple(f"tool-{number}" for number in range(10))
RATE_HZ: Final = 200.0
_DEVICE: Final = "sim"
_START_S: Final = 60.0
_REST_S: Final = 1.0


class _Tools:
    """An application that has the tools and nothing else."""

    async def tools(self) -> Sequence[WireTool]:
        return [WireTool(tool, _DEVICE) for tool in TOOLS]

    async def landmarks(self, device_id: str) -> Sequence[Landmark]:  # noqa: ARG002
        return []

    async def devices(self) -> Sequence[str]:
        return [_DEVICE]

    async def start_recording(self, device_id: str, name: str | None) -> str:
        raise NotImplementedError

    async def stop_recording(self, device_id: str) -> str:
        raise NotImplementedError

    async def audit(
        self, operation: str, address: str, outcome: Outcome, detail: str | None
    ) -> None:
        raise NotImplementedError


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Measure, and print what was received of what was put up, and when."""
    run_benchmark(lambda _folder: measure(seconds, quiet=as_json), _show, as_json=as_json)


def measure(seconds: float, *, quiet: bool) -> Figures:
    """Return the figures of our server, and of a bare one beside it for a sixth of the time."""
    with progress(TITLE, seconds, quiet=quiet) as report:
        ours = asyncio.run(_ours(seconds, report))
    baseline_s = max(1.0, seconds / 6.0)
    with progress("a bare server beside it", baseline_s, quiet=quiet):
        return ours | {"baseline": _baseline(baseline_s)}


async def _ours(seconds: float, report: Callable[[float], object]) -> Figures:
    board = LatestPoses()
    server = OpenIGTLinkServer(board, _Tools(), ServerSettings(port=0))
    await server.start()
    loop = asyncio.get_running_loop()
    try:
        with _client(server.address[1]) as process:
            await _until_connected(server, process)
            feeder = Thread(target=_feed, args=(board, seconds, report))
            feeder.start()
            await loop.run_in_executor(None, feeder.join)
            await asyncio.sleep(_REST_S)
            received = await loop.run_in_executor(None, _ended, process)
    finally:
        await server.close()
    frames = round(seconds * RATE_HZ)
    return {
        "seconds": seconds,
        "rate_hz": RATE_HZ,
        "frames_put_up": frames,
        "messages_sent_up": frames * len(TOOLS),
        "received": received,
        "server": _counted(server.counters),
    }


def _feed(board: LatestPoses, seconds: float, report: Callable[[float], object]) -> None:
    """Put frames up from a thread of its own, as the live pipeline does; exposed just now."""
    begin = time.monotonic()
    for number in range(round(seconds * RATE_HZ)):
        wait = begin + number / RATE_HZ - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        now = time.time_ns()
        position = np.array([float(number), 0.0, 1000.0])
        poses = {
            tool: ToolPose(
                tool, PoseStatus.OK, None, now, number, np.eye(3), position, residual_sigma=1.0,
                markers_used=4,
            )
            for tool in TOOLS
        }  # fmt: skip
        board.put(PoseEntry(_DEVICE, number, now, poses, None, RATE_HZ))
        if number % 20 == 0:
            report(time.monotonic() - begin)


def _baseline(seconds: float) -> Figures:
    from benchmarks.peer_process import running_peer

    with running_peer("benchmarks.baseline_openigtlink") as url:
        port = int(url.rstrip("/").rpartition(":")[2])
        with _client(port, "--alone") as process:
            time.sleep(seconds + _REST_S)
            return _ended(process)


@contextmanager
def _client(port: int, *options: str) -> Iterator["subprocess.Popen[str]"]:
    process = subprocess.Popen(  # noqa: S603 - our own module
        [sys.executable, "-m", "benchmarks.openigtlink_clients", str(port), *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


async def _until_connected(server: OpenIGTLinkServer, process: "subprocess.Popen[str]") -> None:
    end = time.monotonic() + _START_S
    while server.clients < 2:
        if process.poll() is not None or time.monotonic() > end:
            raise RuntimeError("the clients did not connect; see above")
        await asyncio.sleep(0.01)


def _ended(process: "subprocess.Popen[str]") -> Figures:
    output, _ = process.communicate()
    if process.returncode != 0:
        raise RuntimeError("the clients failed; see above")
    figures: Figures = json.loads(output)
    return figures


def _counted(counters: Counters) -> Figures:
    # Not asdict, which makes other counters of them.
    return {
        name: dict(value) if isinstance(value, Counter) else value
        for name, value in vars(counters).items()
    }


def _show(figures: Figures) -> None:
    received, bare, server = figures["received"], figures["baseline"], figures["server"]
    counts = received["messages"].values()
    ended = ", ".join(f"{count} {cause}" for cause, count in server["ended"].items())
    rows: list[tuple[object, ...]] = [
        ("duration, s", f"{figures['seconds']:g}"),
        ("frames put up", figures["frames_put_up"]),
        ("messages received of each tool, least", min(counts, default=0),
         min(bare["messages"].values(), default=0)),
        ("the same, of all tools", f"{sum(counts)} of {figures['messages_sent_up']}"),
        ("missed between two received", received["missed"], bare["missed"]),
        ("out of order", received["out_of_order"], bare["out_of_order"]),
        ("wrong checksums", received["wrong_checksums"], bare["wrong_checksums"]),
        ("largest gap, ms",
         spec(received["largest_gap_ms"], ".1f"), spec(bare["largest_gap_ms"], ".1f")),
    ]  # fmt: skip
    for name in ("latency", "jitter"):
        ours, peer = received[f"{name}_ms"], bare[f"{name}_ms"]
        rows += [(f"{name} {p}, ms", f"{ours[p]:.3f}", f"{peer[p]:.3f}") for p in ours]
    rows += [
        ("the other client: times it stalled", received["stalls"]),
        ("frames replaced by newer ones", server["frames_replaced"]),
        ("connections ended", ended),
    ]
    headings = ("figure", "Lumiline", "bare server, pyigtl alone")
    console.print(make_table(headings, rows, TITLE))
    console.print(
        "latency: from the exposure, which is when the frame was put up, to the message in "
        "pyigtl's hands; jitter: how much the time between two messages differs from that "
        "between their exposures."
    )
