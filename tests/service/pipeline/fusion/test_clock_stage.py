"""Fused frames through the stages: points, their covariance, and clocks that are refined."""

import numpy as np
import pytest

from compute.reconstruction.point_batch import PointFlag
from service.pipeline.detection_stage import peak_method
from service.pipeline.frame_processor import FrameProcessor
from service.pipeline.fusion.assembler import FusionAssembler
from service.pipeline.tracking_config import TrackingConfig
from tests.oracles.two_bars import course
from tests.service.pipeline.fusion.two_bars import (
    DESCRIPTION,
    PERIOD_NS,
    START_NS,
    active_calibration,
    bar_frame,
)

LATE_NS = 60_000
SPEED_MM_S = 2000.0


def fused_frames(count: int, late_ns: int, clock_sigma_s: float, speed_mm_s: float):
    rng = np.random.default_rng(6)
    made = FusionAssembler("hall", [4, 4], 0.0, clock_sigma_s)
    for bar in (0, 1):
        made.set_away(bar, away=False)
    frames = []
    for number in range(count):
        time_ns = number * PERIOD_NS
        made.add(1, bar_frame(1, time_ns + 800_000, 0.0, speed_mm_s, late_ns, rng))
        if number:
            # The other bar has its exposures by then.
            made.add(0, bar_frame(0, time_ns - PERIOD_NS, 0.0, speed_mm_s, 0, rng))
            frames += made.take(-1.0)
    return frames


def errors(frames, batch) -> np.ndarray:
    at_s = [1e-9 * (frame.exposure_host_ns - START_NS) for frame in frames]
    return batch.points.position_mm - course(np.array(at_s), SPEED_MM_S)


@pytest.fixture(scope="module")
def active():
    return active_calibration()


def test_a_clock_that_is_late_is_found_and_its_points_are_right(active) -> None:
    frames = fused_frames(500, LATE_NS, 100e-6, SPEED_MM_S)
    processor = FrameProcessor("hall", DESCRIPTION, "cpu")
    processor.set_calibration(active)
    assert peak_method(DESCRIPTION) == processor.detection.method == "fused"
    assert processor.detection.reads
    batches = [processor.process(frames[n : n + 20]) for n in range(0, 480, 20)]
    first, last = batches[0], batches[-1]
    off = [np.sqrt((errors(frames[:20], first)[2:] ** 2).sum(axis=1).mean())]
    off.append(np.sqrt((errors(frames[460:480], last) ** 2).sum(axis=1).mean()))
    # 60 us at 2 m/s are 120 mm/ms: 60 um by half of the sensors.
    assert off[1] < off[0]
    stated = [np.trace(batch.points.covariance_mm2[-1]) for batch in (first, last)]
    assert stated[1] < 0.3 * stated[0]
    error = errors(frames[460:480], last)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(last.points.covariance_mm2), error).mean()
    assert 1.0 < nees < 6.0
    assert not (last.points.flags & int(PointFlag.INCONSISTENT)).any()


def test_a_clock_that_contradicts_what_is_stated_is_named(active) -> None:
    frames = fused_frames(500, 3 * LATE_NS, 10e-6, SPEED_MM_S)
    processor = FrameProcessor("hall", DESCRIPTION, "cpu")
    processor.set_calibration(active)
    remarks = []
    for n in range(0, 480, 20):
        processor.process(frames[n : n + 20])
        remarks.append(processor.remark)
    assert remarks[0] is None
    assert '"right" is off by' in str(remarks[-1])
    assert "clock_uncertainty_us" in str(remarks[-1])


def test_without_an_uncertainty_clocks_are_taken_as_they_are(active) -> None:
    frames = fused_frames(60, LATE_NS, 0.0, SPEED_MM_S)
    processor = FrameProcessor("hall", DESCRIPTION, "cpu")
    processor.set_calibration(active)
    batch = processor.process(frames[20:50])
    error = errors(frames[20:50], batch)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(batch.points.covariance_mm2), error)
    assert nees.mean() > 6.0


def test_tracks_have_the_clocks_share_too(active) -> None:
    frames = fused_frames(60, 0, 100e-6, SPEED_MM_S)
    traces = []
    for sigma_s in (0.0, 100e-6):
        for frame in frames:
            frame.clock_sigma_s[:] = sigma_s
        processor = FrameProcessor("hall", DESCRIPTION, "cpu")
        processor.set_calibration(active)
        processor.set_tracking_config(TrackingConfig(tracks=True))
        for frame in frames:
            batch = processor.process([frame])
        assert batch.motion is not None
        assert len(batch.motion.tracks) == 1
        traces.append(np.trace(batch.motion.tracks.covariance[0, :3, :3]))
    assert traces[1] > 3.0 * traces[0]


def test_the_same_frames_give_the_same_bits(active) -> None:
    frames = fused_frames(200, LATE_NS, 100e-6, SPEED_MM_S)
    found = []
    for _ in range(2):
        processor = FrameProcessor("hall", DESCRIPTION, "cpu")
        processor.set_calibration(active)
        batches = [processor.process(frames[n : n + 16]) for n in range(0, 192, 16)]
        found.append(np.concatenate([batch.points.position_mm for batch in batches]))
    np.testing.assert_array_equal(*found)
