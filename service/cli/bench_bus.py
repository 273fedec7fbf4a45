"""`lumiline bench bus`: NATS from a station at 5 kHz to 200 subscribers, beside a bare relay."""

import asyncio
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from service.cli.bench_service import Figures, run_benchmark
from service.cli.output import console, fail, make_table, progress
from service.cli.service_process import free_port

if TYPE_CHECKING:
    from service.pipeline.frame_batch import FrameBatch

TITLE: Final = "a station at 5 kHz to 200 subscribers over NATS, and 20 more that never read"
RATE_HZ: Final = 5000.0
SUBSCRIBERS: Final = 200
STALLED: Final = 20
DELAY_S: Final = 0.01
STATION: Final = "bench"
DEVICE: Final = "sim"
FRAMES: Final = 100
"""Different ones, which repeat."""
MAX_PROCESSES: Final = 8
"""In which the subscribers are; half of the cores at most."""
_READY_S: Final = 60.0


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Measure the bare relay and NATS in turn, and NATS with stalled subscribers; print both."""
    run_benchmark(lambda folder: _measure(folder, seconds, quiet=as_json), _show, as_json=as_json)


def _measure(folder: Path, seconds: float, *, quiet: bool) -> Figures:
    from benchmarks.baseline_fan_out import running_baseline_fan_out

    program = shutil.which("nats-server")
    if program is None:
        raise fail("there is no nats-server; install the package of that name")
    frames = _frame_messages()
    rounds: list[Figures] = []
    with progress(TITLE, quiet=quiet):
        for peer, stalled in (("bare", 0), ("nats", 0), ("nats", STALLED)):
            context = (
                running_baseline_fan_out() if peer == "bare" else _running_nats(program, folder)
            )
            with context as url:
                found = _round(url, frames, stalled, seconds / 3.0)
            rounds.append({"peer": peer, **found})
    return {"rate_hz": RATE_HZ, "frame_bytes": len(frames[0]), "rounds": rounds}


@contextmanager
def _running_nats(program: str, folder: Path) -> Iterator[str]:
    port = free_port()
    with (folder / "nats.log").open("ab") as log:
        process = subprocess.Popen(  # noqa: S603 - the broker that was found
            [program, "--addr", "127.0.0.1", "--port", str(port)], stdout=log, stderr=log
        )
    try:
        end = time.monotonic() + _READY_S
        while True:
            try:
                with socket.create_connection(("127.0.0.1", port), 1.0):
                    break
            except OSError:
                if process.poll() is not None or time.monotonic() > end:
                    raise RuntimeError("nats-server did not start") from None
                time.sleep(0.05)
        yield f"nats://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


def _round(url: str, frames: list[bytes], stalled: int, seconds: float) -> Figures:
    """Publish for some seconds, and return what subscribers had."""
    import numpy as np

    from service.station.network.subjects import BATCH, subject

    parts = urlsplit(url)
    address = (str(parts.hostname), str(parts.port), subject(STATION, BATCH, DEVICE))
    count = max(1, min(MAX_PROCESSES, (os.cpu_count() or 1) // 2))
    shares = [SUBSCRIBERS // count + (index < SUBSCRIBERS % count) for index in range(count)]
    clients = [
        subprocess.Popen(  # noqa: S603 - our own module
            [
                *(sys.executable, "-m", "benchmarks.bus_clients", *address, str(share)),
                *(str(0 if index else stalled), str(seconds)),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        for index, share in enumerate(shares)
    ]
    for one in clients:
        if one.stdout is None or one.stdout.readline().strip() != "ready":
            raise RuntimeError("the subscribers failed; see above")
    published, dropped = asyncio.run(
        _publish(f"nats://{parts.hostname}:{parts.port}", frames, seconds)
    )
    found: list[Figures] = [json.loads(one.communicate()[0]) for one in clients]
    latencies_ms = 1e3 * np.concatenate([one["latencies_s"] for one in found])
    read = sum(one["messages"] for one in found)
    return {
        "subscribers": SUBSCRIBERS,
        "stalled": stalled,
        "published": published,
        "read": read,
        "missing": published * SUBSCRIBERS - read,
        "cut": sum(one["cut"] for one in found),
        "dropped_by_station": dropped,
        "latency_ms": {
            name: float(np.percentile(latencies_ms, share)) if len(latencies_ms) else None
            for name, share in (("p50", 50.0), ("p99", 99.0), ("p99.9", 99.9), ("max", 100.0))
        },
    }


async def _publish(url: str, frames: list[bytes], seconds: float) -> tuple[int, int]:
    """Be the station; return how many messages there were, and how many of them it dropped."""
    from service.station.network.connection import BusConnection, BusOptions
    from service.station.network.outbox import Outbox

    connection = BusConnection(BusOptions((url,)), "bench", "lumiline.v1.inbox.bench")
    connection.open()
    begin = time.monotonic()
    while not connection.connected:
        await asyncio.sleep(0.01)
        if time.monotonic() - begin > _READY_S:
            raise RuntimeError(connection.reason)
    outbox = Outbox(STATION, "bench", connection, DELAY_S)
    begin, sent = time.monotonic(), 0
    while (passed := time.monotonic() - begin) < seconds:
        while sent < passed * RATE_HZ:
            outbox.collect(("batch", DEVICE), frames[sent % len(frames)], 1)
            sent += 1
        await asyncio.sleep(0.001)
    outbox.flush_all()
    while outbox.waiting and time.monotonic() - begin < seconds + _READY_S / 2.0:
        await asyncio.sleep(0.01)
    await outbox.close()
    await connection.close()
    return outbox.positions[f"batch.{DEVICE}"] + 1, outbox.dropped


def _frame_messages() -> list[bytes]:
    """Return frames of the simulated bar as they go over the bus: four sensors, four markers."""
    from hardware.simulated.driver import SimulatedDriver
    from hardware.simulated.settings import SimulationSettings
    from service.application.initial_content import nominal_calibration
    from service.pipeline.active_calibration import ActiveCalibration
    from service.pipeline.pipeline_manager import PipelineManager
    from service.protocols.stream.hub import Hub
    from service.station.bus_messages import batch_message

    found: list[FrameBatch] = []

    class Keeping(Hub):
        """Keeps batches, and has no clients."""

        def publish_batch(self, batch: "FrameBatch") -> None:
            found.append(batch)

    manager = PipelineManager(Keeping(), "cpu")
    try:
        driver = SimulatedDriver(DEVICE, SimulationSettings(frame_rate_hz=100.0))
        active = ActiveCalibration("nominal", nominal_calibration())
        manager.start_device(DEVICE, driver, active)
        end = time.monotonic() + _READY_S
        while sum(_is_plain(batch) for batch in tuple(found)) < FRAMES:
            if time.monotonic() > end:
                raise RuntimeError("the simulated bar made no frame")
            time.sleep(0.01)
    finally:
        manager.close()
    return [batch_message(batch, pixels=False) for batch in found if _is_plain(batch)][:FRAMES]


def _is_plain(batch: "FrameBatch") -> bool:
    return len(batch.frames) == 1 and len(batch.points.position_mm) > 0


def _show(figures: Figures) -> None:
    rows = []
    for one in figures["rounds"]:
        latency = one["latency_ms"]
        rows.append(
            [
                one["peer"], one["subscribers"], one["stalled"], one["read"], one["missing"],
                one["cut"], one["dropped_by_station"],
                *(None if value is None else f"{value:.2f}" for value in latency.values()),
            ]
        )  # fmt: skip
    titles = (
        "peer", "readers", "stalled", "read", "missing", "cut", "dropped", "p50 ms", "p99 ms",
        "p99.9 ms", "max ms",
    )  # fmt: skip
    title = f"{TITLE}; {figures['frame_bytes']} bytes a frame"
    console.print(make_table(titles, rows, title))
