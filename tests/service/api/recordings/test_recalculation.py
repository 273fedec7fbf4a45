"""Points of a recording by another calibration: those that the live pipeline would have found."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compute.calibration.result import Calibration
from compute.errors import InvalidRecording
from hardware.line_frame import LineFrame
from hardware.recording.frame_block import FrameBlock, frame_rows
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import MovingTool, MovingTools
from hardware.simulated.settings import SimulationSettings
from service.api.recordings.playback import recorded_frames
from service.api.recordings.recalculation import Recalculation
from service.api.recordings.recorded_peaks import process_block
from service.api.recordings.recording_process import MAX_CONCURRENT
from service.api.recordings.result_rows import peak_rows, point_rows
from service.api.recordings.schema import RecordedFrames
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.detection_stage import built_in_profile
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor
from service.problems.errors import Busy, SensorsChanged
from tests.service.fake_pipeline import TestClient
from tests.service.pipeline.test_pipeline_manager import nominal

FRAMES = MAX_FRAMES + 20
SHIFT_MM = 5.0
MARKERS = ((0.0, 0.0, 0.0), (60.0, 0.0, 0.0), (0.0, 80.0, 10.0))


@pytest.fixture(scope="module")
def recalculation() -> Iterator[Recalculation]:
    recalculation = Recalculation(built_in_profile)
    yield recalculation
    recalculation.close()


@pytest.fixture(scope="module", params=["strobed", "simultaneous"])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Lines and results of a moving tool, found live with the nominal calibration."""
    settings = SimulationSettings(
        MovingTools((MovingTool(MARKERS),)),
        illumination=request.param,
        duration_s=FRAMES * 1e-3,
        realtime=False,
    )
    driver = SimulatedDriver("sim", settings)
    driver.open()
    path = tmp_path_factory.mktemp("recalculation") / "results.h5"
    frames = list(driver.frames())
    with RecordingWriter(path, driver.description, results=True) as writer:
        for first in range(0, len(frames), MAX_FRAMES):
            part = frames[first : first + MAX_FRAMES]
            writer.append_block(block_of(part, processed(driver, part, nominal())))
    return path


def processed(
    driver: SimulatedDriver, frames: list[LineFrame], calibration: Calibration
) -> FrameBatch:
    """Return frames as the live pipeline makes them."""
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("c1", calibration))
    return processor.process(frames)


def block_of(frames: list[LineFrame], batch: FrameBatch) -> FrameBlock:
    """Return frames with their results as a recording keeps them."""
    peaks, peak_counts = peak_rows(batch.peaks, len(batch.sensor_names))
    points, point_counts = point_rows(batch)
    rows = frame_rows(frames)
    rows["peaks"], rows["points"] = peak_counts, point_counts
    return FrameBlock(rows, np.stack([frame.lines for frame in frames]), peaks, points)


def shifted() -> Calibration:
    """Return the nominal calibration with the world's origin shifted along X."""
    calibration = nominal()
    fits = []
    for fit in calibration.sensors:
        rotation = fit.model.rotation
        model = replace(
            fit.model,
            offset_x_mm=fit.model.offset_x_mm - SHIFT_MM * rotation[0, 0],
            offset_z_mm=fit.model.offset_z_mm - SHIFT_MM * rotation[2, 0],
        )
        fits.append(replace(fit, model=model))
    return replace(calibration, sensors=tuple(fits))


def ask(recalculation: Recalculation, path: Path, calibration: Calibration) -> RecordedFrames:
    """Return the whole recording by a calibration."""
    given = ActiveCalibration("other", calibration)
    found = recalculation.frames(path, path.name, 0, FRAMES, given)
    return RecordedFrames.model_validate_json(found)


@pytest.mark.slow
def test_the_same_calibration_gives_the_same_bits(
    recalculation: Recalculation, recording: Path
) -> None:
    found = ask(recalculation, recording, nominal())
    assert found.calibration_id == "other"
    assert found.frames == recorded_frames(recording, recording.name, 0, FRAMES).frames
    assert sum(len(frame.points) for frame in found.frames) >= FRAMES


def test_a_shifted_world_shifts_the_points(recalculation: Recalculation, recording: Path) -> None:
    live = recorded_frames(recording, recording.name, 0, FRAMES)
    assert live.calibration_id is None
    found = ask(recalculation, recording, shifted())
    moved = [
        np.subtract(there.position_mm, here.position_mm)
        for frame, other in zip(live.frames, found.frames, strict=True)
        for here, there in zip(frame.points, other.points, strict=True)
        if here.position_mm is not None and there.position_mm is not None
    ]
    assert len(moved) >= FRAMES
    assert np.abs(np.array(moved) - [SHIFT_MM, 0.0, 0.0]).max() < 0.05


def test_a_calibration_of_other_sensors_is_refused(
    recalculation: Recalculation, recording: Path
) -> None:
    calibration = nominal()
    fits = calibration.sensors
    other = replace(fits[0], model=replace(fits[0].model, name="another"))
    with pytest.raises(SensorsChanged, match="another"):
        ask(recalculation, recording, replace(calibration, sensors=(other, *fits[1:])))


def test_points_of_a_recording_of_lines_are_worked_out_from_them(
    recalculation: Recalculation, recording: Path, tmp_path: Path
) -> None:
    path = tmp_path / "lines.h5"
    with (
        RecordingReader(recording) as reader,
        RecordingWriter(path, reader.info.description) as writer,
    ):
        for frame in reader.frames():
            writer.append(frame)
    found = ask(recalculation, path, nominal())
    assert found.frames == ask(recalculation, recording, nominal()).frames


def test_a_recording_without_peaks_and_lines_is_refused(
    recording: Path,
) -> None:
    with RecordingReader(recording) as reader:
        description = reader.info.description
        block = replace(reader.block(0, 3), lines=None)
    processor = FrameProcessor("sim", description, "cpu")
    with pytest.raises(InvalidRecording, match="neither"):
        process_block(block, processor, description, from_scans=True)


def test_more_requests_than_may_wait_are_refused(
    recalculation: Recalculation, recording: Path
) -> None:
    with ExitStack() as stack:
        for _ in range(MAX_CONCURRENT):
            stack.enter_context(recalculation._process._limit)
        with pytest.raises(Busy, match="wait for results of recordings"):
            ask(recalculation, recording, nominal())


@pytest.mark.slow
def test_frames_by_another_calibration_over_rest(
    recording: Path, sqlite_client: TestClient
) -> None:
    folder = sqlite_client.app.state.settings.folders.recordings  # type: ignore[attr-defined]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.h5").write_bytes(recording.read_bytes())
    frames = "/api/v1/recordings/results.h5/frames?first=3&count=2"
    found = sqlite_client.get(f"{frames}&calibration_id=sim-nominal").json()
    assert found["calibration_id"] == "sim-nominal"
    assert [one["number"] for one in found["frames"]] == [3, 4]
    live = sqlite_client.get(frames).json()
    assert live["calibration_id"] is None
    for one, other in zip(found["frames"], live["frames"], strict=True):
        for point, there in zip(one["points"], other["points"], strict=True):
            assert point["position_mm"] == pytest.approx(there["position_mm"], abs=0.01)
    assert sqlite_client.get(f"{frames}&calibration_id=none").status_code == 404
    assert sqlite_client.get(f"{frames}&calibration_id=not%20one").status_code == 422
