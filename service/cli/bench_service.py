"""Common parts of the benchmarks that run a service."""

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from lumiline.client import Client
from service.cli.output import fail, print_json, progress
from service.cli.server_session import client_session
from service.cli.service_process import RunningService, service_process, simulated_device

if TYPE_CHECKING:
    from benchmarks.live import LiveFigures

DEVICE: Final = "sim"
MARKERS_MM: Final = ((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (20.0, 15.0, 40.0))
"""Four strobed markers of a tool."""
BASELINE_SECONDS: Final = 10.0

Figures = dict[str, Any]


def run_benchmark(
    measure: Callable[[Path], Figures], show: Callable[[Figures], None], *, as_json: bool
) -> None:
    """Measure in a folder that is removed afterwards, and print the figures."""
    with _ended_by_sigterm(), tempfile.TemporaryDirectory() as folder:
        try:
            figures = measure(Path(folder))
        except RuntimeError as error:
            raise fail(str(error)) from error
    if as_json:
        print_json(figures)
    else:
        show(figures)


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """Let SIGTERM end a benchmark as Ctrl+C does: with the processes that it has started."""
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def service_of_simulated_device(
    folder: Path,
    rate_hz: float,
    cycle: int,
    scene: Mapping[str, Any] | None = None,
    settings: Mapping[str, str] | None = None,
    *,
    quiet: bool,
) -> Iterator[tuple[RunningService, Client]]:
    """Run a service that reads a simulated device over a socket; the device is not started yet.

    Args:
        folder: for the data and logs of both.
        rate_hz: exposures per second.
        cycle: number of exposures that are rendered beforehand, and repeat.
        scene: what the device sees; None: the rotating bar.
        settings: of the service.
        quiet: show no progress.
    """
    scene_member = {} if scene is None else {"scene": scene}
    with ExitStack() as stack:
        source = stack.enter_context(simulated_device(folder, rate_hz, cycle, scene_member))
        service = stack.enter_context(service_process(folder / "service", settings, quiet=quiet))
        client = stack.enter_context(client_session(service.url, None, 60.0))
        client.stop_device(DEVICE)
        client.request("PATCH", f"/api/v1/devices/{DEVICE}", body={"source": source})
        yield service, client


def run_client(module: str, *arguments: str) -> Any:
    """Run a client in a process of its own, and return what it prints as JSON.

    Raises:
        RuntimeError: it failed.
    """
    done = subprocess.run(  # noqa: S603 - our own module
        [sys.executable, "-m", module, *arguments], stdout=subprocess.PIPE, check=False
    )
    if done.returncode != 0:
        raise RuntimeError(f"the client {module} failed; see above")
    return json.loads(done.stdout)


def device_counts(client: Client) -> dict[str, Any]:
    """Return the device's state and its counts of frames."""
    return client.device_state(DEVICE).model_dump()


def losses(before: dict[str, Any], after: dict[str, Any]) -> dict[str, int]:
    """Return the frames that were lost, and those in which nothing was tracked."""
    lost = ("frames_lost", "frames_dropped_compute")
    return {
        "frames_lost": sum(after[name] - before[name] for name in lost),
        "frames_not_tracked": after["frames_not_tracked"] - before["frames_not_tracked"],
    }


def wait_for_frames(client: Client, frames: int, timeout_s: float = 120.0) -> None:
    """Wait until this many frames are processed; raises RuntimeError."""
    end = time.monotonic() + timeout_s
    while (counts := device_counts(client))["frames_processed"] < frames:
        if time.monotonic() > end:
            raise RuntimeError(f"too few frames come: {counts}")
        time.sleep(0.1)


def measure_baseline_stream(*, quiet: bool) -> "LiveFigures":
    """Return the figures of a bare websocket server."""
    from benchmarks.baseline_stream import running_baseline_stream
    from benchmarks.live import measure

    with (
        progress("a bare server beside it", BASELINE_SECONDS, quiet=quiet) as report,
        running_baseline_stream() as url,
    ):
        return measure(url, BASELINE_SECONDS, report)
