"""Frames of a recording to look at: points, scans, peaks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compute.errors import InvalidParameter, InvalidRecording
from hardware.driver import SensorDescription
from hardware.line_frame import LineFrame
from hardware.recording.frame_block import FrameBlock, frame_rows
from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.api.recordings.playback import recorded_frames, recorded_scans
from service.api.recordings.result_rows import peak_rows, point_rows
from service.pipeline.frame_processor import FrameProcessor
from tests.service.fake_pipeline import TestClient

FRAMES = 40


@pytest.fixture(scope="module")
def frames() -> list[LineFrame]:
    return list(_driver().frames())


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, frames: list[LineFrame]) -> Path:
    """A recording of lines alone."""
    path = tmp_path_factory.mktemp("playback") / "lines.h5"
    with RecordingWriter(path, _driver().description) as writer:
        for frame in frames:
            writer.append(frame)
    return path


@pytest.fixture(scope="module")
def with_results(tmp_path_factory: pytest.TempPathFactory, frames: list[LineFrame]) -> Path:
    """A recording of lines and results, without a calibration: points have no position."""
    path = tmp_path_factory.mktemp("playback") / "results.h5"
    batch = FrameProcessor("sim", _driver().description, "cpu").process(frames)
    peaks, peak_counts = peak_rows(batch.peaks, 4)
    points, point_counts = point_rows(batch)
    rows = frame_rows(frames)
    rows["peaks"], rows["points"] = peak_counts, point_counts
    lines = np.stack([frame.lines for frame in frames])
    with RecordingWriter(path, _driver().description, results=True) as writer:
        writer.append_block(FrameBlock(rows, lines, peaks, points))
    return path


def _driver() -> SimulatedDriver:
    driver = SimulatedDriver("sim", SimulationSettings(duration_s=FRAMES * 1e-3, realtime=False))
    driver.open()
    return driver


def test_frames_are_those_asked_for_and_none_behind_the_end(
    recording: Path, frames: list[LineFrame]
) -> None:
    found = recorded_frames(recording, "lines.h5", FRAMES - 3, 10)
    assert found.frames_written == FRAMES
    assert [one.number for one in found.frames] == list(range(FRAMES - 3, FRAMES))
    assert [one.sequence for one in found.frames] == [one.sequence for one in frames[-3:]]
    assert recorded_frames(recording, "lines.h5", FRAMES, 10).frames == []


def test_scans_too_short_for_a_peak_are_refused(tmp_path: Path) -> None:
    sensors = (SensorDescription("s", 24, 10.0),)
    device = replace(_driver().description, sensors=sensors)
    with RecordingWriter(tmp_path / "r.h5", device) as writer:
        writer.append(LineFrame(device.name, 0, 0, 0, None, np.zeros((1, 24), np.uint16)))
    with pytest.raises(InvalidRecording, match="scans of 24 pixels; peaks are searched in 64 to 6"):
        recorded_scans(tmp_path / "r.h5", "r.h5", 0, None)


@pytest.mark.parametrize("source", ["recording", "with_results"])
def test_scans_have_their_pixels_and_peaks_recorded_or_found_now(
    source: str, frames: list[LineFrame], request: pytest.FixtureRequest
) -> None:
    path = request.getfixturevalue(source)
    scans = recorded_scans(path, path.name, 7, "vertical").scans
    assert [scan.counts for scan in scans] == frames[7].lines.tolist()
    for scan in scans:
        [peak] = scan.peaks
        assert abs(peak.position_px - int(np.argmax(scan.counts))) < 2.0
    assert scans[0].windows is not None
    assert scans[0].windows[0].position_px[0] == pytest.approx(
        scans[0].peaks[0].position_px, abs=1e-3
    )
    assert scans[1].windows is None


@pytest.mark.parametrize("number", [-1, FRAMES])
def test_frame_that_there_is_not_is_refused_with_those_that_there_are(
    recording: Path, number: int
) -> None:
    with pytest.raises(InvalidParameter, match=f"frames 0 to {FRAMES - 1}"):
        recorded_scans(recording, "lines.h5", number, None)


def test_file_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "none.h5"
    path.write_bytes(b"nothing")
    with pytest.raises(InvalidRecording):
        recorded_frames(path, "none.h5", 0, 1)


def test_recording_is_looked_at_over_rest(recording: Path, sqlite_client: TestClient) -> None:
    folder = sqlite_client.app.state.settings.folders.recordings  # type: ignore[attr-defined]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "lines.h5").write_bytes(recording.read_bytes())
    found = sqlite_client.get("/api/v1/recordings/lines.h5/frames?first=3&count=2").json()
    assert [one["number"] for one in found["frames"]] == [3, 4]
    scans = sqlite_client.get("/api/v1/recordings/lines.h5/scans?number=3").json()
    assert len(scans["scans"]) == 4
    assert sqlite_client.get("/api/v1/recordings/none.h5/frames").status_code == 404
