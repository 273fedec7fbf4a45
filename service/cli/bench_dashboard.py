"""`lumiline bench dashboard`: what the scene takes in a browser, and what other clients notice."""

import math
from contextlib import contextmanager
from pathlib import Path
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
"""How long everything but the visible page is measured."""


def run(*, seconds: float, as_json: bool, **_: Any) -> None:
    """Measure, and print what pages take and what other clients notice of them.

    Args:
        seconds: for which one page is looked at.
        as_json: whether JSON is printed.
    """
    run_benchmark(lambda folder: _measure(folder, seconds, quiet=as_json), _show, as_json=as_json)


def _measure(folder: Path, seconds: float, *, quiet: bool) -> Figures:
    from benchmarks.dashboard import measure_visible, open_scene, running_browser, shares

    with _tools_in_motion(folder, quiet=quiet) as (service, client), running_browser() as browser:
        alone = _noticed(service, client, quiet=quiet)
        page = open_scene(browser, service.url)
        with progress("one page", seconds, quiet=quiet) as report:
            visible = measure_visible(browser, page, seconds, report)
        tab = browser.hide(page)
        with progress("the page is hidden", quiet=quiet):
            if page.value("document.visibilityState") != "hidden":
                raise RuntimeError("the browser does not hide the page behind another tab")
            sleep(PART_S / 4)
            hidden = shares(browser, lambda: sleep(PART_S))
            drawn = page.value("lumilineObserver.pictures")
        browser.call("Target.closeTarget", targetId=tab)
        browser.call("Target.activateTarget", targetId=page.target)
        with progress(f"{PAGES} pages", quiet=quiet):
            for _ in range(PAGES - 1):
                open_scene(browser, service.url)
        shown_again = page.value("lumilineObserver.pictures") - drawn
        beside: Figures = {}
        three = shares(browser, lambda: beside.update(_noticed(service, client, quiet=quiet)))
    return {
        "visible": visible,
        "hidden": {"share_of_core": hidden, "pictures_after_it": shown_again},
        "without_pages": alone,
        "with_pages": beside | {"share_of_core": three},
    }


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


def _noticed(service: "RunningService", client: "Client", *, quiet: bool) -> Figures:
    """Return what another client and the device notice: latency, losses, the server's share."""
    from benchmarks.live import measure

    before, used = device_counts(client), _cpu_s(service.url)
    url = f"{service.stream_url}?device_id={DEVICE}"
    with progress("another client", PART_S, quiet=quiet) as report:
        figures = measure(url, PART_S, report)
    return {
        "latency_ms": figures.latency_ms,
        "missed": figures.missed,
        "server_share_of_core": (_cpu_s(service.url) - used) / figures.seconds,
        **losses(before, device_counts(client)),
    }


def _cpu_s(url: str) -> float:
    """Return the computing time of the server so far [s]."""
    lines = httpx.get(f"{url}/metrics", timeout=60.0).text.splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("process_cpu_seconds"))


def _show(figures: Figures) -> None:
    from benchmarks.dashboard import growth_mib_h

    visible, hidden, three = figures["visible"], figures["hidden"], figures["with_pages"]
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
    headings = ("another client and the server", "without pages", f"with {PAGES} pages")
    alone = figures["without_pages"]
    both = (alone, three)
    noticed: list[tuple[object, ...]] = [
        (f"latency {label}, ms", *(f"{one['latency_ms'][label]:.2f}" for one in both))
        for label in alone["latency_ms"]
    ]
    noticed += [
        ("frames lost", *(one["frames_lost"] for one in both)),
        ("frames not tracked", *(one["frames_not_tracked"] for one in both)),
        ("messages missed by the client", *(one["missed"] for one in both)),
        ("server, share of a core", *(f"{one['server_share_of_core']:.0%}" for one in both)),
    ]
    console.print(make_table(headings, noticed))


def _percent(part: Figures, kind: str | None) -> str:
    found = part["share_of_core"]
    return f"{sum(found.values()) if kind is None else found.get(kind, 0.0):.1%}"
