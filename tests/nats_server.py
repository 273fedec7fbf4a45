"""A NATS server of a test's own, on a free port of this machine."""

import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path

import pytest


def free_port() -> int:
    """Return a port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class NatsServer:
    """Starts, ends and cuts off ``nats-server``; always on the same port.

    Args:
        folder: gets its configuration and its log.
        configuration: lines beside the address.
        host: address that it listens on.
        environment: variables that its configuration names.
        before: words before the command, such as those of another network namespace.
    """

    def __init__(
        self,
        folder: Path,
        configuration: str = "",
        host: str = "127.0.0.1",
        environment: Mapping[str, str] | None = None,
        before: tuple[str, ...] = (),
    ) -> None:
        program = shutil.which("nats-server")
        if program is None:
            reason = "there is no nats-server; install the package of that name"
            if os.environ.get("LUMILINE_TEST_REQUIRE_NATS") == "1":
                pytest.fail(reason)
            pytest.skip(reason)
        self.port = free_port()
        self.url = f"nats://{host}:{self.port}"
        self.log = folder / "nats.log"
        self._file = folder / "nats.conf"
        self._file.write_text(f'listen: "{host}:{self.port}"\n{configuration}\n', encoding="utf-8")
        self._host = host
        self._environment = os.environ | dict(environment or {})
        self._command = [*before, program, "-c", str(self._file)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, and wait until it listens."""
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command, stdout=log, stderr=log, env=self._environment
            )
        end = time.monotonic() + 60.0
        while True:
            try:
                with socket.create_connection((self._host, self.port), 1.0):
                    return
            except OSError:
                assert self._process.poll() is None, self.log.read_text(encoding="utf-8")
                assert time.monotonic() < end, "nats-server did not start"
                time.sleep(0.02)

    def url_of(self, user: str, password: str) -> str:
        """Return the URL for a user."""
        return self.url.replace("//", f"//{user}:{password}@")

    def kill(self) -> None:
        """End it at once."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def freeze(self) -> None:
        """Let it do nothing, as if all its links were cut."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it go on."""
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)
