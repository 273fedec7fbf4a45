"""A live side that records its calls, and the test client, for tests of the REST side."""

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from compute.signal.sensor_noise import SensorNoise
from hardware.driver import DeviceDescription, Driver
from service.api.beam_holds.reference_capture import ReferenceTap
from service.api.line_scans.live_scans import ScanTap
from service.api.quality.interval_statistics_tap import IntervalStatisticsTap
from service.api.quality.point_tap import PointTap
from service.api.radiometric_calibrations.frame_tap import FrameTap
from service.api.tools.marker_tap import MarkerTap
from service.api.tools.pose_taps import PoseTap, TipTap
from service.api.wave_captures.exposure_tap import ExposureTap
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.beam_hold_registry import BeamHoldRegistry
from service.pipeline.detection_stage import DetectionStage, SearchModel
from service.pipeline.device_session import DeviceSession, ToolCounts
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import LatestPoses
from service.pipeline.frame_processor import FrameProcessor
from service.pipeline.interface import Accept, any_device
from service.pipeline.pipeline_manager import PipelineManager
from service.pipeline.stage_latency import Stage
from service.pipeline.taps import Tap
from service.pipeline.threads import FrameRing
from service.pipeline.tracking_config import TrackingConfig
from service.problems.errors import DeviceNotRunning
from service.protocols.stream.hub import Hub

if TYPE_CHECKING:
    from service.pipeline.frame_batch import FrameBatch

with warnings.catch_warnings():
    # Starlette asks for httpx2 in place of httpx; both work, and the service itself uses httpx.
    warnings.simplefilter("ignore")
    from starlette import testclient
    from starlette.testclient import WebSocketDenialResponse

__all__ = ["FakePipeline", "TestClient", "WebSocketDenialResponse"]


class TestClient(testclient.TestClient):
    """A client on the server's own machine, as a server on loopback has them."""

    __test__ = False

    def __init__(self, app: Any, **options: Any) -> None:
        defaults = {"base_url": "http://localhost", "client": ("127.0.0.1", 50000)}
        super().__init__(app, **(defaults | options))

    def request(self, method: str, url: Any, **options: Any) -> Any:
        """Send a request; a change that names no ETag is made whatever the resource is.

        An If-Match of None is left out.
        """
        if method.upper() in ("PATCH", "PUT"):
            headers = {"if-match": "*"} | {
                name.lower(): value for name, value in dict(options.get("headers") or {}).items()
            }
            options["headers"] = {k: value for k, value in headers.items() if value is not None}
        return super().request(method, url, **options)

    def websocket_connect(self, url: str, *others: Any, **options: Any) -> Any:
        host = str(self.base_url).replace("http", "ws", 1).rstrip("/")
        return super().websocket_connect(f"{host}{url}", *others, **options)


class _Processor(FrameProcessor):
    """Processes nothing."""

    def __init__(self) -> None:
        self.detection = DetectionStage.__new__(DetectionStage)
        self.detection.method = self.detection.error_px = None
        self.detection.unfitted_error_px = 0.0
        self.detection.search_model = SearchModel(SensorNoise.of([12.0] * 4, 30.0))
        self.active_calibration = NO_ACTIVE_CALIBRATION


class _Running(DeviceSession):
    """Runs, and no frame ever comes."""

    pipeline: "FakePipeline"

    @property
    def drained(self) -> bool:
        return False

    def attach(self, tap: Tap, *, sampled: bool = False) -> None:
        self.pipeline.attach(self, tap)

    def detach(self, tap: Tap) -> None:
        self.pipeline.detach(self, tap)

    @property
    def connected(self) -> bool:
        return True


class FakePipeline(PipelineManager):
    """Takes the live pipeline's calls, opens drivers, and runs nothing."""

    def __init__(self) -> None:
        self.streams = Hub()
        self.calls: list[tuple[Any, ...]] = []
        self.states: dict[str, DeviceStatus] = {}
        self.seen_px = np.full(4, 1000.0)
        self.in_force: dict[str, ActiveCalibration] = {}
        self.poses = LatestPoses()
        self.holds = BeamHoldRegistry(self.streams.publish_hold)
        self.tracked: dict[str, TrackingConfig] = {}
        self.answers = True
        self.busy = 0.0
        self.records: DeviceDescription | None = None
        """What devices are that can be recorded, of which no frame ever comes; None: none can."""
        self.active = NO_ACTIVE_CALIBRATION
        """What they process frames with."""
        self.batches: list[FrameBatch] = []
        """What quality checks see of them."""

    @property
    def ready(self) -> bool:
        return self.answers

    @property
    def busy_s(self) -> float:
        return self.busy

    def stage_latencies(self) -> dict[str, tuple[int, dict[Stage, float]]]:
        return {}

    def latencies(self) -> dict[str, tuple[tuple[int, ...], float]]:
        return {}

    def statuses(self) -> dict[str, DeviceStatus]:
        return dict(self.states)

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        found: ActiveCalibration = NO_ACTIVE_CALIBRATION,
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

    def set_calibration(self, device_id: str, found: ActiveCalibration) -> None:
        self.calls.append(("calibration", device_id, found.calibration_id, found.calibration))
        self.in_force[device_id] = found

    def set_tracking_config(self, device_id: str, tracked: TrackingConfig) -> None:
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
        processor = _Processor()
        processor.active_calibration = self.active
        running = _Running(device_id, self.records, processor, FrameRing(1), self.streams)
        running.pipeline = self
        return running

    def attach(self, session: DeviceSession, tap: Tap) -> None:
        self.calls.append(("attach", session.device_id))
        if isinstance(
            tap,
            PointTap
            | IntervalStatisticsTap
            | PoseTap
            | ReferenceTap
            | MarkerTap
            | TipTap
            | FrameTap
            | ExposureTap,
        ):
            for batch in self.batches:
                tap.offer(batch)

        if isinstance(tap, ScanTap):
            dark = np.zeros((4, 64), np.uint16)  # frames of others have hardly any pixels
            for batch in self.batches:
                frames = tuple(replace(frame, lines=dark) for frame in batch.frames)
                tap.offer(replace(batch, frames=frames))

    def detach(self, session: DeviceSession, tap: Tap) -> None:
        self.calls.append(("detach", session.device_id))

    def close(self) -> None:
        self.calls.append(("close",))
