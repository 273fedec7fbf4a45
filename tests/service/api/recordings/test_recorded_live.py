"""What is recorded live is what the same lines give again: every bit, in batches of any size."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest

from compute.calibration.result import Calibration
from compute.errors import InvalidRecording
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable
from hardware.line_frame import LineFrame
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from hardware.replay import ReplayDriver
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import StillPoints
from hardware.simulated.settings import SimulationSettings
from service.api.calibrations.calibration_content import content_hash
from service.api.correction_tables.hdf5_file import write_table
from service.api.correction_tables.table_content import TableContent
from service.api.recordings.active_calibration_file import (
    dump_active_calibration,
    load_active_calibration,
)
from service.api.recordings.recording_manager import RecordingManager
from service.api.recordings.reprocessing import compare, recorded_calibration, reprocess
from service.api.recordings.result_rows import point_rows
from service.api.recordings.schema import NewRecording
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_processor import FrameProcessor
from service.pipeline.pipeline_manager import MIN_RING_FRAMES, PipelineManager
from service.problems.errors import DeviceNotRunning, RecordingExists, RecordingInProgress
from service.protocols.stream.hub import Hub
from tests.service.pipeline.test_pipeline_manager import nominal

THREE = StillPoints(points_mm=((0.0, 0.0, 1500.0), (50.0, 60.0, 1400.0), (-80.0, 30.0, 1600.0)))


class Gate:
    """A driver that sends nothing before its gate is open."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.gate = Event()

    def frames(self) -> Iterator[LineFrame]:
        self.gate.wait(30.0)
        frames: Iterator[LineFrame] = super().frames()  # type: ignore[misc]
        return frames


class Gated(Gate, SimulatedDriver):
    """The simulator behind a gate."""


class GatedReplay(Gate, ReplayDriver):
    """A recording behind a gate."""


@pytest.fixture(scope="module")
def live() -> Iterator[PipelineManager]:
    manager = PipelineManager(Hub(), "cpu")
    yield manager
    manager.close()


@pytest.fixture
def recordings(live: PipelineManager, tmp_path: Path) -> Iterator[RecordingManager]:
    made = RecordingManager(live, tmp_path, flush_s=0.05)
    yield made
    made.close()


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.005)


def mapped(calibration: Calibration) -> ActiveCalibration:
    """The calibration with a table, as they come out of the database."""
    result = json.loads(dump_active_calibration(ActiveCalibration("c", calibration))[0])["result"]
    content = {"device": "sim", "result": result, "points": [], "provenance": "nominal"}
    grid = VoxelGrid((-500.0, -500.0, 1000.0), (250.0, 250.0, 250.0), (4, 4, 4))
    names = tuple(model.name for model in calibration.models)
    rng = np.random.default_rng(3)
    table = CorrectionTable(
        names,
        content_hash(content),
        grid,
        3,
        rng.normal(0.0, 0.3, (len(names), 7, 7, 7)),
        np.full((len(names), 5, 5, 5), 1e-4),
        np.ones((len(names), 4, 4, 4), dtype=np.bool_),
    )
    file = write_table(TableContent(table, "sim", datetime(2026, 1, 2, tzinfo=UTC), {}, {}))
    return ActiveCalibration("c2", calibration, "t1", table, content, content_hash(content), file)


def record(
    live: PipelineManager,
    recordings: RecordingManager,
    settings: SimulationSettings,
    **request: object,
) -> Path:
    """Record a device over a change of its calibration, to one with a table, and back."""
    live.start_device("sim", SimulatedDriver("sim", settings), ActiveCalibration("c1", nominal()))
    try:
        recordings.start("sim", NewRecording(id="r.h5", **request))
        path = recordings.library.path("r.h5")
        first = recordings.get("r.h5")
        assert (first.state, first.device_id) == ("recording", "sim")
        for found in (None, mapped(nominal(2.0)), ActiveCalibration()):
            if found is not None:
                live.set_calibration("sim", found)
            processed_before = live.status("sim").frames_processed
            wait_for(lambda seen=processed_before: live.status("sim").frames_processed > seen + 50)
        done = recordings.stop("r.h5")
        # A busy machine may lose exposures: then somebody has counted them.
        lost = live.status("sim").frames_lost
    finally:
        live.stop_device("sim")
    assert (done.state, done.reason) == ("complete", "stopped by request")
    assert done.frames_refused == 0
    dropped = (done.frames_dropped_compute or 0) + (done.frames_dropped_writer or 0)
    assert (done.frames_missing or 0) <= lost + dropped
    assert [(one.calibration_id, one.table_id) for one in done.calibrations] == [
        ("c1", None),
        ("c2", "t1"),
    ]
    return path


@pytest.mark.slow
@pytest.mark.parametrize("illumination", ["strobed", "simultaneous"])
def test_a_recording_gives_the_same_bits_again(
    live: PipelineManager, recordings: RecordingManager, illumination: str
) -> None:
    settings = SimulationSettings(
        frame_rate_hz=400.0, scene=THREE, illumination=illumination, read_noise_electrons=200.0
    )
    path = record(live, recordings, settings)
    with RecordingReader(path) as reader:
        frames = reader.info.frames
        rows = reader.column("active_calibration")
        assert sorted(set(rows.tolist())) == [-1, 0, 1]
        points = reader.block(0, frames).points
        processor = FrameProcessor("again", reader.info.description, "cpu")
        for batch_frames in (64, 5):
            found = compare(reader, processor, batch_frames)
            assert found.same, found
            assert (found.frames, found.settings_differ) == (frames, ())
        assert found.points == len(points) > 100
        # The comparison sees a change in the least bit of a calibration, and another table.
        used = recorded_calibration(reader, 1)
        made = np.concatenate(
            [point_rows(batch)[0] for batch in reprocess(reader, processor, given=used)]
        )
        assert made.tobytes() != points.tobytes()


@pytest.mark.slow
def test_a_changed_recording_does_not_compare(
    live: PipelineManager, recordings: RecordingManager
) -> None:
    settings = SimulationSettings(frame_rate_hz=400.0, scene=THREE)
    live.start_device("sim", SimulatedDriver("sim", settings), ActiveCalibration("c1", nominal()))
    recordings.start("sim", NewRecording(id="r.h5"))
    with pytest.raises(RecordingInProgress, match="is being recorded to"):
        recordings.start("sim", NewRecording(id="other.h5"))
    with pytest.raises(RecordingInProgress, match="is being written"):
        recordings.finished_path("r.h5")
    wait_for(lambda: (recordings.get("r.h5").frames_written or 0) > 50)
    live.stop_device("sim")
    wait_for(lambda: recordings.get("r.h5").state == "complete")
    assert recordings.get("r.h5").reason == "the device was stopped"
    with pytest.raises(DeviceNotRunning):
        recordings.start("sim", NewRecording(id="other.h5"))
    with RecordingReader(recordings.finished_path("r.h5")) as reader:
        processor = FrameProcessor("again", reader.info.description, "cpu")

        def shifted(row: int) -> ActiveCalibration:
            return ActiveCalibration("c1", nominal(1e-9))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                "service.api.recordings.reprocessing.recorded_calibration",
                lambda _, row: shifted(row),
            )
            found = compare(reader, processor)
    assert (found.peaks_differ, found.same) == (0, False)
    assert found.points_differ > 0
    assert found.first_difference is not None
    assert found.first_difference.endswith("in its points")


def test_a_source_that_ends_ends_its_recording_with_its_last_frame(
    live: PipelineManager, recordings: RecordingManager
) -> None:
    settings = SimulationSettings(frame_rate_hz=500.0, duration_s=0.6, scene=THREE, realtime=False)
    driver = Gated("sim", settings)
    live.start_device("sim", driver, ActiveCalibration("c1", nominal()))
    recordings.start("sim", NewRecording(id="r.h5", contents=frozenset({"results"})))
    driver.gate.set()
    wait_for(lambda: recordings.get("r.h5").state == "complete")
    found = recordings.get("r.h5")
    assert found.reason == "the device has ended: the source has no more frames"
    assert found.contents == ["results"]
    with RecordingReader(recordings.finished_path("r.h5")) as reader:
        assert reader.column("sequence").tolist() == list(range(300))
        processor = FrameProcessor("again", reader.info.description, "cpu")
        with pytest.raises(InvalidRecording, match="results only"):
            compare(reader, processor)
    live.start_device("sim", SimulatedDriver("sim", settings), ActiveCalibration())
    with pytest.raises(RecordingExists, match="never overwritten"):
        recordings.start("sim", NewRecording(id="r.h5"))
    live.stop_device("sim")


def test_what_was_in_force_comes_back_and_a_change_of_it_is_found() -> None:
    given = mapped(nominal())
    document, table = dump_active_calibration(given)
    found = load_active_calibration(document, table, "r.h5")
    assert found.calibration == given.calibration
    assert (found.calibration_hash, found.table_id) == (given.calibration_hash, "t1")
    assert found.table is not None
    assert found.table_file == given.table_file
    changed = document.replace(b'"provenance": "nominal"', b'"provenance": "measured"')
    assert changed != document
    with pytest.raises(InvalidRecording, match="changed after it was written"):
        load_active_calibration(changed, table, "r.h5")
    with pytest.raises(InvalidRecording, match="a calibration that is none"):
        load_active_calibration(b'{"result": {}}', b"", "r.h5")


def test_a_replay_as_fast_as_taken_drops_nothing(live: PipelineManager, tmp_path: Path) -> None:
    """More frames than the ring holds, handed over at once."""
    settings = SimulationSettings(
        frame_rate_hz=100.0, duration_s=1.0, realtime=False, peaks="centroid"
    )
    driver = SimulatedDriver("sim", settings)
    driver.open()
    with RecordingWriter(tmp_path / "r.h5", driver.description) as writer:
        seen = list(driver.frames())
        for sequence in range(1000):
            frame = replace(seen[sequence % 100], sequence=sequence, marker=None)
            writer.append(replace(frame, exposure_device_ns=sequence * 10**7))
    replay = GatedReplay("tape", tmp_path / "r.h5", speed=None)
    live.start_device("tape", replay)
    held = Event()
    live._compute.submit(lambda: held.wait(30.0))
    replay.gate.set()
    wait_for(lambda: live.status("tape").frames_received >= MIN_RING_FRAMES)
    time.sleep(0.2)  # time to send the rest, if it does not wait
    held.set()
    wait_for(lambda: live.status("tape").state == "ended")
    wait_for(lambda: live.status("tape").frames_processed == 1000)
    assert live.status("tape").frames_dropped_compute == 0
