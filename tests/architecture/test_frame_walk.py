"""One frame, from a driver's LineFrame to the bytes of a message: the modules that run."""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
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
from service.pipeline.detection_stage import built_in_profile
from service.pipeline.interface import Pipeline
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
from service.station import process, remote_pipeline
from service.station.calls import Answer, Start
from service.station.process import Station
from service.station.remote_pipeline import RemotePipeline
from service.station.shared_ring import Doorbell, RingReader, RingWriter, new_ring
from service.station.station_starter import StationStarter
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


_SOURCES: dict[int, "PacedSource"] = {}


def _source(number: int) -> "PacedSource":
    return _SOURCES[number]


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
        _SOURCES[id(self)] = self

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a reference: the station of the test is in this process."""
        return _source, (id(self),)

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


class InProcessStation:
    """Takes the place of a station's process: the same, but for the process."""

    process_id = 0

    def __init__(self, _: StationStarter, start: Start, lost: object) -> None:
        self._memory = new_ring(1 << 24)
        self.doorbell = Doorbell()
        self.reader = RingReader(self._memory, from_begin=True)
        self._station = Station(RingWriter(self._memory), self.doorbell.write_descriptor, start)

    def call(self, method: str, *args: Any, **members: Any) -> Answer:
        result = getattr(self._station, method)(*args, **members)
        return Answer(0, result, None, self._station.head)

    def notify(self, method: str, *args: Any) -> None:
        self.call(method, *args)

    def close(self) -> None:
        self._station.close()

    def release(self) -> None:
        self.doorbell.close()


def own_pipeline(hub: Hub) -> Pipeline:
    """A pipeline in threads of this process."""
    return PipelineManager(hub, "cpu")


def pipeline_of_station(hub: Hub) -> Pipeline:
    """A pipeline behind a bus."""
    return RemotePipeline(hub, StationStarter(), "cpu", built_in_profile)


async def walk(
    illumination: Illumination,
    content: str,
    tracked: TrackingConfig,
    make_pipeline: Callable[[Hub], Pipeline] = own_pipeline,
    **settings: Any,
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
        live = make_pipeline(hub)
        try:
            await asyncio.to_thread(live.set_tracking_config, "sim", tracked)
            active = ActiveCalibration("nominal", exact())
            await asyncio.to_thread(live.start_device, "sim", source, active)
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
            await asyncio.to_thread(live.close)
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


@pytest.mark.parametrize("content", ["points", EVERYTHING])
def test_walk_through_a_station_has_the_modules_of_the_bus_in_addition(
    content: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bad_pixel_watch, "SAMPLE_INTERVAL_S", float("inf"))
    monkeypatch.setattr(stage_latency, "INTERVAL_S", 1e9)
    monkeypatch.setattr(remote_pipeline, "StationProcess", InProcessStation)
    # Figures of all devices come twice a second, from a thread that would be traced, too.
    monkeypatch.setattr(process, "FIGURES_S", 1e6)
    headings = ["Points", "Between station and gateway"]
    if content == "points":
        walked = walk("strobed", content, NO_TRACKING, pipeline_of_station)
    else:
        walked = walk("strobed", content, config("strobed"), pipeline_of_station, scene=SCENE)
        headings.append("Tracks, tools and holds")
    ran, _ = asyncio.run(walked)
    table = [name for heading in headings for name in listed(heading)]
    if content != "points":
        table.append("service.station.remote_holds")
    assert not differences(ran, table)
    assert len(ran) <= (17 if content == "points" else 38)
