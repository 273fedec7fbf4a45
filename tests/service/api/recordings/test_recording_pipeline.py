"""Tracks and tools of a recording as a player goes through it: those of the live pipeline."""

import pickle
from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from compute.calibration.result import Calibration
from compute.errors import InvalidRecording
from compute.pose.rigid_body import RigidBody
from hardware.line_frame import LineFrame
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import MovingTool, MovingTools
from hardware.simulated.settings import SimulationSettings
from lumiline.client import messages
from service.api.devices.tracking_settings import Tracking
from service.api.recordings import recalculation as process
from service.api.recordings import recorded_peaks, recording_pipeline
from service.api.recordings.active_calibration_file import dump_active_calibration
from service.api.recordings.recalculation import Recalculation
from service.api.recordings.recorded_tracking import recorded_tracking
from service.api.recordings.recording_pipeline import (
    LEAD_FRAMES,
    MAX_KEPT_FRAMES,
    RecordingPipeline,
    RecordingPipelines,
)
from service.api.recordings.schema import (
    RecordedFrame,
    RecordedFrames,
    RecordedToolPose,
    RecordedTrack,
)
from service.pipeline.active_calibration import ActiveCalibration, LiveBadPixel
from service.pipeline.detection_stage import ExpectedScans, built_in_profile
from service.pipeline.frame_batch import pose_members, track_members
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor
from tests.service.api.recordings.test_recalculation import block_of
from tests.service.fake_pipeline import TestClient
from tests.service.pipeline.test_pipeline_manager import nominal

MARKERS = ((0.0, 0.0, 0.0), (60.0, 0.0, 0.0), (0.0, 80.0, 10.0), (30.0, 20.0, 50.0))
FRAMES = 2 * MAX_KEPT_FRAMES + 2 * LEAD_FRAMES + 200
TRACKING = recorded_tracking(
    Tracking(), [RigidBody("pointer", np.array(MARKERS), strobe_markers=(0, 1, 2, 3))]
)


@pytest.fixture(scope="module")
def frames() -> list[LineFrame]:
    settings = SimulationSettings(
        MovingTools((MovingTool(MARKERS),)), duration_s=FRAMES * 1e-3, realtime=False
    )
    driver = SimulatedDriver("sim", settings)
    driver.open()
    return list(driver.frames())


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, frames: list[LineFrame]) -> Path:
    """Results of a moving tool with the nominal calibration, which is in the file."""
    driver = SimulatedDriver("sim", SimulationSettings(MovingTools((MovingTool(MARKERS),))))
    path = tmp_path_factory.mktemp("pipeline") / "results.h5"
    active = ActiveCalibration("c1", nominal())
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(active)
    with RecordingWriter(path, driver.description, results=True) as writer:
        row = writer.put_active_calibration(*dump_active_calibration(active))
        for first in range(0, FRAMES, MAX_FRAMES):
            part = frames[first : first + MAX_FRAMES]
            block = block_of(part, processor.process(part))
            block.rows["active_calibration"] = row
            writer.append_block(block)
    return path


@pytest.fixture(scope="module")
def live_results(
    frames: list[LineFrame],
) -> list[tuple[list[dict[str, Any]], list[dict[str, Any]]]]:
    """Tracks and tools of each frame as the live pipeline has them from the beginning on."""
    driver = SimulatedDriver("sim", SimulationSettings(MovingTools((MovingTool(MARKERS),))))
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("c1", nominal()))
    processor.set_tracking_config(TRACKING)
    found = []
    for first in range(0, FRAMES, MAX_FRAMES):
        motion = processor.process(frames[first : first + MAX_FRAMES]).motion
        assert motion is not None
        for frame in range(len(frames[first : first + MAX_FRAMES])):
            low, high = motion.track_owner.searchsorted((frame, frame + 1)).tolist()
            tracks = track_members(motion.tracks, slice(low, high))
            found.append((tracks, [pose_members(pose) for pose in motion.poses_of(frame)]))
    return found


@pytest.fixture
def reader(recording: Path) -> Iterator[RecordingReader]:
    with RecordingReader(recording) as reader:
        yield reader


@pytest.mark.slow
def test_frames_in_order_have_the_tracks_and_tools_of_the_live_pipeline(
    reader: RecordingReader, live_results: list[Any]
):
    pipeline = RecordingPipeline(reader, None, TRACKING, ExpectedScans())
    # As a player that lets out frames, and asks for some again.
    for first, end in ((0, 32), (20, 52), (90, 122), (300, 420), (300, 301), (410, 800)):
        found = pipeline.results(reader, first, end)
        assert [(one.tracks, one.tools) for one in found] == live_results[first:end]
    poses = [tools[0]["status"] for _, tools in live_results[100:800]]
    assert poses.count("OK") > 650
    assert sum(len(tracks) == len(MARKERS) for tracks, _ in live_results[200:800]) > 500


@pytest.mark.slow
def test_frames_after_a_jump_have_a_tool_at_once(reader: RecordingReader, live_results: list[Any]):
    pipeline = RecordingPipeline(reader, None, TRACKING, ExpectedScans())
    pipeline.results(reader, 0, 32)
    first = 32 + LEAD_FRAMES + 300
    for begin in (first, first - LEAD_FRAMES + 12):
        found = pipeline.results(reader, begin, begin + 32)
        for one, (_, [tool]) in zip(found, live_results[begin : begin + 32], strict=True):
            assert one.tools is not None
            assert one.tracks is not None
            [there] = one.tools
            assert there["status"] == "OK"
            difference = np.subtract(there["translation_mm"], tool["translation_mm"])
            assert np.abs(difference).max() < 0.2
            assert len(one.tracks) == len(MARKERS)


@pytest.mark.slow
def test_results_are_kept_for_a_while_and_worked_out_again(reader: RecordingReader):
    pipeline = RecordingPipeline(reader, None, TRACKING, ExpectedScans())
    pipeline.results(reader, 0, FRAMES)
    begin = FRAMES - MAX_KEPT_FRAMES
    kept = pipeline.results(reader, begin, begin + 1)
    assert pipeline.results(reader, begin, begin + 1)[0].tools == kept[0].tools
    again = pipeline.results(reader, 0, 2)
    assert [one.tools is not None and one.tools[0]["status"] for one in again] == ["MISSING"] * 2


@pytest.mark.slow
def test_points_are_those_of_the_recording(reader: RecordingReader):
    found = RecordingPipeline(reader, None, TRACKING, ExpectedScans()).results(reader, 40, 60)
    rows = reader.block(40, 60).points
    assert [one.points.position_mm.tolist() for one in found] == [
        rows["position_mm"][rows["frame"] == index].tolist() for index in range(20)
    ]


@pytest.mark.slow
def test_where_a_recording_is_played_is_kept_from_one_request_to_the_next(recording: Path):
    recalculation = Recalculation(built_in_profile)
    try:
        texts = [
            recalculation.frames(recording, "r.h5", first, 32, None, TRACKING)
            for first in (0, 32, 600, 632)
        ]
    finally:
        recalculation.close()
    parts = [RecordedFrames.model_validate_json(text).frames for text in texts]
    names = [{track.id for frame in part[10:] for track in frame.tracks or ()} for part in parts]
    # Tracks that are confirmed go on, and those after a jump are others.
    assert names[2] == names[3] != set()
    assert names[1].isdisjoint(names[2])


@pytest.fixture
def pipelines(monkeypatch: pytest.MonkeyPatch) -> RecordingPipelines:
    """Those of this process, as if it were the one that works results out."""
    pipelines = RecordingPipelines(process.MAX_PIPELINES)
    monkeypatch.setattr(process, "_pipelines", lambda: pipelines)
    return pipelines


@pytest.fixture
def processed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of frames of each block that was processed."""
    counts: list[int] = []

    def process_block(block: Any, *arguments: Any, **options: Any) -> Any:
        counts.append(len(block.rows))
        return recorded_peaks.process_block(block, *arguments, **options)

    monkeypatch.setattr(recording_pipeline, "process_block", process_block)
    return counts


def ask(
    path: Path, first: int, count: int = 32, calibration: ActiveCalibration | None = None
) -> list[RecordedFrame]:
    """Return frames as the process works them out."""
    config = pickle.dumps((calibration, TRACKING))
    text = process._frames(path, "r.h5", first, count, config, built_in_profile)
    return RecordedFrames.model_validate_json(text).frames


def track_ids(frames: Iterable[RecordedFrame]) -> set[int]:
    """Return the numbers of the tracks of some frames."""
    return {track.id for frame in frames for track in frame.tracks or ()}


def test_few_recordings_are_kept(recording: Path, pipelines: RecordingPipelines):
    for number in range(process.MAX_PIPELINES + 1):
        ask(recording, 0, 2, ActiveCalibration(f"c{number}", nominal()))
    calibrations = [one.calibration.calibration_id for one in pipelines if one.calibration]
    assert calibrations == [f"c{number}" for number in range(1, process.MAX_PIPELINES + 1)]


def test_two_players_of_a_recording_do_not_restart_each_other(
    recording: Path, pipelines: RecordingPipelines, processed: list[int]
):
    players: dict[int, list[set[int]]] = {0: [], 1200: []}
    for step in range(6):
        for begin, ids in players.items():
            before = sum(processed)
            ids.append(track_ids(ask(recording, begin + 32 * step)))
            assert step == 0 or sum(processed) - before == 32
    for ids in players.values():
        assert set.intersection(*ids[1:]) != set()
    assert len(list(pipelines)) == 2


@pytest.mark.slow
def test_jumps_of_a_player_take_few_pipelines_and_other_tracks(
    recording: Path, pipelines: RecordingPipelines
):
    ids = [track_ids(ask(recording, first)) for first in (1600, 700, 0)]
    for number, one in enumerate(ids):
        assert one != set()
        assert one.isdisjoint(set().union(*ids[:number]))
    for first in (1300, 400, 1000, 100, 1600, 700):
        ask(recording, first)
    assert len(list(pipelines)) <= process.MAX_PIPELINES


@pytest.mark.slow
def test_steps_back_after_a_jump_are_cheap(reader: RecordingReader, processed: list[int]):
    pipeline = RecordingPipeline(reader, None, TRACKING, ExpectedScans())
    pipeline.results(reader, 1000, 1032)
    before = sum(processed)
    for first in range(999, 999 - 200, -1):
        [one, *_] = pipeline.results(reader, first, first + 32)
        assert one.tools is not None
        assert one.tools[0]["status"] == "OK"
    assert sum(processed) == before


@pytest.mark.slow
def test_the_memory_of_a_pipeline_is_bounded(reader: RecordingReader):
    pipeline = RecordingPipeline(reader, None, TRACKING, ExpectedScans())
    pipeline.results(reader, 0, 1)
    for first in range(0, FRAMES - 256, 256):
        assert len(pipeline.results(reader, first, first + 256)) == 256
    assert sum(len(batch.frames) for _, batch in pipeline._batches) <= 256 + 2 * MAX_FRAMES


@pytest.mark.slow
def test_a_damaged_frame_hides_no_frame_behind_it(
    recording: Path, tmp_path: Path, live_results: list[Any]
):
    path = tmp_path / "damaged.h5"
    path.write_bytes(recording.read_bytes())
    with h5py.File(path, "r+") as file:
        file["frames/results_checksum"][700] ^= 1
    with RecordingReader(path) as reader:
        pipeline = RecordingPipeline(reader, None, TRACKING, ExpectedScans())
        for first in (710, 1000):
            found = pipeline.results(reader, first, first + 32)
            assert len(found) == 32
        for one, (_, [tool]) in zip(found, live_results[1000:1032], strict=True):
            assert one.tools is not None
            assert one.tools[0]["status"] == tool["status"] == "OK"
        with pytest.raises(InvalidRecording, match="row 700"):
            pipeline.results(reader, 690, 710)
        # As a player goes on behind it.
        again = RecordingPipeline(reader, None, TRACKING, ExpectedScans())
        again.results(reader, 600, 632)
        assert len(again.results(reader, 720, 752)) == 32


@pytest.mark.slow
def test_a_jump_to_frames_with_other_bad_pixels_begins_other_tracks(
    frames: list[LineFrame], tmp_path: Path
):
    driver = SimulatedDriver("sim", SimulationSettings(MovingTools((MovingTool(MARKERS),))))
    bad = LiveBadPixel(driver.description.sensors[0].name, 3, "hot", datetime.now(UTC))
    active = ActiveCalibration("c1", nominal())
    path = tmp_path / "pixels.h5"
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(active)
    with RecordingWriter(path, driver.description, results=True) as writer:
        rows = [
            writer.put_active_calibration(*dump_active_calibration(one))
            for one in (active, replace(active, bad_pixels=(bad,)))
        ]
        for first in range(0, FRAMES, MAX_FRAMES):
            part = frames[first : first + MAX_FRAMES]
            block = block_of(part, processor.process(part))
            block.rows["active_calibration"] = rows[first >= 10 * MAX_FRAMES]
            writer.append_block(block)
    with RecordingReader(path) as reader:
        pipeline = RecordingPipeline(reader, None, TRACKING, ExpectedScans())
        before = pipeline.results(reader, 100, 132)
        after = pipeline.results(reader, 1300, 1332)
    ids = [{track["id"] for one in part for track in one.tracks or ()} for part in (before, after)]
    assert ids[0] != set() != ids[1]
    assert ids[0].isdisjoint(ids[1])


def test_another_recording_of_the_same_name_and_inode_has_its_own_results(
    frames: list[LineFrame], tmp_path: Path, pipelines: RecordingPipelines
):
    driver = SimulatedDriver("sim", SimulationSettings(MovingTools((MovingTool(MARKERS),))))
    path = tmp_path / "r.h5"

    def write(target: Path, calibration: Calibration, count: int) -> None:
        active = ActiveCalibration("c1", calibration)
        processor = FrameProcessor("sim", driver.description, "cpu")
        processor.set_calibration(active)
        with RecordingWriter(target, driver.description, results=True) as writer:
            row = writer.put_active_calibration(*dump_active_calibration(active))
            for first in range(0, count, MAX_FRAMES):
                part = frames[first : first + MAX_FRAMES]
                block = block_of(part, processor.process(part))
                block.rows["active_calibration"] = row
                writer.append_block(block)

    def positions() -> list[Any]:
        return [point.position_mm for frame in ask(path, 0) for point in frame.points]

    write(path, nominal(), 64)
    first = positions()
    inode = path.stat().st_ino
    for calibration, count in ((nominal(5.0), 64), (nominal(), 128)):
        write(tmp_path / "other.h5", calibration, count)
        path.write_bytes((tmp_path / "other.h5").read_bytes())  # in place: the same inode
        (tmp_path / "other.h5").unlink()
        assert path.stat().st_ino == inode
        if count == 64:
            shift = np.subtract(positions(), first)
            np.testing.assert_allclose(shift, [[5.0, 0.0, 0.0]] * len(shift), atol=0.1)
    assert positions() == first
    # The last has the first one's frames and further ones, as if it had grown.
    assert len(list(pipelines)) == 2


def test_members_are_those_of_the_stream():
    for model, message in (
        (RecordedTrack, messages.Track),
        (RecordedToolPose, messages.ToolPose),
    ):
        assert list(model.model_fields) == [one.name for one in fields(message)]


@pytest.mark.slow
def test_tracks_and_tools_over_rest(recording: Path, sqlite_client: TestClient):
    folder = sqlite_client.app.state.settings.folders.recordings  # type: ignore[attr-defined]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.h5").write_bytes(recording.read_bytes())
    frames = "/api/v1/recordings/results.h5/frames?first=600&count=2"
    plain = sqlite_client.get(frames).json()["frames"][0]
    assert (plain["tracks"], plain["tools"]) == (None, None)
    without = sqlite_client.get(f"{frames}&tracking=true").json()["frames"][0]
    assert without["points"] == plain["points"]
    assert len(without["tracks"]) == len(MARKERS)
    assert without["tools"] == []
    tool = {"id": "pointer", "device_id": "sim", "title": "Pointer", "markers_mm": MARKERS}
    strobed = tool | {"strobe_markers": [0, 1, 2, 3]}
    assert sqlite_client.post("/api/v1/tools", json=strobed).status_code == 201
    found = sqlite_client.get(f"{frames}&tracking=true").json()["frames"][0]
    assert [one["tool_id"] for one in found["tools"]] == ["pointer"]
    assert found["tools"][0]["status"] == "OK"
    other = sqlite_client.get(f"{frames}&tracking=true&calibration_id=sim-nominal").json()
    assert other["calibration_id"] == "sim-nominal"
    assert other["frames"][0]["tools"][0]["status"] == "OK"
