"""A service in a process of its own that can be killed and started again."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx

START_S = 120.0


class ServiceProcess:
    """``lumiline serve`` over one data directory, at one port, as often as it is started."""

    def __init__(
        self, folder: Path, database_url: str | None = None, data_dir: Path | None = None,
        module: str = "service.cli", **settings: object,
    ) -> None:  # fmt: skip
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        self.folder = folder
        self._module = module
        self.data_dir = folder / "data" if data_dir is None else data_dir
        self.url = f"http://127.0.0.1:{self.port}"
        self._environment = {k: v for k, v in os.environ.items() if not k.startswith("LUMILINE_")}
        self._environment["LUMILINE_COMPUTE_DEVICE"] = "cpu"
        if database_url is not None:
            self._environment["LUMILINE_DATABASE_URL"] = database_url
        for name, value in settings.items():
            self._environment[f"LUMILINE_{name.upper()}"] = str(value)
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def process_id(self) -> int:
        """Of the operating system."""
        assert self._process is not None
        return self._process.pid

    @property
    def log(self) -> str:
        """All that it logged."""
        return (self.folder / "service.log").read_text()

    def start(self) -> None:
        """Start it and wait until it is ready."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / "service.log").open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", self._module, "serve",
                 "--port", str(self.port), "--data-dir", str(self.data_dir)],
                stdout=log, stderr=subprocess.STDOUT, env=self._environment,
            )  # fmt: skip
        end = time.monotonic() + START_S
        while time.monotonic() < end:
            assert self._process.poll() is None, self.log[-3000:]
            try:
                if httpx.get(f"{self.url}/readyz", timeout=5.0).status_code == 200:
                    return
            except httpx.TransportError:
                pass
            time.sleep(0.05)
        raise AssertionError(f"not ready: {self.log[-3000:]}")

    def kill(self) -> None:
        """End it as a power cut would."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def stop(self) -> None:
        """End it in order."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(240.0)
            except subprocess.TimeoutExpired:
                self.kill()
                raise
