"""`lumiline bench rate`: the highest rate of a serial device that one client gets without loss."""

import json
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from lumiline.client import Client
from service.cli.bench_service import (
    DEVICE,
    Figures,
    device_counts,
    losses,
    run_benchmark,
    run_client,
    wait_for_frames,
)
from service.cli.output import console, make_table, progress
from service.cli.server_session import client_session
from service.cli.service_process import RunningService, service_process, simulated_device

TITLE: Final = "4 sensors x 2048 pixels over the serial protocol to one client, without loss"
RATES_HZ: Final = (1000.0, 2000.0, 3000.0, 4000.0, 5000.0, 6500.0, 8000.0, 10000.0)
"""Rates that are tried, up to the highest that devices are simulated at."""
TRIAL_S: Final = 10.0
START_S: Final = 60.0
"""How long the device's process may take to render its frames."""
MESSAGE_BYTES: Final = 420
"""Of a message with one point, which the relay's are as large as."""
MIN_SENT: Final = 0.98
"""Share of its exposures that the device's process must send, or the rate says nothing."""
_CYCLE: Final = 500


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Try one rate after the other, then keep the highest for the whole time; print the figures."""
    run_benchmark(lambda folder: _measure(folder, seconds, quiet=as_json), _show, as_json=as_json)


def _measure(folder: Path, seconds: float, *, quiet: bool) -> Figures:
    trials: list[Figures] = []
    with ExitStack() as stack:
        service = stack.enter_context(service_process(folder / "service", quiet=quiet))
        client = stack.enter_context(client_session(service.url, None, 60.0))
        report = stack.enter_context(progress("rates", float(len(RATES_HZ)), quiet=quiet))
        for number, rate_hz in enumerate(RATES_HZ):
            trials.append(_trial(folder, service, client, rate_hz, TRIAL_S))
            report(number + 1.0)
            if not trials[-1]["kept"]:
                break
        kept = [trial["rate_hz"] for trial in trials if trial["kept"]]
        whole: Figures | None = None
        tried: list[Figures] = []
        while kept and not (whole and whole["kept"]):
            whole = _trial(folder, service, client, kept.pop(), seconds)
            tried.append(whole)
    highest = whole["rate_hz"] if whole and whole["kept"] else None
    return {"trials": trials, "whole_time": tried, "highest_rate_hz": highest}


def _trial(
    folder: Path, service: RunningService, client: Client, rate_hz: float, seconds: float
) -> Figures:
    """Return what a client gets of a device at a rate, and what a bare relay passes on."""
    from benchmarks.baseline_relay import running_baseline_relay
    from hardware.serial.codec import encode
    from hardware.serial.messages import Start

    client.stop_device(DEVICE)
    with simulated_device(folder, rate_hz, _CYCLE) as source:
        device = _listening_device(folder / "device.log")
        client.request("PATCH", f"/api/v1/devices/{DEVICE}", body={"source": source})
        client.start_device(DEVICE)
        wait_for_frames(client, 100)
        before = device_counts(client)
        stream = f"{service.stream_url}?device_id={DEVICE}"
        got = run_client("benchmarks.live", stream, "--seconds", str(seconds))
        after = device_counts(client)
        client.stop_device(DEVICE)
        with running_baseline_relay(device, encode(Start(1)), MESSAGE_BYTES) as relay:
            shortly = str(min(seconds, TRIAL_S))
            relayed = run_client("benchmarks.latency", "relay", relay, "--seconds", shortly)
    relayed_ns = relayed["exposure_ns"]
    # Numbers that the client lacks, wherever they were lost; the device's counts are of longer.
    sent = got["frames_per_s"] + got["lost"] / got["seconds"]
    lost = max(got["lost"], losses(before, after)["frames_lost"])
    return {
        "rate_hz": rate_hz,
        "seconds": got["seconds"],
        "sent_hz": sent,
        "received_hz": got["frames_per_s"],
        "relay_hz": 1e9 * (len(relayed_ns) - 1) / (relayed_ns[-1] - relayed_ns[0]),
        "lost": lost,
        "latency_ms": got["latency_ms"],
        "kept": lost == 0 and sent >= MIN_SENT * rate_hz,
    }


def _listening_device(log: Path) -> tuple[str, int]:
    """Return host and port of the device, which says them when it listens."""
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        with suppress(json.JSONDecodeError):
            url = urlsplit(json.loads(log.read_text(encoding="utf-8"))["url"])
            return str(url.hostname), int(url.port or 0)
        time.sleep(0.05)
    raise RuntimeError(f"the simulated device does not listen within {START_S:g} s")


def _show(figures: Figures) -> None:
    rows = [
        (
            f"{trial['rate_hz']:.0f}",
            f"{trial['sent_hz']:.0f}",
            f"{trial['received_hz']:.0f}",
            f"{trial['relay_hz']:.0f}",
            trial["lost"],
            *(f"{trial['latency_ms'][name]:.2f}" for name in ("p50", "p99")),
            "kept" if trial["kept"] else "lossy",
        )
        for trial in (*figures["trials"], *figures["whole_time"])
    ]
    heads = (*("rate, Hz", "sent, Hz", "got, Hz", "relay, Hz", "lost", "p50, ms", "p99, ms", ""),)
    console.print(make_table(heads, rows, TITLE))
    highest = figures["highest_rate_hz"]
    console.print(
        f"highest rate without loss: {highest:.0f} Hz"
        if highest
        else "no rate was kept without loss"
    )
    console.print(
        "A rate is kept when nothing is lost, dropped or missed, and the device's own process "
        "sends what it says. To see how it grows with cores, run it with: taskset -c 0-3"
    )
