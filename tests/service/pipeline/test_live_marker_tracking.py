"""Markers of a device tracked live: by each motion model, switched, streamed, exported."""

import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from compute.tracking.settings import MotionModel
from compute.tracking.track_batch import TrackBatch, TrackState
from hardware.recording.reader import RecordingReader
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import RotatingBar
from hardware.simulated.settings import SimulationSettings
from service.api.devices.tracking_settings import Tracking
from service.api.exports.from_recording import table_from_recording
from service.api.exports.table_builder import TableBuilder
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch, TrackingResult
from service.pipeline.frame_processor import FrameProcessor
from service.pipeline.tracking_config import TrackingConfig
from service.protocols.stream.messages import StreamBatch, encode
from tests.service.api.exports.test_from_stream_and_recording import (
    FRAMES,
    Taken,
    recording,
    same,
    taken,
)
from tests.service.cli.test_commands import here
from tests.service.pipeline.test_pipeline_manager import nominal
from tests.service.pipeline.test_tools_served import next_frame, sent
from tests.service.protocols.stream.test_stream import streaming

__all__ = ["taken"]

MODELS: tuple[MotionModel, ...] = ("velocity", "acceleration", "interacting")
BAR = RotatingBar()
SLOW = RotatingBar(period_s=6.0)
BEGUN = 8
"""Exposures until both markers are tracked, whatever the motion model."""


def tracked(motion_model: str) -> TrackingConfig:
    how = Tracking.model_validate({"motion": motion_model})
    return TrackingConfig(True, (), how.tracker(), how.tool_tracker())


def exposures(seconds: float, scene: RotatingBar) -> tuple[FrameProcessor, list[Any]]:
    settings = SimulationSettings(
        scene, frame_rate_hz=100.0, illumination="simultaneous", duration_s=seconds, realtime=False
    )
    driver = SimulatedDriver("sim", settings)
    driver.open()
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("c1", nominal()))
    return processor, list(driver.frames())


def motion(batch: FrameBatch) -> TrackingResult:
    assert batch.motion is not None
    return batch.motion


def ends_at(batches: Sequence[FrameBatch], scene: RotatingBar) -> list[dict[int, int]]:
    """Of each frame, at which end of the bar each track is; within 10 mm."""
    found = []
    for batch in batches:
        for index, frame in enumerate(batch.frames):
            own = motion(batch).track_owner == index
            own &= motion(batch).tracks.state != int(TrackState.TENTATIVE)
            ends = scene.points(frame.exposure_device_ns * 1e-9)
            tracks = motion(batch).tracks
            apart = np.linalg.norm(tracks.position_mm[own][:, None] - ends, axis=2)
            numbers = tracks.identity[own].tolist()
            found.append(
                {
                    number: int(row.argmin())
                    for number, row in zip(numbers, apart, strict=True)
                    if row.min() < 10.0
                }
            )
    return found


def bits(batches: Sequence[FrameBatch]) -> list[bytes]:
    """All that was found, of all frames, whatever the batches."""
    return [
        np.concatenate([getattr(motion(batch).tracks, field.name) for batch in batches]).tobytes()
        for field in fields(TrackBatch)
    ]


def refuse(constant: str) -> NoReturn:
    raise AssertionError(f"{constant} in a message")


def followed(motion_model: str, seconds: float, size: int) -> list[FrameBatch]:
    processor, frames = exposures(seconds, BAR)
    processor.set_tracking_config(tracked(motion_model))
    return [processor.process(frames[at : at + size]) for at in range(0, len(frames), size)]


@pytest.mark.parametrize("motion_model", MODELS)
def test_both_ends_of_the_bar_keep_their_numbers(motion_model: MotionModel) -> None:
    """Half a turn: through a crossing along each sensor; and JSON has a number everywhere."""
    batches = followed(motion_model, 1.05, 15)
    ends = ends_at(batches, BAR)
    assert sorted(ends[BEGUN].values()) == [0, 1]
    assert all(frame == ends[BEGUN] for frame in ends[BEGUN:])
    messages = StreamBatch(batches[-1]).messages(content=frozenset({"tracks"}))
    assert messages
    for message in messages:
        told = json.loads(encode(message, "json"), parse_constant=refuse)
        assert len(told["tracks"]) == 2
        for track in told["tracks"]:
            assert len(track["velocity_mm_s"]) == 3
            acceleration = track["acceleration_mm_s2"]
            assert acceleration is None if motion_model == "velocity" else len(acceleration) == 3


@pytest.mark.parametrize("motion_model", MODELS)
def test_batches_of_any_size_give_the_same_bits(motion_model: MotionModel) -> None:
    few, many = (followed(motion_model, 0.2, size) for size in (3, 20))
    assert len(motion(many[-1]).tracks) > 20
    assert bits(few) == bits(many)


def test_a_change_of_the_motion_model_starts_new_tracks() -> None:
    processor, frames = exposures(0.65, SLOW)
    batches, highest = [], []
    for number, motion_model in enumerate(MODELS):
        processor.set_tracking_config(tracked(motion_model))
        part = [processor.process([frame]) for frame in frames[20 * number : 20 * (number + 1)]]
        ends = ends_at(part, SLOW)
        assert sorted(ends[BEGUN].values()) == [0, 1]
        assert all(frame == ends[BEGUN] for frame in ends[BEGUN:])
        highest.append((min(ends[BEGUN]), max(ends[BEGUN])))
        batches += part
    # Tracks begin anew: no number is used again.
    assert highest[0][1] < highest[1][0]
    assert highest[1][1] < highest[2][0]
    # What is the same goes on.
    processor.set_tracking_config(tracked("interacting"))
    (last,) = ends_at([processor.process(frames[60:61])], SLOW)
    assert last == ends_at(batches[-1:], SLOW)[0]


@pytest.mark.slow
def test_a_recording_is_tracked_again_with_the_settings_given(taken: Taken, tmp_path: Path) -> None:
    """As live, bit by bit; and otherwise than by default, or nothing would be shown."""
    how = Tracking(motion="velocity")
    processor = FrameProcessor("sim", taken.description, "cpu")
    processor.set_calibration(ActiveCalibration("c1", taken.calibration.calibration))
    processor.set_tracking_config(TrackingConfig(True, (), how.tracker(), how.tool_tracker()))
    builder = TableBuilder("sim", 400.0, [])
    for first in range(0, FRAMES, 10):
        builder.add(processor.process(taken.frames[first : first + 10]))
    source = recording(tmp_path / "r.h5", taken, lines=False, results=True)
    with RecordingReader(source) as reader:
        found = table_from_recording(reader, tracking=how)
    live = builder.build()
    same(found, live, ("notes",))
    assert len(set(found.tracks.identity.tolist())) >= 4
    (device := tmp_path / "device.json").write_text(
        json.dumps({"id": "sim", "tracking": how.model_dump(mode="json")})
    )
    texts = []
    for option in ((), ("--device-file", device)):
        to = tmp_path / f"{len(option)}.csv"
        here("export", source, "--output", to, *option)
        texts.append([line for line in to.read_text().splitlines() if ",track," in line])
    assert len(texts[1]) == len(live.tracks.identity)
    assert texts[0] != texts[1]


@pytest.mark.slow
def test_a_running_device_takes_another_motion_model_and_streams_both_ends(server: str) -> None:
    """No track ever goes from one end of the bar to the other, whatever the machine loses."""
    api = f"{server}/api/v1/devices/sim"
    scene = {"kind": "rotating-bar", "period_s": SLOW.period_s}
    settings = {"scene": scene, "frame_rate_hz": 100, "illumination": "simultaneous"}
    source = {"kind": "simulated", "settings": settings}
    sent("PATCH", api, json={"source": source, "tracking": {"tracks": "always"}})
    sent("POST", f"{api}/start")
    with streaming(server, "device_id=sim&content=tracks") as socket:
        before = next_frame(socket, lambda one: len(one["tracks"]) == 2)
        changed = sent("PATCH", api, json={"tracking": {"motion": "velocity"}})
        assert changed["tracking"]["motion"] == "velocity"
        assert changed["tracking"]["tracks"] == "always"
        highest = max(track["id"] for track in before["tracks"])

        def by_velocity(frame: dict[str, Any]) -> bool:
            # This model has no acceleration.
            tracks = frame["tracks"]
            return len(tracks) == 2 and all(
                track["id"] > highest and track["acceleration_mm_s2"] is None for track in tracks
            )

        first = next_frame(socket, by_velocity)
        at: dict[int, int] = {}
        since_s = 0.0
        # Half a turn: along every sensor the ends change sides.
        while since_s < 0.55 * SLOW.period_s:
            frame = next_frame(socket, by_velocity)
            since_s = (frame["device_ns"] - first["device_ns"]) * 1e-9
            ends = SLOW.points(frame["device_ns"] * 1e-9)
            for track in frame["tracks"]:
                apart = np.linalg.norm(ends - np.array(track["position_mm"]), axis=1)
                if apart.min() < 30.0:
                    assert at.setdefault(track["id"], int(apart.argmin())) == int(apart.argmin())
        assert sorted(set(at.values())) == [0, 1]
    sent("PATCH", api, json={"tracking": {"motion": "interacting", "tracks": "never"}})
