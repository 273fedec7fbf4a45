"""Benchmark of the dashboard's scene in a Chromium: its share of a core, delays, memory."""

import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.stream_clients import percentiles

BROWSERS: Final = ("chromium", "google-chrome")
ARGUMENTS: Final = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--use-angle=swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--remote-debugging-port=0", "--remote-allow-origins=*", "--window-size=1280,900"),
)
NICENESS: Final = 19
START_S: Final = 60.0
SETTLE_S: Final = 5.0
"""Time for a page to load, or to notice that it is hidden, before anything is measured."""
MEMORY_EVERY_S: Final = 10.0

_OBSERVER: Final = """
(() => {
  const seen = { messages: 0, pictures: 0, delays: [] };
  window.lumilineObserver = seen;
  let newest = null;
  const Socket = window.WebSocket;
  window.WebSocket = class extends Socket {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", () => { seen.messages += 1; newest = performance.now(); });
    }
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
"""Notes when messages come and when the scene's markers are drawn with the newest of them: the task
behind the drawing begins when the picture was handed to the compositor."""


@dataclass(frozen=True)
class Page:
    """A page of a browser.

    Args:
        browser: the browser.
        target: its id.
        session: that of the commands to it.
    """

    browser: "Browser"
    target: str
    session: str

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command to the page and return its answer."""
        return self.browser.call(method, self.session, **parameters)

    def value(self, expression: str) -> Any:
        """Return the value of an expression in the page."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return answer["result"].get("value")

    def heap_mib(self) -> float:
        """Return the memory that its objects take, once those of no use are gone [MiB]."""
        self.call("HeapProfiler.collectGarbage")
        return float(self.call("Runtime.getHeapUsage")["usedSize"]) / 2**20


class Browser:
    """A Chromium, by its debugging protocol: only so can a page be hidden as a person hides it."""

    def __init__(self, address: str) -> None:
        """Connect to the address that the browser gives."""
        from websockets.sync.client import connect

        self._socket = connect(address, compression=None, max_size=None, ping_interval=None)
        self._numbers = itertools.count(1)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def call(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its answer; events meanwhile are dropped.

        Raises:
            RuntimeError: the browser refused it.
        """
        number = next(self._numbers)
        command = {"id": number, "method": method, "params": parameters}
        self._socket.send(json.dumps(command | ({"sessionId": session} if session else {})))
        while (answer := json.loads(self._socket.recv(timeout=START_S))).get("id") != number:
            pass
        if "error" in answer:
            raise RuntimeError(f"the browser refused {method}: {answer['error']['message']}")
        result: dict[str, Any] = answer["result"]
        return result

    def open(self, url: str) -> Page:
        """Open a page in a window of its own, with the observer."""
        target = self.call("Target.createTarget", url="about:blank", newWindow=True)["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, target, session)
        page.call("Page.enable")
        page.call("Page.addScriptToEvaluateOnNewDocument", source=_OBSERVER)
        page.call("Page.navigate", url=url)
        return page

    def hide(self, page: Page) -> str:
        """Hide a page behind another tab of its window; return that tab."""
        self.call("Target.activateTarget", targetId=page.target)
        return str(self.call("Target.createTarget", url="about:blank")["targetId"])

    def cpu_s(self) -> dict[str, float]:
        """Return the computing time of its processes so far, by kind [s]."""
        found: dict[str, float] = {}
        for process in self.call("SystemInfo.getProcessInfo")["processInfo"]:
            found[process["type"]] = found.get(process["type"], 0.0) + process["cpuTime"]
        return found

    def yield_processor(self) -> None:
        """Let all other programs go first.

        It draws without a graphics card, and would take the processor from the server; started by
        root, it even goes before it.
        """
        for process in self.call("SystemInfo.getProcessInfo")["processInfo"]:
            with suppress(OSError):  # a thread that has ended meanwhile
                for thread in Path(f"/proc/{process['id']}/task").iterdir():
                    os.setpriority(os.PRIO_PROCESS, int(thread.name), NICENESS)

    def renderers_mib(self) -> float:
        """Return the memory of the processes of its pages, shared parts in proportion [MiB]."""
        total = 0.0
        for process in self.call("SystemInfo.getProcessInfo")["processInfo"]:
            if process["type"] == "renderer":
                lines = Path(f"/proc/{process['id']}/smaps_rollup").read_text().splitlines()
                total += sum(int(line.split()[1]) / 1024 for line in lines if line[:4] == "Pss:")
        return total


@contextmanager
def running_browser() -> Iterator[Browser]:
    """Run a Chromium of this machine without a screen; ends it afterwards.

    Raises:
        RuntimeError: there is none, or it does not start.
    """
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        raise RuntimeError(f"none of {', '.join(BROWSERS)} is installed; install chromium")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = subprocess.Popen(  # noqa: S603 - a browser of this machine
            [path, *ARGUMENTS, f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            browser = Browser(_address(Path(folder) / "DevToolsActivePort", process))
            yield browser
            browser.close()
        finally:
            process.terminate()
            process.wait()


def _address(file: Path, process: "subprocess.Popen[bytes]") -> str:
    """Return the address that a browser writes once it is there."""
    end = time.monotonic() + START_S
    while time.monotonic() < end and process.poll() is None:
        if file.exists() and len(lines := file.read_text().split()) == 2:
            return f"ws://127.0.0.1:{lines[0]}{lines[1]}"
        time.sleep(0.1)
    raise RuntimeError(f"the browser did not start within {START_S:g} s")


def open_scene(browser: Browser, url: str) -> Page:
    """Open the scene of a server and wait until it is drawn.

    Raises:
        RuntimeError: it is not drawn.
    """
    page = browser.open(f"{url}/#/scene")
    end = time.monotonic() + START_S
    while not page.value("window.lumilineObserver && lumilineObserver.pictures > 0"):
        if time.monotonic() > end:
            raise RuntimeError(f"the page draws nothing: {page.value('document.body.innerText')}")
        time.sleep(0.2)
    time.sleep(SETTLE_S)
    return page


def shares(browser: Browser, wait: Callable[[], object]) -> dict[str, float]:
    """Return the share of a core that the browser's processes take while waiting, by kind."""
    browser.yield_processor()
    before, begin = browser.cpu_s(), time.monotonic()
    wait()
    after, end = browser.cpu_s(), time.monotonic()
    return {kind: (now - before.get(kind, 0.0)) / (end - begin) for kind, now in after.items()}


def measure_visible(
    browser: Browser, page: Page, seconds: float, progress: Callable[[float], None]
) -> dict[str, Any]:
    """Return what a page that is looked at takes, its pictures and its memory over time.

    Returns:
        ``share_of_core`` by kind of process, ``messages_per_s``, ``pictures_per_s``,
        ``to_picture_ms`` by percentile, ``memory``: elapsed time [s], the page's objects and
        its process [MiB].
    """
    page.value("lumilineObserver.delays.length = 0")
    delays: list[float] = []
    before = page.value("({...lumilineObserver})")
    begin = time.monotonic()
    memory: list[tuple[float, float, float]] = []

    def look() -> None:
        while (elapsed := time.monotonic() - begin) < seconds:
            progress(elapsed)
            time.sleep(min(MEMORY_EVERY_S, seconds - elapsed))
            delays.extend(page.value("lumilineObserver.delays.splice(0)"))
            memory.append((time.monotonic() - begin, page.heap_mib(), browser.renderers_mib()))

    share = shares(browser, look)
    elapsed = time.monotonic() - begin
    after = page.value("({...lumilineObserver})")
    return {
        "share_of_core": share,
        "messages_per_s": (after["messages"] - before["messages"]) / elapsed,
        "pictures_per_s": (after["pictures"] - before["pictures"]) / elapsed,
        "to_picture_ms": percentiles([round(1e6 * one) for one in delays]),
        "memory": memory,
    }


def growth_mib_h(memory: list[tuple[float, float, float]]) -> tuple[float, float]:
    """Return how the memory of objects and process grows in the second half [MiB/h]; NaN: short."""
    rows = np.array(memory)
    rows = rows[len(rows) // 2 :]
    if len(rows) < 3:
        return float("nan"), float("nan")
    slopes = np.polyfit(rows[:, 0] / 3600.0, rows[:, 1:], 1)[0]
    return float(slopes[0]), float(slopes[1])
