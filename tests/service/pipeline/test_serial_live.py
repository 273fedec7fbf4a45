"""A device on a serial port behind a real server: plugged in and out under its clients' eyes."""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.sync.client import ClientConnection, connect

from tests.running_server import serving


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
    return port


@contextmanager
def plugged_in(port: int) -> Iterator[None]:
    """A simulated device in a process of its own."""
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", "simulate-serial",
         "--listen", f"127.0.0.1:{port}", "--rate-hz", "200", "--cycle", "8"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        assert process.stdout is not None
        assert "the device is at socket://127.0.0.1" in process.stdout.readline()
        try:
            yield
        finally:
            process.terminate()
    assert process.returncode == 0


def until(stream: ClientConnection, **wanted: Any) -> dict[str, Any]:
    """Return the first message that has these values."""
    while True:
        message: dict[str, Any] = json.loads(stream.recv(timeout=240.0))
        if wanted.items() <= message.items():
            return message


@pytest.mark.slow
def test_a_device_that_is_unplugged_comes_back_to_its_clients(tmp_path: Path) -> None:
    port = free_port()
    told = {"url": f"socket://127.0.0.1:{port}", "silent_after_s": 0.5}
    body = {"id": "bar", "title": "Bar", "source": {"kind": "serial", "settings": told}}
    with serving(tmp_path) as url, httpx.Client(base_url=f"{url}/api/v1", timeout=60.0) as api:
        absent = api.post("/devices", json=body)
        assert absent.status_code == 409, absent.text
        assert absent.json()["type"] == "/problems/device-not-connected"
        address = f"{url.replace('http', 'ws', 1)}/api/v1/stream?device_id=bar&encoding=json"
        with ExitStack() as first, ExitStack() as clients:
            first.enter_context(plugged_in(port))
            made = api.post("/devices", json=body | {"autostart": True})
            assert made.status_code == 201, made.text
            assert [sensor["pixels"] for sensor in made.json()["sensors"]] == [2048] * 4
            stream = clients.enter_context(connect(address, compression=None))
            until(stream, type="hello", state="stopped", link=None)
            started = api.post("/devices/bar/start").raise_for_status().json()
            assert (started["state"], started["link"]["state"]) == ("running", "connected")
            last = until(stream, type="frame")
            first.close()
            gone = until(stream, type="state", state="disconnected", link="disconnected")
            assert "trying again" in gone["reason"]
            status = api.get("/devices/bar/state").json()
            assert (status["state"], status["link"]["state"]) == ("disconnected", "disconnected")
            assert status["link"]["counters"]["frames_received"] == status["frames_received"] > 0
            with plugged_in(port):
                back = until(stream, type="state", state="running", link="connected")
                assert (back["reason"], len(back["sensors"])) == (None, 4)
                assert until(stream, type="frame")["sequence"] > last["sequence"]
                status = api.get("/devices/bar/state").json()
                assert status["link"]["counters"]["reconnects"] == 1
                assert status["link"]["counters"]["clock_restarts"] == 1
    # The server comes up while the device is away, and the device after it.
    with serving(tmp_path) as url, httpx.Client(base_url=f"{url}/api/v1", timeout=60.0) as api:
        status = api.get("/devices/bar/state").json()
        assert status["state"] == "disconnected"
        assert "refused" in status["reason"]
        captured = api.post("/devices/bar/stop").json()
        assert captured["state"] == "stopped"
        waiting = api.post("/devices/bar/start").raise_for_status().json()
        assert waiting["state"] == "disconnected"
        with plugged_in(port):
            end = time.monotonic() + 240.0
            while (now := api.get("/devices/bar/state").json())["state"] != "running":
                assert time.monotonic() < end, now
                time.sleep(0.05)
