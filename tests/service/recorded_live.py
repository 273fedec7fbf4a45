"""A live side that records its calls, and the test client, for tests of the REST side."""

import warnings
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hardware.driver import DeviceDescription, Driver
from service.errors import DeviceNotRunning
from service.holds.capture import ReferenceTap
from service.live.hold_board import HoldBoard
from service.live.hub import Hub
from service.live.in_force import NOTHING, InForce
from service.live.latency import LatencyCounts
from service.live.manager import Accept, LiveManager, any_device
from service.live.peak_finding import PeakFinding
from service.live.pose_board import PoseBoard
from service.live.pose_counts import ToolCounts
from service.live.processor import DeviceProcessor
from service.live.ring import FrameRing
from service.live.session import DeviceSession, DeviceStatus
from service.live.tap import Tap
from service.live.tracked import Tracked
from service.quality.point_tap import PointTap
from service.quality.watch_tap import WatchTap
from service.tools.marker_tap import MarkerTap
from service.tools.pose_tap import PoseTap
from service.tools.tip_tap import TipTap

if TYPE_CHECKING:
    from service.live.batch import FrameBatch

with warnings.catch_warnings():
    # Starlette asks for httpx2 in place of httpx; both work, and the service itself uses httpx.
    warnings.simplefilter("ignore")
    from starlette import testclient
    from starlette.testclient import WebSocketDenialResponse

__all__ = ["RecordedLive", "TestClient", "WebSocketDenialResponse"]


class TestClient(testclient.TestClient):
    """A client on the server's own machine, as a server on loopback has them."""

    __test__ = False

    def __init__(self, app: Any, **options: Any) -> None:
        defaults = {"base_url": "http://localhost", "client": ("127.0.0.1", 50000)}
        super().__init__(app, **(defaults | options))

    def websocket_connect(self, url: str, *others: Any, **options: Any) -> Any:
        host = str(self.base_url).replace("http", "ws", 1).rstrip("/")
        return super().websocket_connect(f"{host}{url}", *others, **options)


class _Processor(DeviceProcessor):
    """Processes nothing."""

    def __init__(self) -> None:
        self._finding = PeakFinding.__new__(PeakFinding)
        self._finding.method = self._finding.error_px = None
        self._finding.unfitted_error_px = 0.0


class _Running(DeviceSession):
    """Runs, and no frame ever comes."""

    @property
    def drained(self) -> bool:
        return False

    @property
    def connected(self) -> bool:
        return True


class RecordedLive(LiveManager):
    """Takes the live pipeline's calls, opens drivers, and runs nothing."""

    def __init__(self) -> None:
        self.hub = Hub()
        self.calls: list[tuple[Any, ...]] = []
        self.states: dict[str, DeviceStatus] = {}
        self.seen_px = np.full(4, 1000.0)
        self.in_force: dict[str, InForce] = {}
        self.poses = PoseBoard()
        self.holds = HoldBoard(partial(self.hub.publish, content="holds"))
        self.tracked: dict[str, Tracked] = {}
        self.answers = True
        self.busy = 0.0
        self.records: DeviceDescription | None = None
        """What devices are that can be recorded, of which no frame ever comes; None: none can."""
        self.batches: list[FrameBatch] = []
        """What quality checks see of them."""

    @property
    def ready(self) -> bool:
        return self.answers

    @property
    def busy_s(self) -> float:
        return self.busy

    def latencies(self) -> dict[str, LatencyCounts]:
        return {}

    def statuses(self) -> dict[str, DeviceStatus]:
        return dict(self.states)

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        found: InForce = NOTHING,
        accept: Accept = any_device,
    ) -> DeviceDescription:
        driver.open()
        try:
            description = driver.description
            accept(description)
        finally:
            driver.close()
        self.in_force[device_id] = found
        self.calls.append(("start", device_id, found.calibration_id, found.calibration))
        self.states[device_id] = DeviceStatus("running", calibration_id=found.calibration_id)
        return description

    def stop_device(self, device_id: str) -> None:
        self.calls.append(("stop", device_id))
        if device_id in self.states:
            self.states[device_id] = DeviceStatus("stopped")

    def forget_device(self, device_id: str) -> None:
        self.calls.append(("forget", device_id))
        self.states.pop(device_id, None)
        self.holds.forget(device_id)

    def set_calibration(self, device_id: str, found: InForce) -> None:
        self.calls.append(("calibration", device_id, found.calibration_id, found.calibration))
        self.in_force[device_id] = found

    def set_tracked(self, device_id: str, tracked: Tracked) -> None:
        self.tracked[device_id] = tracked
        self.holds.set(device_id, tracked.holds)

    def pose_counts(self) -> dict[str, dict[str, ToolCounts]]:
        return {}

    def status(self, device_id: str) -> DeviceStatus:
        return self.states.get(device_id, DeviceStatus("stopped"))

    def describe(self, device_id: str) -> DeviceDescription | None:
        return None

    def collect(
        self, device_id: str, frames: int, marker: int | None, timeout_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if self.status(device_id).state != "running":
            raise DeviceNotRunning(f'device "{device_id}" does not run')
        self.calls.append(("collect", device_id, frames, marker))
        noise = np.random.default_rng(1).normal(0.0, 0.05, (frames, 4))
        return self.seen_px + noise, np.full((frames, 4), 0.05)

    def session(self, device_id: str) -> DeviceSession:
        if self.records is None:
            raise DeviceNotRunning(f'device "{device_id}" does not run')
        return _Running(device_id, self.records, _Processor(), FrameRing(1, int), self.hub)

    def attach(self, session: DeviceSession, tap: Tap) -> None:
        self.calls.append(("attach", session.device_id))
        if isinstance(tap, PointTap | WatchTap | PoseTap | ReferenceTap | MarkerTap | TipTap):
            for batch in self.batches:
                tap.offer(batch)

    def detach(self, session: DeviceSession, tap: Tap) -> None:
        self.calls.append(("detach", session.device_id))

    def close(self) -> None:
        self.calls.append(("close",))
