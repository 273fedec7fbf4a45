"""Recordings of devices whose profile is in the data directory: results as the live pipeline's."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from hardware.simulated.profile_driver import ProfileDriver
from hardware.simulated.profile_settings import ProfileSettings
from service.api.devices.nominal_calibration import nominal_calibration
from service.api.devices.profiles import find_profile
from service.api.devices.tracking_settings import Tracking
from service.api.exports.from_recording import table_from_recording
from service.api.recordings.active_calibration_file import dump_active_calibration
from service.api.recordings.playback import recorded_frames
from service.api.recordings.recalculation import Recalculation
from service.api.recordings.recorded_readings import read_cycles
from service.api.recordings.recorded_tracking import recorded_tracking
from service.api.recordings.schema import RecordedFrames
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.detection_stage import FindProfile, expected_scans
from service.pipeline.frame_processor import FrameProcessor
from tests.service.api.recordings.test_recalculation import block_of
from tests.service.fake_pipeline import TestClient
from tests.service.renamed_profiles import WINDOW, renamed_profile

FRAMES = 40


@pytest.fixture(scope="module")
def profiles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a profile of coded windows."""
    folder: Path = tmp_path_factory.mktemp("profiles")
    (folder / "mine.toml").write_text(renamed_profile("mine", WINDOW), "utf-8")
    return folder


@pytest.fixture(scope="module")
def finder(profiles: Path) -> FindProfile:
    return partial(find_profile, profiles_dir=profiles)


@pytest.fixture(scope="module", params=["lines", "results"])
def recording(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, finder: FindProfile
) -> Path:
    """Scans of a bar by a device of the profile, with or without what was found live."""
    profile = finder("mine")
    driver = ProfileDriver("sim", profile, ProfileSettings(duration_s=FRAMES / 100, realtime=False))
    driver.open()
    frames = list(driver.frames())
    assert len(frames) == FRAMES
    active = ActiveCalibration("c1", nominal_calibration(profile))
    model = expected_scans(driver.description, finder)
    processor = FrameProcessor("sim", driver.description, "cpu", model)
    processor.set_calibration(active)
    path: Path = tmp_path_factory.mktemp("kept") / "r.h5"
    results = request.param == "results"
    with RecordingWriter(path, driver.description, results=results) as writer:
        row = writer.put_active_calibration(*dump_active_calibration(active))
        block = block_of(frames, processor.process(frames))
        block.rows["active_calibration"] = row
        if not results:
            block.rows["peaks"] = block.rows["points"] = 0
            block = replace(block, peaks=block.peaks[:0], points=block.points[:0])
        writer.append_block(block)
    return path


@pytest.fixture(scope="module")
def live_points(finder: FindProfile, recording: Path) -> int:
    """The number of points that the live pipeline finds."""
    with RecordingReader(recording) as reader:
        frames = list(reader.frames())
        processor = FrameProcessor(
            "sim",
            reader.info.description,
            "cpu",
            expected_scans(reader.info.description, finder),
        )
    processor.set_calibration(ActiveCalibration("c1", nominal_calibration(finder("mine"))))
    return len(processor.process(frames).points)


@pytest.mark.slow
def test_tracking_finds_the_points_of_the_live_pipeline(
    recording: Path, finder: FindProfile, live_points: int
):
    recalculation = Recalculation(finder)
    try:
        text = recalculation.frames(
            recording, "r.h5", 0, FRAMES, None, recorded_tracking(Tracking(), ())
        )
    finally:
        recalculation.close()
    frames = RecordedFrames.model_validate_json(text).frames
    assert sum(len(frame.points) for frame in frames) == live_points > FRAMES // 2
    recorded = recorded_frames(recording, "r.h5", 0, FRAMES).frames
    if any(frame.points for frame in recorded):
        assert [frame.points for frame in frames] == [frame.points for frame in recorded]


def test_an_export_has_the_points_of_the_live_pipeline(
    recording: Path, finder: FindProfile, live_points: int
):
    with RecordingReader(recording) as reader:
        table = table_from_recording(reader, find_profile=finder)
    assert len(table.points.frame) == live_points


def test_readings_of_captures_are_those_of_the_live_pipeline(recording: Path, finder: FindProfile):
    cycles = read_cycles(recording, lambda _share: None, finder)
    assert cycles.readings_px.size
    assert (cycles.readings_px == cycles.readings_px).mean() > 0.5


@pytest.mark.slow
def test_points_over_rest(
    recording: Path, profiles: Path, sqlite_client: TestClient, live_points: int
):
    folders: Any = sqlite_client.app.state.settings.folders  # type: ignore[attr-defined]
    for folder in (folders.recordings, folders.profiles):
        folder.mkdir(parents=True, exist_ok=True)
    (folders.profiles / "mine.toml").write_bytes((profiles / "mine.toml").read_bytes())
    (folders.recordings / "r.h5").write_bytes(recording.read_bytes())
    url = f"/api/v1/recordings/r.h5/frames?count={FRAMES}&tracking=true"
    frames = sqlite_client.get(url).json()["frames"]
    assert sum(len(frame["points"]) for frame in frames) == live_points
