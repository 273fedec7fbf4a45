"""`lumiline bench load`: a device at full rate, a recorder, many clients, some of them stalled."""

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final

import httpx
from rich.table import Table

from service.cli.bench_service import (
    DEVICE,
    answer,
    device_status,
    read_device,
    run_benchmark,
    wait_for_frames,
)
from service.cli.output import console, progress
from service.cli.service_process import service_process, simulated_device

TITLE: Final = (
    "4 sensors x 2048 pixels over the serial protocol, a recorder, 50 clients of which five stalled"
)
SAMPLE_S: Final = 1.0
PAGE_BYTES: Final = 4096


@dataclass
class Memory:
    """Resident memory of the service and its own processes over time [bytes]."""

    samples: list[int] = field(default_factory=list)

    def figures_mib(self) -> dict[str, float]:
        """After a tenth of the time, at the end and at most; and how much it grew an hour.

        The slope is that of a straight line through the second half.
        """
        values = [sample / 2**20 for sample in self.samples]
        late = values[len(values) // 2 :]
        middle = (len(late) - 1) / 2
        spread = sum((index - middle) ** 2 for index in range(len(late)))
        slope = sum((index - middle) * value for index, value in enumerate(late)) / spread
        return {
            "early": values[len(values) // 10],
            "end": values[-1],
            "most": max(values),
            "per_hour": slope * 3600.0 / SAMPLE_S,
        }


def run(rate_hz: float, seconds: float, *, as_json: bool) -> None:
    """Measure, and print what was lost where, latencies and memory."""
    run_benchmark(
        lambda folder: _measure(folder, rate_hz, seconds, quiet=as_json), _show, as_json=as_json
    )


def _measure(folder: Path, rate_hz: float, seconds: float, *, quiet: bool) -> dict[str, Any]:
    from benchmarks.baseline_echo import running_baseline_echo

    with contextlib.ExitStack() as stack:
        with progress("starting the service", quiet=quiet):
            source = stack.enter_context(simulated_device(folder, rate_hz, cycle=500))
            service = stack.enter_context(service_process(folder / "service"))
        with httpx.Client(base_url=service.url, timeout=60.0) as client:
            read_device(client, source)
            answer(client.post(f"/api/v1/devices/{DEVICE}/start"))
            wait_for_frames(client, 1)
            recording = answer(client.post(f"/api/v1/devices/{DEVICE}/recordings", json={}))
            echo = stack.enter_context(running_baseline_echo())
            memory = stack.enter_context(_watched(service.pid))
            before = device_status(client)
            received = _received(service.url, echo, seconds, quiet=quiet)
            after = device_status(client)
            recorded = answer(client.post(f"/api/v1/recordings/{recording['name']}/stop"))
    return {
        "rate_hz": rate_hz,
        "seconds": seconds,
        "device": {name: after[name] - before[name] for name in _COUNTED},
        "recording": recorded,
        "clients": received,
        "memory_mib": memory.figures_mib(),
    }


_COUNTED: Final = ("frames", "frames_lost_device", "frames_dropped_ring", "frames_processed")


def _received(url: str, echo: str, seconds: float, *, quiet: bool) -> dict[str, Any]:
    stream = f"{url.replace('http', 'ws', 1)}/api/v1/stream?device={DEVICE}"
    command = [sys.executable, "-m", "benchmarks.stream_clients", stream, echo]
    with progress("streaming", seconds, quiet=quiet) as done:
        process = subprocess.Popen(  # noqa: S603 - our own module
            [*command, "--seconds", str(seconds)], stdout=subprocess.PIPE, text=True
        )
        begin = time.monotonic()
        while process.poll() is None:
            time.sleep(0.5)
            done(min(seconds, time.monotonic() - begin))
        output = process.stdout.read() if process.stdout is not None else ""
    if process.returncode != 0:
        raise RuntimeError("the clients failed; see above")
    received: dict[str, Any] = json.loads(output)
    return received


@contextmanager
def _watched(pid: int) -> Iterator[Memory]:
    """Sample the resident memory of a process and its children."""
    memory, ended = Memory(), Event()

    def sample() -> None:
        while not ended.wait(SAMPLE_S):
            memory.samples.append(sum(_resident(one) for one in _family(pid)))

    thread = Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield memory
    finally:
        ended.set()
        thread.join()


def _family(pid: int) -> list[int]:
    found = [pid]
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in task.read_text().split():
                found += _family(int(child))
    return found


def _resident(pid: int) -> int:
    try:
        fields = Path(f"/proc/{pid}/statm").read_text().split()
    except OSError:
        return 0
    # Shared pages, such as those of a ring between two processes, are counted for the first only.
    return (int(fields[1]) - int(fields[2])) * PAGE_BYTES


def _show(figures: dict[str, Any]) -> None:
    table = Table(title=f"{TITLE}: {figures['rate_hz']:g} Hz", title_justify="left")
    table.add_column("figure")
    table.add_column("value", justify="right")
    device, clients = figures["device"], figures["clients"]
    table.add_row("seconds", f"{figures['seconds']:g}")
    table.add_row("frames", f"{device['frames']}")
    table.add_row("lost in the device or on the way", f"{device['frames_lost_device']}")
    table.add_row("dropped at the reader's ring", f"{device['frames_dropped_ring']}")
    for name, value in sorted(figures["recording"].items()):
        if isinstance(value, int | float):
            table.add_row(f"recording: {name}", f"{value}")
    for name in ("lossless", "display", "stalled"):
        group = clients[name]
        table.add_row(f"{name} clients", f"{group['clients']}")
        if group["messages"]:
            table.add_row("  frames received", f"{group['frames']}")
            table.add_row("  missed, lost", f"{group['missed']}, {group['lost']}")
    for name, value in figures["memory_mib"].items():
        table.add_row(f"memory {name}, MiB", f"{value:.1f}")
    console.print(table)
    latency = Table(title="latency, ms", title_justify="left")
    for column in ("", "display", "lossless", "bare echo, there and back", "display / echo"):
        latency.add_column(column, justify="right")
    echo = clients["echo"]["latency_ms"]
    for name, value in echo.items():
        shown = clients["display"]["latency_ms"][name]
        latency.add_row(
            name,
            f"{shown:.2f}",
            f"{clients['lossless']['latency_ms'][name]:.2f}",
            f"{value:.2f}",
            f"{shown / value:.1f}",
        )
    console.print(latency)
    console.print(
        "latency: mid exposure to the message in the client's hands, its newest frame. Displays "
        "take the newest frame 50 times a second, lossless clients every frame in bundles of 20 ms."
    )
