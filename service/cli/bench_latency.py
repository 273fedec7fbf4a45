"""`lumiline bench latency`: a serial device to a client, quiet and loaded, beside a relay."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final
from urllib.parse import urlsplit

import numpy as np

from lumiline.client import Client
from service.cli.bench_service import (
    DEVICE,
    Figures,
    device_counts,
    losses,
    run_benchmark,
    run_client,
    service_of_simulated_device,
    wait_for_frames,
)
from service.cli.output import console, make_table, progress

TITLE: Final = "4 sensors x 2048 pixels at 1 kHz over the serial protocol to one client"
RATE_HZ: Final = 1000.0
BLOCK_S: Final = 6.0
CLIENTS: Final = 10
REQUESTS_HZ: Final = 50.0
_CYCLE: Final = 500


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Measure in blocks that take turns, and print the figures beside those of the relay."""
    run_benchmark(lambda folder: _measure(folder, seconds, quiet=as_json), _show, as_json=as_json)


def _measure(folder: Path, seconds: float, *, quiet: bool) -> Figures:
    from benchmarks.baseline_relay import running_baseline_relay
    from benchmarks.latency import shortest_delay_ns, steal_s
    from hardware.serial.codec import encode
    from hardware.serial.messages import Start

    rounds = max(1, round(seconds / BLOCK_S))
    blocks: dict[str, list[np.ndarray[Any, Any]]] = {"relay": [], "service": [], "loaded": []}
    steal = dict.fromkeys(blocks, 0.0)
    lost = {}
    with ExitStack() as stack:
        service, client = stack.enter_context(
            service_of_simulated_device(folder, RATE_HZ, _CYCLE, quiet=quiet)
        )
        made = json.loads((folder / "device.log").read_text(encoding="utf-8"))
        url, on_ns = urlsplit(made["url"]), int(made["switched_on_ns"])
        device = str(url.hostname), int(url.port or 0)
        size = _message_bytes(service.stream_url, client)
        relay = stack.enter_context(running_baseline_relay(device, encode(Start(1)), size))
        delay_ns = shortest_delay_ns(device, encode(Start(1)), 3.0) - on_ns
        report = stack.enter_context(progress("blocks in turn", 3.0 * rounds, quiet=quiet))
        for number in range(rounds):
            for step, name in enumerate(blocks):
                before_s = steal_s()
                if name == "relay":
                    received = _received("relay", relay) - on_ns
                else:
                    received, lost[name, number] = _of_service(
                        service.stream_url, client, loaded=name == "loaded"
                    )
                    # Its times of exposure are later by the shortest delay there is.
                    received += delay_ns
                blocks[name].append(received)
                steal[name] += steal_s() - before_s
                report(3.0 * number + step + 1.0)
    from benchmarks.stream_clients import percentiles

    return {
        "message_bytes": size,
        "shortest_delay_ms": delay_ns * 1e-6,
        "steal_s": steal,
        "frames_lost": {
            name: sum(one for (kind, _), one in lost.items() if kind == name)
            for name in ("service", "loaded")
        },
        **{
            name: percentiles(np.concatenate(parts).tolist()) | {"frames": sum(map(len, parts))}
            for name, parts in blocks.items()
        },
    }


def _received(kind: str, url: str, seconds: float = BLOCK_S) -> np.ndarray[Any, Any]:
    """Receive in a process of its own; return latencies but for the clocks' difference [ns]."""
    times = run_client("benchmarks.latency", kind, url, "--seconds", str(seconds))
    return np.asarray(np.array(times["received_ns"]) - np.array(times["exposure_ns"]))


def _message_bytes(stream: str, client: Client) -> int:
    """Return the size of a message with a point."""
    from websockets.sync.client import connect

    client.start_device(DEVICE)
    wait_for_frames(client, 100)
    with connect(f"{stream}?device_id={DEVICE}", compression=None) as socket:
        sizes = [len(socket.recv(timeout=30.0)) for _ in range(50)]
    client.stop_device(DEVICE)
    return sorted(sizes)[len(sizes) // 2]


def _of_service(stream: str, client: Client, *, loaded: bool) -> tuple[np.ndarray[Any, Any], int]:
    client.start_device(DEVICE)
    wait_for_frames(client, 100)
    with ExitStack() as stack:
        if loaded:
            stack.enter_context(_load(stream, client))
        before = device_counts(client)
        received = _received("service", f"{stream}?device_id={DEVICE}")
        found = losses(before, device_counts(client))
    client.stop_device(DEVICE)
    return received, found["frames_lost"]


@contextmanager
def _load(stream: str, client: Client) -> Iterator[None]:
    """Let other clients read, the device be recorded, and requests come."""
    others = subprocess.Popen(  # noqa: S603 - our own module
        [sys.executable, "-c", _OTHERS, f"{stream}?device_id={DEVICE}", str(CLIENTS)]
    )
    recording = client.start_recording(DEVICE)
    ended = Event()

    def request() -> None:
        due_s = time.monotonic()
        while not ended.wait(max(0.0, due_s - time.monotonic())):
            due_s += 1.0 / REQUESTS_HZ
            client.device_state(DEVICE)

    thread = Thread(target=request)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        client.stop_recording(recording.id)
        client.delete_recording(recording.id)
        others.terminate()
        others.wait()


_OTHERS: Final = """
import asyncio, sys
from websockets.asyncio.client import connect

async def read():
    async with connect(sys.argv[1], compression=None, max_size=None) as socket:
        async for _ in socket:
            pass

async def main():
    await asyncio.gather(*(read() for _ in range(int(sys.argv[2]))))

asyncio.run(main())
"""


def _show(found: Figures) -> None:
    rows: list[tuple[object, ...]] = []
    for name in ("p50", "p90", "p99", "p99.9", "max"):
        bare, quiet, loaded = (found[kind][name] for kind in ("relay", "service", "loaded"))
        rows.append(
            (f"latency {name}, ms", f"{bare:.2f}", f"{quiet:.2f}", f"{quiet / bare:.2f}",
             f"{loaded:.2f}", f"{loaded / quiet:.2f}")
        )  # fmt: skip
    counts = [f"{found[kind]['frames']:.0f}" for kind in ("relay", "service", "loaded")]
    rows.append(("messages", counts[0], counts[1], "", counts[2], ""))
    rows.append(
        ("frames lost", "", found["frames_lost"]["service"], "", found["frames_lost"]["loaded"], "")
    )
    steal = [f"{found['steal_s'][kind]:.2f}" for kind in ("relay", "service", "loaded")]
    rows.append(("steal, s", steal[0], steal[1], "", steal[2], ""))
    heads = ("figure", "relay", "Lumiline", "ratio", "loaded", "over quiet")
    console.print(make_table(heads, rows, TITLE))
    console.print(
        "latency: middle of the exposure to the message in the client's hands. The relay passes on "
        f"as many bytes as a message has ({found['message_bytes']}) for each exposure, and decodes "
        f"nothing. {found['shortest_delay_ms']:.2f} ms of each pass until the exposure's last byte "
        f"is here. Loaded: {CLIENTS} more clients, a recording, and {REQUESTS_HZ:g} requests a "
        "second."
    )
