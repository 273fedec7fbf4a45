"""Bad pixels that the frames of a running device show: found, masked, recorded and replayed."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from compute.errors import InvalidParameter, InvalidRecording
from compute.signal.bad_pixel_monitor import MIN_SCANS
from compute.signal.peaks import PeakFlag
from hardware.line_frame import LineFrame
from hardware.recording.reader import RecordingReader
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.pixel_defects import PixelDefects
from hardware.simulated.scenes import RotatingBar
from hardware.simulated.settings import SimulationSettings
from service.api.recordings.active_calibration_file import (
    dump_active_calibration,
    load_active_calibration,
)
from service.api.recordings.recording_manager import RecordingManager
from service.api.recordings.reprocessing import calibration_intervals, compare
from service.api.recordings.schema import NewRecording
from service.pipeline import bad_pixel_watch
from service.pipeline.active_calibration import ActiveCalibration, LiveBadPixel
from service.pipeline.bad_pixel_watch import BadPixelWatch
from service.pipeline.frame_processor import FrameProcessor
from service.pipeline.pipeline_manager import PipelineManager
from service.protocols.stream.hub import Hub
from tests.service.pipeline.test_pipeline_manager import nominal

DEFECTS = PixelDefects(dead_pixels=0, hot_pixels=2, stuck_pixels=1)
SETTINGS = SimulationSettings(RotatingBar(), pixels=DEFECTS, frame_rate_hz=400.0)
SINCE = datetime(2026, 1, 2, tzinfo=UTC)


def defects() -> set[tuple[str, int, str]]:
    """The pixels that the simulator made bad."""
    _, hot, stuck = DEFECTS.positions(4, 2048)
    names = [sensor.name for sensor in SimulatedDriver("sim", SETTINGS).description.sensors]
    kinds = (("hot", hot), ("stuck", stuck))
    return {
        (name, int(pixel), kind)
        for kind, pixels in kinds
        for name, row in zip(names, pixels, strict=True)
        for pixel in row
    }


def frames(count: int) -> list[LineFrame]:
    """Frames of the simulated device, without waiting for their time."""
    settings = replace(SETTINGS, realtime=False, duration_s=count / SETTINGS.frame_rate_hz)
    driver = SimulatedDriver("sim", settings)
    driver.open()
    return list(driver.frames())


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 240.0
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.005)


@pytest.fixture
def live() -> Iterator[PipelineManager]:
    manager = PipelineManager(Hub(), "cpu")
    yield manager
    manager.close()


def test_watch_looks_at_few_frames_and_begins_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    description = SimulatedDriver("sim", SETTINGS).description
    watch = BadPixelWatch("sim", description)
    seen = frames(MIN_SCANS)
    assert not watch.take(seen)
    assert watch.due_s > 0.0
    monkeypatch.setattr(bad_pixel_watch, "SAMPLE_INTERVAL_S", 0.0)
    monkeypatch.setattr(bad_pixel_watch, "MAX_SCANS", 2 * MIN_SCANS)
    watch = BadPixelWatch("sim", description)
    # Each sensor is judged in a call of its own.
    found = [watch.take([one]) for one in seen + seen[:4]]
    assert sum(found) == 4
    assert {(one.sensor, one.pixel, one.kind) for one in watch.found} == defects()
    above = np.zeros_like(seen[0].lines)
    above[1, 700] = 400
    changed = [replace(one, lines=one.lines + above) for one in seen]
    later = [watch.take([one]) for _ in range(4) for one in changed]
    assert sum(later) == 1
    new = (description.sensors[1].name, 700, "hot")
    assert {(one.sensor, one.pixel, one.kind) for one in watch.found} == defects() | {new}


@pytest.mark.slow
def test_pixels_are_masked_and_a_recording_gives_the_same_bits(
    live: PipelineManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = RecordingManager(live, tmp_path, flush_s=0.05)
    live.start_device("sim", SimulatedDriver("sim", SETTINGS), ActiveCalibration("c1", nominal()))
    try:
        recordings.start("sim", NewRecording(id="r.h5"))
        monkeypatch.setattr(bad_pixel_watch, "SAMPLE_INTERVAL_S", 0.0)
        wait_for(lambda: len(live.status("sim").bad_pixels) >= len(defects()))
        found = live.status("sim").bad_pixels
        assert {(one.sensor, one.pixel, one.kind) for one in found} == defects()
        # Another calibration keeps them.
        live.set_calibration("sim", ActiveCalibration("c2", nominal(2.0)))
        assert live.status("sim").bad_pixels == found
        before = live.status("sim").frames_processed
        wait_for(lambda: live.status("sim").frames_processed > before + 50)
        done = recordings.stop("r.h5")
    finally:
        live.stop_device("sim")
        recordings.close()
    assert done.calibrations[0].bad_pixels == 0
    assert done.calibrations[-1].bad_pixels == len(found)
    with RecordingReader(tmp_path / "r.h5") as reader:
        intervals = list(calibration_intervals(reader))
        assert intervals[0][2].bad_pixels == ()
        assert intervals[-1][2].bad_pixels == found
        processor = FrameProcessor("again", reader.info.description, "cpu")
        result = compare(reader, processor, 7)
        assert result.same, result
        assert result.peaks > 100
        # With another calibration in their place, the bad pixels stay masked.
        other = list(calibration_intervals(reader, ActiveCalibration("c3", nominal(3.0))))
        assert [one.bad_pixels for *_, one in other] == [one.bad_pixels for *_, one in intervals]


def test_masking_changes_the_peaks_beside_the_pixel_and_keeps_tracks() -> None:
    description = SimulatedDriver("sim", SETTINGS).description
    processor = FrameProcessor("sim", description, "cpu")
    active = ActiveCalibration("c1", nominal())
    processor.set_calibration(active)
    seen = frames(1)
    before = processor.process(seen).peaks
    beside = round(float(before.position_px[1, 0])) + 1
    prepared = processor._prepared
    bad = LiveBadPixel(description.sensors[1].name, beside, "hot", SINCE)
    processor.set_calibration(replace(active, bad_pixels=(bad,)))
    assert processor._prepared is prepared
    after = processor.process(seen).peaks
    assert not before.flags.any()
    assert np.flatnonzero(after.flags[:, 0] & PeakFlag.MASKED_PIXELS).tolist() == [1]
    others = [0, 2, 3]
    assert after.position_px[others].tobytes() == before.position_px[others].tobytes()
    assert 0.0 < abs(after.position_px[1, 0] - before.position_px[1, 0]) < 0.2
    processor.set_calibration(active)
    assert processor.process(seen).peaks.position_px.tobytes() == before.position_px.tobytes()


def test_pixel_of_no_sensor_is_refused() -> None:
    description = SimulatedDriver("sim", SETTINGS).description
    processor = FrameProcessor("sim", description, "cpu")
    name = description.sensors[0].name
    for wrong in (LiveBadPixel("other", 1, "hot", SINCE), LiveBadPixel(name, 2048, "hot", SINCE)):
        with pytest.raises(InvalidParameter, match=r"other|2048"):
            processor.set_calibration(ActiveCalibration(bad_pixels=(wrong,)))
    assert processor.active_calibration.bad_pixels == ()


def test_bad_pixels_come_back_from_a_recordings_document() -> None:
    found = (LiveBadPixel("s1", 7, "stuck", SINCE),)
    for active in (
        ActiveCalibration(bad_pixels=found),
        ActiveCalibration("c", nominal(), bad_pixels=found),
    ):
        document, table = dump_active_calibration(active)
        kept = load_active_calibration(document, table, "r")
        assert (kept.bad_pixels, kept.calibration_id) == (found, active.calibration_id)
    with pytest.raises(InvalidRecording, match="bad pixels"):
        load_active_calibration(document.replace(b'"stuck"', b'"odd"'), table, "r")
