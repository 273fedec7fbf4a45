"""Deterministic frame blocks with results for tests of recordings."""

from pathlib import Path

import numpy as np

from hardware.driver import DeviceDescription, SensorDescription
from hardware.recording.frame_block import FrameBlock
from hardware.recording.layout import FRAME, NO_CALIBRATION_ROW, PEAK, RecordingInfo, point_dtype
from hardware.recording.reader import RecordingReader

SENSORS, PIXELS = 2, 24


def described() -> DeviceDescription:
    return DeviceDescription(
        name="bar",
        sensors=tuple(SensorDescription(f"s{n}", PIXELS, 12.0) for n in range(SENSORS)),
        frame_rate_hz=1000.0,
        bits=12,
        electrons_per_count=12.5,
        read_noise_electrons=30.0,
        offset_counts=64.0,
        markers=0,
    )


def block(first: int, frames: int, calibration_row: int = NO_CALIBRATION_ROW) -> FrameBlock:
    """Frames of these sequence numbers; frame n has n % 3 peaks and n % 2 points."""
    number = np.arange(first, first + frames)
    rows = np.zeros(frames, FRAME)
    rows["sequence"] = number
    rows["exposure_device_ns"] = number * 1_000_000
    rows["exposure_host_ns"] = 5 + number * 1_000_000
    rows["marker"] = -1
    rows["active_calibration"] = calibration_row
    rows["peaks"], rows["points"] = number % 3, number % 2
    peaks = np.zeros(int(rows["peaks"].sum()), PEAK)
    peaks["frame"] = np.repeat(np.arange(frames), rows["peaks"])
    peaks["position_px"] = np.repeat(number, rows["peaks"]) + 1 / 7
    peaks["sensor"][1:] = peaks["frame"][1:] == peaks["frame"][:-1]
    points = np.zeros(int(rows["points"].sum()), point_dtype(SENSORS))
    points["frame"] = np.repeat(np.arange(frames), rows["points"])
    points["position_mm"] = np.repeat(number, rows["points"])[:, None] / (3.0, 7.0, 11.0)
    return FrameBlock(rows, lines(number), peaks, points)


def lines(number: np.ndarray) -> np.ndarray:
    pixel = np.arange(SENSORS * PIXELS).reshape(SENSORS, PIXELS)
    return ((number[:, None, None] * 31 + pixel) % 65536).astype(np.uint16)


def joined(blocks: list[FrameBlock]) -> FrameBlock:
    """One block of several."""
    starts = np.cumsum([0] + [len(one.rows) for one in blocks])
    peaks, points = [], []
    for one, start in zip(blocks, starts, strict=False):
        for kept, found in ((peaks, one.peaks.copy()), (points, one.points.copy())):
            found["frame"] += start
            kept.append(found)
    return FrameBlock(
        np.concatenate([one.rows for one in blocks]),
        np.concatenate([one.lines for one in blocks]),
        np.concatenate(peaks),
        np.concatenate(points),
    )


def assert_same_block(found: FrameBlock, expected: FrameBlock) -> None:
    for name in ("rows", "peaks", "points"):
        assert getattr(found, name).tobytes() == getattr(expected, name).tobytes(), name
    assert (found.lines is None) == (expected.lines is None)
    if found.lines is not None:
        np.testing.assert_array_equal(found.lines, expected.lines)


def read_recording(path: Path) -> RecordingInfo:
    """Return the contents of a recording, after its validation."""
    with RecordingReader(path) as recording:
        return recording.info
