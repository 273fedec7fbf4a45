"""A Chromium of this machine, steered by its debugging protocol."""

import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

BROWSERS: Final = ("chromium", "google-chrome")
ARGUMENTS: Final = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--use-angle=swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--remote-debugging-port=0", "--remote-allow-origins=*", "--window-size=1280,900"),
)
START_S: Final = 120.0


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

    def close(self) -> None:
        """Close the page."""
        self.browser.call("Target.closeTarget", targetId=self.target)

    def heap_mib(self) -> float:
        """Return the memory that its objects take, once those of no use are gone [MiB]."""
        self.call("HeapProfiler.collectGarbage")
        return float(self.call("Runtime.getHeapUsage")["usedSize"]) / 2**20


class Browser:
    """A Chromium, by its debugging protocol: only so can a page be hidden as a person hides it."""

    def __init__(self, socket: "ClientConnection") -> None:
        """Take the connection to the address that the browser gives."""
        self._socket = socket
        self._numbers = itertools.count(1)

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

    def open(self, url: str, script: str) -> Page:
        """Open a page in a window of its own; the script runs before those of the page."""
        target = self.call("Target.createTarget", url="about:blank", newWindow=True)["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, target, session)
        page.call("Page.enable")
        page.call("Page.addScriptToEvaluateOnNewDocument", source=script)
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

    def yield_precedence(self) -> None:
        """Take from its threads the precedence over other programs that root's browser has."""
        for thread in self._threads():
            with suppress(OSError):  # it has ended meanwhile
                if os.getpriority(os.PRIO_PROCESS, thread) < 0:
                    os.setpriority(os.PRIO_PROCESS, thread, 0)

    @contextmanager
    def idle_priority(self) -> Iterator[None]:
        """Let it compute only while no other program wants to.

        This is nearly as if it were on another machine. Only root gets it back from there.
        """
        self._set_scheduler(os.SCHED_IDLE)
        try:
            yield
        finally:
            self._set_scheduler(os.SCHED_OTHER)

    def _set_scheduler(self, policy: int) -> None:
        for thread in self._threads():
            with suppress(OSError):  # it has ended meanwhile, or that takes root's rights
                os.sched_setscheduler(thread, policy, os.sched_param(0))

    def _threads(self) -> Iterator[int]:
        """Yield the ids of the threads of all of its processes."""
        for process in self.call("SystemInfo.getProcessInfo")["processInfo"]:
            with suppress(FileNotFoundError):  # it has ended meanwhile
                for folder in Path(f"/proc/{process['id']}/task").iterdir():
                    yield int(folder.name)

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
    from websockets.sync.client import connect

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
            address = _address(Path(folder) / "DevToolsActivePort", process)
            with connect(address, compression=None, max_size=None, ping_interval=None) as socket:
                yield Browser(socket)
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
