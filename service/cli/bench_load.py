"""`lumiline bench load`: a device at full rate, a recorder, many clients, some of them stalled."""

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Final

import numpy as np

from service.cli.bench_service import (
    DEVICE,
    Figures,
    device_counts,
    run_benchmark,
    service_of_simulated_device,
    wait_for_frames,
)
from service.cli.output import console, make_table, progress

TITLE: Final = (
    "4 sensors x 2048 pixels over the serial protocol, a recorder, 50 clients of which five stalled"
)
SAMPLE_S: Final = 1.0
PAGE_BYTES: Final = 4096


def memory_figures_mib(samples: Sequence[int]) -> dict[str, float]:
    """Return the memory after a tenth of the time, at the end and at most, and its growth.

    The growth an hour is the slope of a straight line through the second half.
    """
    values = np.array(samples) / 2**20
    late = values[len(values) // 2 :]
    slope = np.polyfit(np.arange(len(late)), late, 1)[0]
    return {
        "early": float(values[len(values) // 10]),
        "end": float(values[-1]),
        "most": float(values.max()),
        "per_hour": float(slope) * 3600.0 / SAMPLE_S,
    }


def run(*, seconds: float, rate_hz: float, as_json: bool) -> None:
    """Measure, and print what was lost where, latencies and memory."""
    run_benchmark(
        lambda folder: _measure(folder, rate_hz, seconds, quiet=as_json), _show, as_json=as_json
    )


def _measure(folder: Path, rate_hz: float, seconds: float, *, quiet: bool) -> Figures:
    from benchmarks.baseline_echo import running_baseline_echo

    with (
        service_of_simulated_device(folder, rate_hz, 500, quiet=quiet) as (service, client),
        running_baseline_echo() as echo,
    ):
        client.start_device(DEVICE)
        wait_for_frames(client, 1)
        recording = client.start_recording(DEVICE)
        with _watched_memory(service.pid) as samples:
            before = device_counts(client)
            received = _received(f"{service.stream_url}?device_id={DEVICE}", echo, seconds, quiet)
            after = device_counts(client)
        recorded = client.stop_recording(recording.id)
    return {
        "rate_hz": rate_hz,
        "seconds": seconds,
        "device": {name: after[name] - before[name] for name in _COUNTED},
        "recording": recorded.model_dump(mode="json"),
        "clients": received,
        "memory_mib": memory_figures_mib(samples),
    }


_COUNTED: Final = (
    *("frames_received", "frames_lost", "frames_dropped_compute", "frames_processed"),
)


def _received(stream: str, echo: str, seconds: float, quiet: bool) -> Figures:
    command = [sys.executable, "-m", "benchmarks.stream_clients", stream, echo]
    with progress("streaming", seconds, quiet=quiet) as report:
        process = subprocess.Popen(  # noqa: S603 - our own module
            [*command, "--seconds", str(seconds)], stdout=subprocess.PIPE, text=True
        )
        begin = time.monotonic()
        while process.poll() is None:
            time.sleep(0.5)
            report(min(seconds, time.monotonic() - begin))
        output = process.stdout.read() if process.stdout is not None else ""
    if process.returncode != 0:
        raise RuntimeError("the clients failed; see above")
    received: Figures = json.loads(output)
    return received


@contextmanager
def _watched_memory(pid: int) -> Iterator[list[int]]:
    """Sample the resident memory of a process and its children [bytes]."""
    samples: list[int] = []
    ended = Event()

    def sample() -> None:
        while not ended.wait(SAMPLE_S):
            samples.append(sum(_resident(one) for one in _family(pid)))

    thread = Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        ended.set()
        thread.join()


def _family(pid: int) -> list[int]:
    family = [pid]
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in task.read_text().split():
                family += _family(int(child))
    return family


def _resident(pid: int) -> int:
    try:
        fields = Path(f"/proc/{pid}/statm").read_text().split()
    except OSError:
        return 0
    # Shared pages, such as those of a ring between two processes, are counted for the first only.
    return (int(fields[1]) - int(fields[2])) * PAGE_BYTES


def _show(figures: Figures) -> None:
    device, clients = figures["device"], figures["clients"]
    rows: list[tuple[object, object]] = [
        ("seconds", f"{figures['seconds']:g}"),
        ("frames", device["frames_received"]),
        ("lost in the device or on the way", device["frames_lost"]),
        ("dropped at the reader's ring", device["frames_dropped_compute"]),
    ]
    rows += [
        (f"recording: {name}", value)
        for name, value in sorted(figures["recording"].items())
        if isinstance(value, int | float)
    ]
    for name in ("lossless", "display", "stalled"):
        group = clients[name]
        rows.append((f"{name} clients", group["clients"]))
        if group["messages"]:
            rows.append(("  frames received", group["frames"]))
            rows.append(("  missed, lost", f"{group['missed']}, {group['lost']}"))
    rows += [(f"memory {name}, MiB", f"{mib:.1f}") for name, mib in figures["memory_mib"].items()]
    title = f"{TITLE}: {figures['rate_hz']:g} Hz"
    console.print(make_table(("figure", "value"), rows, title))
    display, lossless, echo = (
        clients[name]["latency_ms"] for name in ("display", "lossless", "echo")
    )
    latencies = (
        (name, f"{display[name]:.2f}", f"{lossless[name]:.2f}", f"{value:.2f}",
         f"{display[name] / value:.1f}")
        for name, value in echo.items()
    )  # fmt: skip
    headings = ("", "display", "lossless", "bare echo, there and back", "display / echo")
    console.print(make_table(headings, latencies, "latency, ms", texts=0))
    console.print(
        "latency: mid exposure to the message in the client's hands, its newest frame. Displays "
        "take the newest frame 50 times a second, lossless clients every frame in bundles of 20 ms."
    )
