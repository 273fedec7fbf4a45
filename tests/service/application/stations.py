"""Stations and gateways as processes of their own, for tests of what they do together."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import httpx

from tests.nats_server import free_port

WAIT_S: Final = 120.0
"""For what takes a second where the machine has time."""


def wait_until(condition: Callable[[], object], what: str = "it", within_s: float = WAIT_S) -> Any:
    """Return what a condition gives once it is true."""
    end = time.monotonic() + within_s
    while True:
        found = condition()
        if found:
            return found
        assert time.monotonic() < end, f"{what} did not happen"
        time.sleep(0.02)


class Process:
    """A command of this program in a process of its own.

    Args:
        arguments: of the command line.
        log: gets what it writes.
        settings: by their names.
        before: words before the command, such as those of another network namespace.
    """

    def __init__(
        self,
        arguments: list[str],
        log: Path,
        settings: Mapping[str, str],
        before: tuple[str, ...] = (),
    ) -> None:
        self.log = log
        environment = {k: v for k, v in os.environ.items() if not k.startswith("LUMILINE_")}
        environment |= {f"LUMILINE_{k.upper()}": v for k, v in settings.items()}
        self._environment = environment
        self._command = [*before, sys.executable, "-m", "service.cli", *arguments]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it."""
        self.begin()

    def begin(self) -> None:
        """Start it, and wait for nothing."""
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command, stdout=log, stderr=log, env=self._environment
            )

    @property
    def text(self) -> str:
        """What it has written."""
        return self.log.read_text(encoding="utf-8") if self.log.exists() else ""

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process is not None and self._process.poll() is None

    def kill(self, sig: signal.Signals = signal.SIGKILL) -> None:
        """End it by a signal, and wait for that."""
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)
            self._process.send_signal(sig)
            try:
                self._process.wait(30.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None

    def send(self, sig: signal.Signals) -> None:
        """Send it a signal."""
        assert self._process is not None
        self._process.send_signal(sig)


class Station(Process):
    """`lumiline station`."""

    def __init__(
        self,
        name: str,
        folder: Path,
        bus: str,
        database: str,
        before: tuple[str, ...] = (),
        **settings: str,
    ) -> None:
        self.name = name
        super().__init__(
            ["station", "--name", name, "--data-dir", str(folder / name)],
            folder / f"{name}.log",
            {"bus_url": bus, "database_url": database, "compute_device": "cpu"} | settings,
            before,
        )


class GatewayServer(Process):
    """`lumiline serve` with a bus, and without devices of its own."""

    def __init__(
        self,
        name: str,
        folder: Path,
        bus: str,
        database: str,
        before: tuple[str, ...] = (),
        host: str = "127.0.0.1",
        **settings: str,
    ) -> None:
        port = free_port()
        self.url = f"http://{host}:{port}"
        self.key: str | None = None
        """Sent with each request; None: clients of this machine need none."""
        super().__init__(
            [
                "serve", "--host", host, "--port", str(port),
                "--data-dir", str(folder / name),
            ],
            folder / f"{name}.log",
            {
                "bus_url": bus, "database_url": database, "compute_device": "cpu",
                "station": "none",
            } | settings,
            before,
        )  # fmt: skip

    def start(self) -> None:
        """Start it, and wait until it answers."""
        self.begin()
        wait_until(self.answers, "the gateway's start")

    def answers(self) -> bool:
        """Whether it is ready."""
        assert self.alive, self.text
        try:
            return httpx.get(f"{self.url}/readyz", timeout=5.0).status_code == 200
        except httpx.TransportError:
            return False

    def request(
        self, method: str, path: str, body: Any = None, timeout_s: float = 90.0
    ) -> httpx.Response:
        """Send a request."""
        headers = self._headers | ({"if-match": "*"} if method == "PATCH" else {})
        return httpx.request(
            method, f"{self.url}/api/v1{path}", json=body, headers=headers, timeout=timeout_s
        )

    @property
    def _headers(self) -> dict[str, str]:
        return {} if self.key is None else {"authorization": f"Bearer {self.key}"}

    def get(self, path: str) -> Any:
        """Return what there is."""
        answer = self.request("GET", path)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def state(self, device_id: str) -> dict[str, Any]:
        """Return what a device is doing."""
        found: dict[str, Any] = self.get(f"/devices/{device_id}/state")
        return found

    def running(self, device_id: str) -> bool:
        """Whether frames of a device come."""
        state = self.state(device_id)
        return state["state"] == "running" and state["frames_processed"] > 0

    def station(self, name: str) -> dict[str, Any] | None:
        """Return how a station stands."""
        stations = self.get("/stations")["items"]
        return next((one for one in stations if one["name"] == name), None)

    @contextmanager
    def stream(self, device_id: str, content: str = "points") -> Iterator["Messages"]:
        """Yield the messages of a stream, every one: this machine may be busy."""
        from websockets.sync.client import connect

        url = f"{self.url.replace('http', 'ws')}/api/v1/stream"
        query = f"?device_id={device_id}&content={content}&encoding=json&mode=lossless"
        # Read also while the test does something else: who reads nothing is cut off.
        with connect(
            url + query, open_timeout=30.0, additional_headers=self._headers, max_queue=None
        ) as websocket:
            yield Messages(websocket)


class Messages:
    """Messages of a websocket."""

    def __init__(self, websocket: Any) -> None:
        self._websocket = websocket

    def next(self, timeout_s: float = WAIT_S) -> dict[str, Any]:
        """Return the next one; raises TimeoutError."""
        found: dict[str, Any] = json.loads(self._websocket.recv(timeout_s))
        return found

    def until(self, wanted: Callable[[dict[str, Any]], object]) -> list[dict[str, Any]]:
        """Return the messages up to one that is wanted."""
        taken = []
        end = time.monotonic() + WAIT_S
        while not taken or not wanted(taken[-1]):
            taken.append(self.next(max(0.1, end - time.monotonic())))
        return taken
