"""A simulated device on a TCP port with injected transmission faults."""

import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from hardware.serial.settings import SerialSettings
from hardware.serial.simulated_device import SimulatedSerialDevice
from hardware.simulated.settings import SimulationSettings


class BenchDevice:
    """Plugged in and out, silenced, garbled, halved, and switched off and on by the test."""

    def __init__(self, rate_hz: float = 500.0, **changes: Any) -> None:
        self.settings = SimulationSettings(frame_rate_hz=rate_hz)
        self.changes = {"rendered": 8, **changes}
        self.line: Callable[[bytes], bytes] = lambda data: data
        self.described: Callable[[Any], Any] | None = None
        self.hosts = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._listener.settimeout(0.01)
        self._plugged = threading.Event()
        self._plugged.set()
        self._ended = threading.Event()
        self.device = self._made()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"socket://127.0.0.1:{self.port}"

    def status(self, **changes: Any) -> SerialSettings:
        return SerialSettings(self.url, silent_after_s=0.1, **changes)

    def unplug(self) -> None:
        self._plugged.clear()

    def plug(self) -> None:
        self._plugged.set()

    def switch_off_and_on(self) -> None:
        """As a reset button does: the port stays, and the device begins anew."""
        self.device = self._made()

    def end(self) -> None:
        self._ended.set()
        self._thread.join()
        self._listener.close()

    def _made(self) -> SimulatedSerialDevice:
        device = SimulatedSerialDevice(self.settings, time.monotonic_ns(), **self.changes)
        if self.described is not None:
            said = self.described(device.description())
            device.description = lambda: said  # type: ignore[method-assign]
        return device

    def _run(self) -> None:
        while not self._ended.is_set():
            if not self._plugged.wait(0.01):
                self._drop_waiting()
                continue
            with suppress(TimeoutError):
                host, _ = self._listener.accept()
                self.hosts += 1
                with host, suppress(OSError):
                    self._serve(host)

    def _drop_waiting(self) -> None:
        """The port is not there: who knocks is turned away."""
        with suppress(TimeoutError):
            self._listener.accept()[0].close()

    def _serve(self, host: socket.socket) -> None:
        host.settimeout(0.5)
        device = None
        while self._plugged.is_set() and not self._ended.is_set():
            if device is not None and device is not self.device:
                host.sendall(self.device.boot())
            device = self.device
            host.setblocking(False)
            data = b""
            with suppress(BlockingIOError):
                data = host.recv(65536)
                if not data:
                    return
            host.settimeout(0.5)
            out = device.receive(data, time.monotonic_ns())
            out += b"".join(device.send(time.monotonic_ns()))
            if out:
                host.sendall(self.line(out))
            time.sleep(0.001)


@contextmanager
def bench_device(rate_hz: float = 500.0, **changes: Any) -> Iterator[BenchDevice]:
    device = BenchDevice(rate_hz, **changes)
    try:
        yield device
    finally:
        device.end()


def silent(_: bytes) -> bytes:
    return b""


def garbage(data: bytes) -> bytes:
    return random.Random(len(data)).randbytes(len(data))


def halves(data: bytes) -> bytes:
    """Half of every message, and its end lost."""
    return b"\0".join(one[: len(one) // 2] for one in data.split(b"\0"))


def every_third(data: bytes) -> bytes:
    """Every third message damaged."""
    parts = data.split(b"\0")
    for index in range(0, len(parts) - 1, 3):
        middle = len(parts[index]) // 2
        parts[index] = parts[index][:middle] + b"\x7f\x7f" + parts[index][middle + 1 :]
    return b"\0".join(parts)
