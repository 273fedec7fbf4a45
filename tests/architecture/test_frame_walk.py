"""One frame, from a driver's LineFrame to the bytes of a message: the modules that run."""

import asyncio
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

import pytest

from compute.pose.beam_hold import BeamHoldLimits, BeamHoldTiming
from compute.transform import Transform
from hardware.line_frame import LineFrame
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.pipeline import bad_pixel_watch, stage_latency
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.pipeline_manager import PipelineManager
from service.pipeline.tracking_config import (
    NO_TRACKING,
    BeamHoldConfig,
    HoldReference,
    TrackingConfig,
    WatchedTool,
)
from service.protocols.stream import router
from service.protocols.stream.hub import Hub
from service.protocols.stream.query import parse_stream_request
from tests.architecture.walks import differences, listed, tracing
from tests.service.pipeline.test_tools_live import SCENE, exact, tools

if TYPE_CHECKING:
    from fastapi import WebSocket

    from hardware.driver import DeviceDescription

Illumination = Literal["strobed", "simultaneous"]
EVERYTHING = "points,tracks,tools,holds"
TRACED_FRAMES = 10
WARM_UP_FRAMES = 150
"""After which all tracks are confirmed and all tools found: the frames behind are plain ones."""


class PacedSource:
    """Simulated frames, made before, that leave the driver one at a time when told to."""

    lossless = False

    def __init__(self, settings: SimulationSettings) -> None:
        driver = SimulatedDriver("sim", settings)
        driver.open()
        self.description: DeviceDescription = driver.description
        self._frames = list(driver.frames())
        self._allowed = threading.Semaphore(0)
        self._closed = False

    def open(self) -> None: ...

    def close(self) -> None:
        self._closed = True
        self._allowed.release()

    def release(self) -> None:
        self._allowed.release()

    def frames(self) -> Iterator[LineFrame]:
        for frame in self._frames:
            self._allowed.acquire()
            if self._closed:
                return
            yield replace(frame, exposure_host_ns=time.time_ns())


class Socket:
    """The sending half of a websocket."""

    scope: ClassVar[dict[str, Any]] = {}

    def __init__(self) -> None:
        self.sent: asyncio.Queue[bytes | str] = asyncio.Queue()

    async def send_bytes(self, payload: bytes) -> None:
        self.sent.put_nowait(payload)

    async def send_text(self, payload: str) -> None:
        self.sent.put_nowait(payload)


async def walk(
    illumination: Illumination, content: str, tracked: TrackingConfig, **settings: Any
) -> tuple[set[str], str]:
    """Return the modules that plain frames run through, and the last message."""
    frames = WARM_UP_FRAMES + TRACED_FRAMES
    source = PacedSource(
        SimulationSettings(
            illumination=illumination, duration_s=(frames + 1) * 1e-3, realtime=False, **settings
        )
    )
    hub, socket = Hub(), Socket()
    with tracing() as trace:
        live = PipelineManager(hub, "cpu")
        try:
            live.set_tracking_config("sim", tracked)
            live.start_device("sim", source, ActiveCalibration("nominal", exact()))
            query = {"device_id": "sim", "content": content, "encoding": "json"}
            subscription = hub.subscribe(parse_stream_request(query))
            sender = asyncio.create_task(router._forward(cast("WebSocket", socket), subscription))
            last: bytes | str = ""
            for number in range(frames):
                trace.on = number >= WARM_UP_FRAMES
                source.release()
                last = await asyncio.wait_for(socket.sent.get(), 60.0)
                while '"type":"frame"' not in str(last):  # a change of a hold
                    last = await asyncio.wait_for(socket.sent.get(), 60.0)
            trace.on = False
            sender.cancel()
        finally:
            live.close()
    return trace.modules, str(last)


def config(illumination: Illumination) -> TrackingConfig:
    """Two tools, the tracks of their markers, and a hold of the first that is not held."""
    rotation, origin = SCENE.pose(0, 0.0)
    hold = BeamHoldConfig(
        "watch",
        "sim",
        "key",
        WatchedTool("pointer"),
        BeamHoldLimits(shift_mm=1000.0, rules=BeamHoldTiming(10**10, 0)),
        HoldReference("first", datetime.now(UTC), "nominal", None, Transform(rotation, origin)),
    )
    return TrackingConfig(True, tools(illumination), holds=(hold,))


@pytest.mark.parametrize(
    ("illumination", "content", "headings", "most"),
    [
        ("strobed", "points", ["Points"], 12),
        ("simultaneous", "points", ["Points", "Points of markers that are lit together"], 14),
        ("strobed", EVERYTHING, ["Points", "Tracks, tools and holds"], 32),
    ],
)
def test_walk_of_a_frame_runs_the_modules_of_the_table(
    illumination: Illumination,
    content: str,
    headings: list[str],
    most: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Twenty frames of a second are also looked through for bad pixels: no plain ones.
    monkeypatch.setattr(bad_pixel_watch, "SAMPLE_INTERVAL_S", float("inf"))
    # One frame a second is timed; here the first one, while nothing is traced yet.
    monkeypatch.setattr(stage_latency, "INTERVAL_S", 1e9)
    if content == "points":
        ran, last = asyncio.run(walk(illumination, content, NO_TRACKING))
        assert '"points":[{' in last
    else:
        ran, last = asyncio.run(walk(illumination, content, config(illumination), scene=SCENE))
        assert '"tracks":[{' in last
        assert last.count('"status":"OK"') == 2
        assert '"holds":[{"hold_id":"watch","held":false' in last
    table = [name for heading in headings for name in listed(heading)]
    assert not differences(ran, table)
    assert len(ran) <= most
