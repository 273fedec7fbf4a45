"""Benchmark of the dashboard's scene in a Chromium: its cost, delays, memory and requests."""

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any, Final

import numpy as np

from benchmarks.chromium import START_S, Browser, Page
from benchmarks.dashboard_clients import PageRequests
from benchmarks.stream_clients import percentiles

SETTLE_S: Final = 5.0
"""Time for a page to load, or to notice that it is hidden, before anything is measured."""
MEMORY_EVERY_S: Final = 10.0

_OBSERVER: Final = """
(() => {
  const seen = { messages: 0, pictures: 0, delays: [], requests: [], streams: [] };
  window.lumilineObserver = seen;
  let newest = null;
  const Socket = window.WebSocket;
  window.WebSocket = class extends Socket {
    constructor(address, protocols) {
      super(address, protocols);
      const stream = [String(address), protocols];
      seen.streams.push(stream);
      this.addEventListener("message", () => { seen.messages += 1; newest = performance.now(); });
      this.addEventListener("close", () => seen.streams.splice(seen.streams.indexOf(stream), 1));
    }
  };
  const fetch = window.fetch;
  window.fetch = function (asked, options) {
    const request = new Request(asked, options);
    seen.requests.push([performance.now() / 1000, request.method, request.url]);
    return fetch.call(this, request);
  };
  const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
  WebGL2RenderingContext.prototype.drawElementsInstanced = function (...given) {
    draw.apply(this, given);
    if (newest === null) return;
    const shown = newest;
    newest = null;
    const after = new MessageChannel();
    after.port1.onmessage = () => {
      seen.pictures += 1;
      seen.delays.push(performance.now() - shown);
      after.port1.close();
    };
    after.port2.postMessage(null);
  };
})();
"""
"""Notes what is asked for, when messages come and when the scene's markers are drawn with the
newest of them: the task behind the drawing begins when the picture was handed to the compositor."""


def open_scenes(browser: Browser, url: str, count: int = 1) -> list[Page]:
    """Open the scene of a server in windows of their own, and wait until all are drawn.

    Raises:
        RuntimeError: one is not drawn.
    """
    pages = [browser.open(f"{url}/#/scene", _OBSERVER) for _ in range(count)]
    end = time.monotonic() + START_S
    for page in pages:
        while not page.value("window.lumilineObserver && lumilineObserver.pictures > 0"):
            if time.monotonic() > end:
                shown = page.value("document.body.innerText")
                raise RuntimeError(f"the page draws nothing: {shown}")
            time.sleep(0.2)
    time.sleep(SETTLE_S)
    return pages


def shares(browser: Browser, wait: Callable[[], object]) -> dict[str, float]:
    """Return the share of a core that the browser's processes take while waiting, by kind."""
    browser.yield_precedence()
    before, begin = browser.cpu_s(), time.monotonic()
    wait()
    after, end = browser.cpu_s(), time.monotonic()
    return {kind: (now - before.get(kind, 0.0)) / (end - begin) for kind, now in after.items()}


def measure_pages(
    browser: Browser, pages: Sequence[Page], wait: Callable[[], object], *, idle: bool = False
) -> dict[str, Any]:
    """Return what pages take while waiting, and what of the device comes to be seen.

    Args:
        browser: that of the pages.
        pages: drawn ones.
        wait: waits for as long as is measured.
        idle: the browser has idle priority meanwhile.

    Returns:
        ``share_of_core`` by kind of process; ``messages_per_s`` and ``pictures_per_s`` of a page,
        on average.
    """
    counts = "[performance.now() / 1000, lumilineObserver.messages, lumilineObserver.pictures]"
    before = [page.value(counts) for page in pages]
    with browser.idle_priority() if idle else nullcontext():
        share = shares(browser, wait)
    # Each by its own clock: one that has much to do answers late.
    passed = np.array([page.value(counts) for page in pages]) - np.array(before)
    messages, pictures = (passed[:, 1:] / passed[:, :1]).mean(axis=0).tolist()
    return {"share_of_core": share, "messages_per_s": messages, "pictures_per_s": pictures}


def measure_visible(
    browser: Browser, page: Page, seconds: float, progress: Callable[[float], None]
) -> tuple[dict[str, Any], PageRequests]:
    """Return what a page that is looked at takes, its pictures and its memory over time.

    Returns:
        The members of ``measure_pages``, ``to_picture_ms`` by percentile, ``memory``: elapsed time
        [s], the page's objects and its process [MiB]. And what the page asked for.
    """
    page.value("lumilineObserver.delays.length = lumilineObserver.requests.length = 0")
    begin_s = float(page.value("performance.now() / 1000"))
    delays: list[float] = []
    begin = time.monotonic()
    memory: list[tuple[float, float, float]] = []

    def look() -> None:
        while (elapsed := time.monotonic() - begin) < seconds:
            progress(elapsed)
            time.sleep(min(MEMORY_EVERY_S, seconds - elapsed))
            delays.extend(page.value("lumilineObserver.delays.splice(0)"))
            requests.extend(page.value("lumilineObserver.requests.splice(0)"))
            memory.append((time.monotonic() - begin, page.heap_mib(), browser.renderers_mib()))

    requests: list[tuple[float, str, str]] = []
    figures = measure_pages(browser, [page], look)
    asked = PageRequests(
        tuple((address, tuple(names)) for address, names in page.value("lumilineObserver.streams")),
        tuple((at_s - begin_s, url) for at_s, method, url in requests if method == "GET"),
        float(page.value("performance.now() / 1000")) - begin_s,
    )
    figures |= {
        "to_picture_ms": percentiles([round(1e6 * one) for one in delays]),
        "memory": memory,
    }
    return figures, asked


def growth_mib_h(memory: list[tuple[float, float, float]]) -> tuple[float, float]:
    """Return how the memory of objects and process grows in the second half [MiB/h]; NaN: short."""
    rows = np.array(memory)
    rows = rows[len(rows) // 2 :]
    if len(rows) < 3:
        return float("nan"), float("nan")
    slopes = np.polyfit(rows[:, 0] / 3600.0, rows[:, 1:], 1)[0]
    return float(slopes[0]), float(slopes[1])
