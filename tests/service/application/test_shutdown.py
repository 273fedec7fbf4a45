"""The end of a real server: streams, runs and the database at SIGTERM, and a second signal."""

import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import httpx
import numpy as np
import pytest
import uvicorn
from fastapi import FastAPI
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from service.api.runs.examples import simulated_points
from service.api.tools.concurrency_limits import MAX_CONCURRENT
from service.api.tools.examples import NEW_TOOLS
from service.application.shutdown import ShutdownServer
from tests.hardware.recording.blocks import read_recording

# As `lumiline serve`; tells on its output that it came to its end.
PROGRAM = """
import signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored where the tests run under nohup
from service.cli.serve import load_settings, server_options
from service.application.shutdown import run_server
from service.logs import configured_logging
from service.application.app import create_app
settings = load_settings(port=int(sys.argv[1]), data_dir=sys.argv[2], compute_device="cpu")
with configured_logging(settings):
    app = create_app(settings)
    run_server(app, server_options(settings))
print("after", flush=True)
"""
START_S = 120.0
END_S = 60.0


@contextmanager
def server(folder: Path) -> Iterator[tuple["subprocess.Popen[str]", int]]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("LUMILINE_")}
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(port), str(folder)],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        end = time.monotonic() + START_S
        while True:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < end
            try:
                if httpx.get(f"http://127.0.0.1:{port}/readyz").status_code == 200:
                    break
            except httpx.TransportError:
                time.sleep(0.05)
        yield process, port
    finally:
        process.kill()
        process.communicate()


def _drain(stream: ClientConnection) -> NoReturn:
    while True:
        stream.recv()


def _begin_run(api: str) -> None:
    """Post a run of a minute and more; return as soon as its process was started."""
    axis = np.linspace(-80.0, 80.0, 9)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    body = {
        "device_id": "sim", "calibration_id": "sim-nominal", "points": simulated_points(grid),
    }  # fmt: skip
    run = httpx.post(f"{api}/runs/mapping", json=body, timeout=END_S).json()["id"]
    end = time.monotonic() + END_S
    while httpx.get(f"{api}/runs/{run}", timeout=END_S).json()["state"] == "queued":
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.slow
def test_a_server_that_is_told_to_stop(tmp_path: Path):
    with server(tmp_path) as (process, port):
        url = f"ws://127.0.0.1:{port}/api/v1/stream?device_id=sim"
        recording = httpx.post(
            f"http://127.0.0.1:{port}/api/v1/devices/sim/recordings", json={"id": "a.h5"}
        )
        assert recording.status_code == 201, recording.text
        # First the run, which a slow machine begins late: a client that does not read meanwhile
        # answers no ping.
        _begin_run(f"http://127.0.0.1:{port}/api/v1")
        with (
            connect(url, compression=None) as stream,
            socket.create_connection(("127.0.0.1", port)) as stalled,
        ):
            # A client that takes nothing must not hold the end up.
            stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            stalled.sendall(
                f"GET /api/v1/stream?device_id=sim HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n"
                "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
            )
            for _ in range(800):
                stream.recv()
            process.send_signal(signal.SIGTERM)
            with pytest.raises(ConnectionClosed) as caught:
                _drain(stream)
            assert caught.value.rcvd is not None
            assert caught.value.rcvd.code == 1001
            assert caught.value.rcvd.reason == "the server is stopping"
            output, log = process.communicate(timeout=END_S)
    assert (process.returncode, output) == (0, "after\n"), log
    assert "SIGTERM: stopping" in log
    assert "ERROR" not in log
    assert "Traceback" not in log
    # Nothing is left of SQLite's write-ahead log: the database was closed.
    assert sorted(p.name for p in tmp_path.glob("*.sqlite3*")) == ["lumiline.sqlite3"]
    with sqlite3.connect(tmp_path / "lumiline.sqlite3") as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert database.execute("SELECT state FROM runs").fetchall() == [("interrupted",)]
    database.close()
    assert read_recording(tmp_path / "recordings" / "a.h5").complete


@pytest.mark.slow
def test_calibrations_of_tools_that_wait_when_it_is_told(tmp_path: Path):
    """As many wait as may, which the answer to one more shows; each is answered at the end."""
    body = NEW_TOOLS["pointer"]["value"]

    def pivot(api: str) -> httpx.Response:
        path = f"{api}/tools/{body['id']}/pivot-calibrations"
        return httpx.post(path, json={"duration_s": 120}, timeout=END_S)

    with (
        server(tmp_path) as (process, port),
        ThreadPoolExecutor(MAX_CONCURRENT + 1) as clients,
    ):
        api = f"http://127.0.0.1:{port}/api/v1"
        assert httpx.post(f"{api}/tools", json=body).status_code == 201
        asked = [clients.submit(pivot, api) for _ in range(MAX_CONCURRENT + 1)]
        (refused, *others), waiting = wait(asked, END_S, FIRST_COMPLETED)
        assert not others
        assert refused.result().json()["type"] == "/problems/busy"
        assert httpx.get(f"{api}/tools").status_code == 200
        process.send_signal(signal.SIGTERM)
        for answer in (one.result() for one in waiting):
            assert answer.status_code == 503
            assert answer.json()["type"] == "/problems/not-ready"
            assert "the server is stopping" in answer.json()["detail"]
        output, log = process.communicate(timeout=END_S)
    assert (process.returncode, output) == (0, "after\n"), log
    assert "ERROR" not in log
    assert "Traceback" not in log


@pytest.mark.slow
def test_a_second_signal_ends_it_at_once(tmp_path: Path):
    with (
        server(tmp_path) as (process, port),
        socket.create_connection(("127.0.0.1", port)) as waiting,
    ):
        # A request of which the body never comes holds the first for seconds.
        waiting.sendall(
            f"POST /api/v1/devices HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n"
            "Content-Type: application/json\r\nContent-Length: 10\r\n\r\n".encode()
        )
        time.sleep(0.3)
        process.send_signal(signal.SIGTERM)
        time.sleep(0.3)
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=END_S)
    assert (process.returncode, output) == (-signal.SIGTERM, "")


@pytest.mark.slow
def test_server_at_sighup_closes_as_at_sigterm(tmp_path: Path):
    with server(tmp_path) as (process, _):
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGHUP)  # a terminal that closes sends more than one
        output, log = process.communicate(timeout=END_S)
    assert (process.returncode, output) == (0, "after\n"), log
    assert "SIGHUP: stopping" in log
    assert sorted(p.name for p in tmp_path.glob("*.sqlite3*")) == ["lumiline.sqlite3"]


@pytest.mark.parametrize("ignored", [False, True])
def test_sighup_that_is_ignored_stays_so(ignored: bool):
    app = FastAPI()
    stopping = ShutdownServer(uvicorn.Config(app), app)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    try:
        with stopping.capture_signals():
            found = signal.getsignal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert found == (signal.SIG_IGN if ignored else stopping.handle_exit)
