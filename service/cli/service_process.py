"""Runs the service in a separate process for commands that act as its client."""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from service.cli.output import progress

START_TIMEOUT_S = 180.0
"""The first start on a machine compiles the kernels."""


@dataclass(frozen=True)
class RunningService:
    """A service that runs: where it answers, and its process."""

    url: str
    pid: int

    @property
    def stream_url(self) -> str:
        """Address of its stream, without a query."""
        return f"{self.url.replace('http', 'ws', 1)}/api/v1/stream"


@contextmanager
def service_process(
    data_dir: Path,
    settings: Mapping[str, str] | None = None,
    *,
    port: int | None = None,
    doing: str = "starting the service",
    quiet: bool = False,
) -> Iterator[RunningService]:
    """Run ``lumiline serve``; ends it afterwards.

    Args:
        data_dir: its data directory, which also gets its log, ``service.log``.
        settings: further settings by name.
        port: where it listens; None: on a free port.
        doing: shown until it is ready.
        quiet: show nothing.
    """
    data_dir.mkdir(parents=True, exist_ok=True)
    log_path = data_dir / "service.log"
    port = free_port() if port is None else port
    # The embedded default, whatever this user's environment says of another database.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("LUMILINE_")}
    environment |= {f"LUMILINE_{k.upper()}": v for k, v in (settings or {}).items()}
    command = ["serve", "--port", str(port), "--data-dir", str(data_dir)]
    with _own_process(command, log_path, environment) as process:
        url = f"http://127.0.0.1:{port}"
        with progress(doing, quiet=quiet):
            _wait_until_ready(process, url, log_path)
        yield RunningService(url, process.pid)


@contextmanager
def simulated_device(
    folder: Path, rate_hz: float, cycle: int, settings: Mapping[str, Any] | None = None
) -> Iterator[dict[str, Any]]:
    """Run a device in a process of its own, and yield the source that reads it over a socket.

    Args:
        folder: gets its log and its settings.
        rate_hz: exposures a second.
        cycle: how many of them are rendered beforehand, and repeat.
        settings: as of ``SimulationSettings``.
    """
    port = free_port()
    device_file = folder / "device.json"
    device_file.write_text(json.dumps(settings or {}), encoding="utf-8")
    command = [
        "simulate-serial", "--listen", f"127.0.0.1:{port}", "--rate-hz", str(rate_hz),
        "--cycle", str(cycle), "--simulation", str(device_file), "--json",
    ]  # fmt: skip
    with _own_process(command, folder / "device.log"):
        yield {"kind": "serial", "settings": {"url": f"socket://127.0.0.1:{port}"}}


@contextmanager
def _own_process(
    command: list[str], log_path: Path, environment: Mapping[str, str] | None = None
) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a command of this command line, whose output goes to a file; ends it afterwards."""
    with log_path.open("wb") as log:
        process = subprocess.Popen(  # noqa: S603 - our own command line
            [sys.executable, "-m", "service.cli", *command],
            stdout=log, stderr=subprocess.STDOUT, env=environment,
        )  # fmt: skip
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(20.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def free_port() -> int:
    """Return a port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_until_ready(process: "subprocess.Popen[bytes]", url: str, log_path: Path) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            break
        try:
            if httpx.get(f"{url}/readyz", timeout=2.0).status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    tail = "\n".join(log_path.read_text(encoding="utf-8").splitlines()[-15:])
    raise RuntimeError(f"the service did not become ready; the end of {log_path}:\n{tail}")
