"""Common parts of the benchmarks that run a service: calibration target and requests."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import httpx

from service.cli.output import fail, print_json

DEVICE: Final = "sim"

Figures = dict[str, Any]


def run_benchmark(
    measure: Callable[[Path], Figures], show: Callable[[Figures], None], *, as_json: bool
) -> None:
    """Measure in a folder that is removed afterwards, and print the figures."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            figures = measure(Path(folder))
        except RuntimeError as error:
            raise fail(str(error)) from error
    if as_json:
        print_json(figures)
        return
    show(figures)


def answer(response: httpx.Response) -> Any:
    """Return what the service answered; raises RuntimeError for a refusal."""
    if not response.is_success:
        raise RuntimeError(f"{response.request.url.path}: {response.text}")
    return response.json()


def device_status(client: httpx.Client) -> dict[str, Any]:
    """Return how the device stands."""
    found: dict[str, Any] = answer(client.get(f"/api/v1/devices/{DEVICE}/status"))["status"]
    return found


def read_device(client: httpx.Client, source: dict[str, Any]) -> None:
    """Let the service read another device from now on; it is started by itself."""
    answer(client.post(f"/api/v1/devices/{DEVICE}/stop"))
    answer(client.patch(f"/api/v1/devices/{DEVICE}", json={"source": source}))


def wait_for_frames(client: httpx.Client, frames: int, timeout_s: float = 120.0) -> None:
    """Wait until this many frames are processed; raises RuntimeError."""
    end = time.monotonic() + timeout_s
    while device_status(client)["frames_processed"] < frames:
        if time.monotonic() > end:
            raise RuntimeError(f"too few frames come: {device_status(client)}")
        time.sleep(0.1)
