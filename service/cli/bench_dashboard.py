"""`lumiline bench dashboard`: what the scene takes in a browser, and what other clients notice."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from statistics import median
from time import sleep
from typing import TYPE_CHECKING, Any, Final

import httpx

from service.cli.bench_service import (
    DEVICE,
    Figures,
    device_counts,
    losses,
    run_benchmark,
    service_of_simulated_device,
    wait_for_frames,
)
from service.cli.output import console, make_table, progress

if TYPE_CHECKING:
    from collections.abc import Iterator

    from benchmarks.chromium import Browser
    from benchmarks.dashboard_clients import PageRequests
    from lumiline.client import Client
    from service.cli.service_process import RunningService

TITLE: Final = "the dashboard's scene of a 1 kHz device with 4 tools of 5 strobed markers each"
RATE_HZ: Final = 1000.0
TOOLS: Final = 4
MARKERS_MM: Final = (
    (0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (20.0, 15.0, 40.0), (-40.0, 20.0, 20.0)
)  # fmt: skip
PAGES: Final = 3
PART_S: Final = 20.0
"""How long each part is measured, but the visible page."""
ROUNDS: Final = 3
LEAD_S: Final = 3.0
"""Time for plain clients to start."""
_STAT: Final = Path("/proc/stat")
CONDITIONS: Final = {
    "alone": "alone",
    "plain_clients": f"{PAGES} plain clients",
    "pages": f"{PAGES} pages",
    "idle_pages": f"{PAGES} pages, idle priority",
}
"""What is beside the other client; measured one after the other in each round."""


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Measure, and print what pages take and what other clients notice of them.

    Args:
        seconds: for which one page is looked at.
        as_json: whether JSON is printed.
    """
    run_benchmark(lambda folder: measure(folder, seconds, quiet=as_json), _show, as_json=as_json)


def measure(
    folder: Path,
    seconds: float,
    *,
    part_s: float = PART_S,
    rounds: int = ROUNDS,
    quiet: bool = False,
) -> Figures:
    """Return the figures of one page, visible and hidden, and of another client beside pages.

    Args:
        folder: for the data of the service.
        seconds: for which one page is looked at.
        part_s: duration of each other part [s].
        rounds: how often another client is measured beside each of CONDITIONS.
        quiet: show no progress.

    Returns:
        ``visible``, ``hidden``, ``beside`` by condition, ``requests``: what a page asked for.

    Raises:
        RuntimeError: there is no browser, or something does not start.
    """
    from benchmarks.chromium import running_browser

    with (
        _tools_in_motion(folder, quiet=quiet) as (service, client),
        running_browser() as browser,
        running_browser() as idle_browser,
    ):
        one, requests = _one_page(browser, service.url, seconds, part_s, quiet=quiet)
        browsers = {"pages": browser, "idle_pages": idle_browser}
        found: dict[str, list[Figures]] = {condition: [] for condition in CONDITIONS}
        for number in range(1, rounds + 1):
            for condition, title in CONDITIONS.items():
                with progress(f"{title}, {number} of {rounds}", quiet=quiet):
                    notice = partial(_noticed, service, client, part_s)
                    if condition == "plain_clients":
                        beside = _beside_plain_clients(requests, part_s, notice)
                    elif condition in browsers:
                        beside = _beside_pages(
                            browsers[condition], service.url, notice,
                            idle=condition == "idle_pages",
                        )  # fmt: skip
                    else:
                        beside = notice()
                    found[condition].append(beside)
    return {
        **one,
        "beside": {condition: summarise(rounds) for condition, rounds in found.items()},
        "requests": asdict(requests),
    }


def _one_page(
    browser: "Browser", url: str, seconds: float, part_s: float, *, quiet: bool
) -> "tuple[Figures, PageRequests]":
    """Return what one page takes, visible and hidden, and what it asks for."""
    from benchmarks.dashboard import SETTLE_S, measure_visible, open_scenes, shares

    (page,) = open_scenes(browser, url)
    with progress("one page", seconds, quiet=quiet) as report:
        visible, requests = measure_visible(browser, page, seconds, report)
    tab = browser.hide(page)
    with progress("the page is hidden", quiet=quiet):
        if page.value("document.visibilityState") != "hidden":
            raise RuntimeError("the browser does not hide the page behind another tab")
        sleep(SETTLE_S)
        hidden = shares(browser, lambda: sleep(part_s))
        drawn = page.value("lumilineObserver.pictures")
    browser.call("Target.closeTarget", targetId=tab)
    browser.call("Target.activateTarget", targetId=page.target)
    with progress("the page is shown again", quiet=quiet):
        sleep(SETTLE_S)
    again = page.value("lumilineObserver.pictures") - drawn
    page.close()
    return {
        "visible": visible,
        "hidden": {"share_of_core": hidden, "pictures_after_it": again},
    }, requests


def _beside_pages(
    browser: "Browser", url: str, notice: Callable[[], Figures], *, idle: bool
) -> Figures:
    """Return what another client notices beside pages, and what those take."""
    from benchmarks.dashboard import measure_pages, open_scenes

    pages = open_scenes(browser, url, PAGES)
    noticed: Figures = {}
    taken = measure_pages(browser, pages, lambda: noticed.update(notice()), idle=idle)
    for page in pages:
        page.close()
    return noticed | taken


def _beside_plain_clients(
    requests: "PageRequests", seconds: float, notice: Callable[[], Figures]
) -> Figures:
    """Return what another client notices beside plain clients, and what those take."""
    module = "benchmarks.dashboard_clients"
    command = [sys.executable, "-m", module, "--clients", str(PAGES), "--seconds"]
    # They begin before the measurement, and end behind it.
    process = subprocess.Popen(  # noqa: S603 - our own module
        [*command, str(seconds + 2 * LEAD_S)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdin is not None
        process.stdin.write(json.dumps(asdict(requests)))
        process.stdin.close()
        process.stdin = None
        sleep(LEAD_S)
        noticed = notice()
        output, _ = process.communicate(timeout=60.0)
    finally:
        process.kill()
        process.wait()
    if process.returncode != 0:
        raise RuntimeError("the plain clients failed; see above")
    taken: Figures = json.loads(output)
    return noticed | taken


def summarise(rounds: list[Figures]) -> Figures:
    """Return the medians of rounds, the largest latency, and all losses; and the rounds."""
    latencies = [one["latency_ms"] for one in rounds]
    merged: Figures = {
        "latency_ms": {
            name: (max if name == "max" else median)(one[name] for one in latencies)
            for name in latencies[0]
        },
    }
    for name in ("frames_lost", "frames_not_tracked", "missed"):
        merged[name] = sum(one[name] for one in rounds)
    for name in ("server_share_of_core", "machine_busy", "messages_per_s"):
        if name in rounds[0]:
            merged[name] = median(one[name] for one in rounds)
    shares = [
        sum(one["share_of_core"].values()) if isinstance(one["share_of_core"], dict)
        else one["share_of_core"]
        for one in rounds if "share_of_core" in one
    ]  # fmt: skip
    return merged | ({"share_of_core": median(shares)} if shares else {}) | {"rounds": rounds}


@contextmanager
def _tools_in_motion(folder: Path, *, quiet: bool) -> "Iterator[tuple[RunningService, Client]]":
    """Run a service whose device sees the tools move."""
    tools = [
        {"markers_mm": MARKERS_MM, "phase": number / TOOLS, "centre_mm": (0.0, 0.0, 1500.0)}
        for number in range(TOOLS)
    ]
    markers = len(MARKERS_MM)
    cycle = round(6.0 * RATE_HZ)
    scene = {"kind": "moving-tools", "tools": tools}
    with service_of_simulated_device(folder, RATE_HZ, cycle, scene, quiet=quiet) as (
        service,
        client,
    ):
        for number in range(TOOLS):
            client.create_tool(
                id=f"tool-{number}", device_id=DEVICE, markers_mm=MARKERS_MM,
                title=f"Tool {number}",
                strobe_markers=list(range(number * markers, (number + 1) * markers)),
            )  # fmt: skip
        client.start_device(DEVICE)
        wait_for_frames(client, cycle)
        yield service, client


def _noticed(service: "RunningService", client: "Client", seconds: float) -> Figures:
    """Return what another client and the device notice: latency, losses, the server's share."""
    from benchmarks.live import measure as measure_stream

    before, used, machine = device_counts(client), _cpu_s(service.url), _machine_ticks()
    figures = measure_stream(f"{service.stream_url}?device_id={DEVICE}", seconds)
    busy, passed = (now - then for now, then in zip(_machine_ticks(), machine, strict=True))
    return {
        "latency_ms": figures.latency_ms,
        "missed": figures.missed,
        "server_share_of_core": (_cpu_s(service.url) - used) / figures.seconds,
        "machine_busy": busy / passed,
        **losses(before, device_counts(client)),
    }


def _cpu_s(url: str) -> float:
    """Return the computing time of the server's two processes so far [s]."""
    lines = httpx.get(f"{url}/metrics", timeout=60.0).text.splitlines()
    of_both = ("process_cpu_seconds_total ", "lumiline_station_cpu_seconds_total ")
    return sum(float(line.split()[1]) for line in lines if line.startswith(of_both))


def _machine_ticks() -> tuple[int, int]:
    """Return for how long all cores of this machine together were busy, and there."""
    user, nice, system, idle, wait, *more = map(int, _STAT.read_text().split("\n")[0].split()[1:8])
    busy = user + nice + system + sum(more)
    return busy, busy + idle + wait


def _show(figures: Figures) -> None:
    from benchmarks.dashboard import growth_mib_h

    visible, hidden, beside = figures["visible"], figures["hidden"], figures["beside"]
    three = beside["pages"]["rounds"][-1]
    kinds = sorted(visible["share_of_core"], key=visible["share_of_core"].__getitem__)[::-1]
    rows: list[tuple[object, ...]] = [
        (f"share of a core, {kind}", *(_percent(part, kind) for part in (visible, hidden, three)))
        for kind in kinds
    ]
    rows.append(("all", *(_percent(part, None) for part in (visible, hidden, three))))
    console.print(
        make_table(("browser", "one page", "the page hidden", f"{PAGES} pages"), rows, TITLE)
    )
    delays = visible["to_picture_ms"]
    objects, process = growth_mib_h(visible["memory"])
    first, last = visible["memory"][0], visible["memory"][-1]
    growth = "" if math.isnan(objects) else (
        f" ({objects:+.2f} and {process:+.1f} MiB an hour in the second half)"
    )  # fmt: skip
    console.print(
        f"{visible['messages_per_s']:.1f} messages and {visible['pictures_per_s']:.1f} pictures a "
        f"second; from the message to the picture {delays['p50']:.1f} ms, p99 "
        f"{delays['p99']:.1f}, most {delays['max']:.1f}; objects and process after {last[0]:.0f} s "
        f"{last[1]:.1f} and {last[2]:.1f} MiB, after {first[0]:.0f} s {first[1]:.1f} and "
        f"{first[2]:.1f}{growth}. Hidden and shown again, it drew {hidden['pictures_after_it']} "
        "pictures."
    )
    console.print(
        make_table(("another client and the server", *CONDITIONS.values()), noticed_rows(beside))
    )
    console.print(
        f"Medians of {len(beside['alone']['rounds'])} rounds; the largest latency and the losses "
        f"are of all. Latency: mid exposure to the message in the hands of another client, which "
        f"takes each frame; in brackets as a multiple of what it is alone. The plain clients ask "
        f"for what the page asked for ({_asked(figures['requests'])}) and draw nothing: what they "
        f"add is the server's. What pages add beyond is the browsers' own use of the "
        f"{os.cpu_count()} cores, which browsers on other machines do not have; of those with "
        "idle priority nearly all other programs go first."
    )


def noticed_rows(beside: dict[str, Figures]) -> list[tuple[object, ...]]:
    """Return the rows of what another client notices, each latency also as a multiple of alone."""
    every = [beside[condition] for condition in CONDITIONS]
    alone = beside["alone"]["latency_ms"]
    rows: list[tuple[object, ...]] = []
    for label, reference in alone.items():
        values = [one["latency_ms"][label] for one in every]
        more = [f"{value:.2f} ({value / reference:.2f})" for value in values[1:]]
        rows.append((f"latency {label}, ms", f"{values[0]:.2f}", *more))
    for title, name in (
        ("frames lost", "frames_lost"),
        ("frames not tracked", "frames_not_tracked"),
        ("messages missed by the client", "missed"),
    ):
        rows.append((title, *(one[name] for one in every)))
    for title, name, form in (
        ("server, share of a core", "server_share_of_core", "{:.0%}"),
        ("the others, share of a core", "share_of_core", "{:.0%}"),
        ("this machine's cores busy", "machine_busy", "{:.0%}"),
        ("messages a second, each of the others", "messages_per_s", "{:.1f}"),
    ):
        rows.append((title, *(form.format(one[name]) if name in one else "" for one in every)))
    return rows


def _asked(requests: Figures) -> str:
    """Return in words what a page asked for."""
    streams, per_s = len(requests["streams"]), len(requests["gets"]) / requests["period_s"]
    return f"{streams} stream, {per_s:.1f} requests a second"


def _percent(part: Figures, kind: str | None) -> str:
    found = part["share_of_core"]
    return f"{sum(found.values()) if kind is None else found.get(kind, 0.0):.1%}"
