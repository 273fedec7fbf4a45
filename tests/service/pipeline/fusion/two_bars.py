"""Frames of two bars of the oracle's hall, as fused devices take them."""

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.camera.model import SensorGeometry
from compute.signal.peaks import PeakBatch
from hardware.driver import DeviceDescription, SensorDescription
from hardware.line_frame import LineFrame
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.fusion.assembler import BarFrame
from tests.oracles.two_bars import CENTRE, course, read, sensors

Array = NDArray[np.float64]

SIGMA_PX = 0.05
PERIOD_NS = 2_000_000
START_NS = 1_790_000_000_000_000_000
NAMES = tuple(f"{bar}.s{number}" for bar in ("left", "right") for number in range(4))
DESCRIPTION = DeviceDescription(
    "hall",
    tuple(SensorDescription(name, 2048, 12.0) for name in NAMES),
    1e9 / PERIOD_NS,
    16,
    1.0,
    0.0,
    0.0,
    1,
    readout="bar-peaks",
)


def peak_batch(readings: Array, sigma_px: float = SIGMA_PX) -> PeakBatch:
    """One peak a scan; NaN: none."""
    peaks = PeakBatch.empty(len(readings), 1)
    seen = np.isfinite(readings)
    peaks.count[:] = seen
    peaks.position_px[:, 0] = readings
    peaks.sigma_px[seen, 0] = sigma_px
    peaks.amplitude[seen, 0] = 1000.0
    peaks.width_px[seen, 0] = 6.0
    return peaks


def bar_frame(
    bar: int,
    time_ns: int,
    arrived_s: float,
    speed_mm_s: float = 500.0,
    stated_late_ns: int = 0,
    rng: np.random.Generator | None = None,
    marker: int | None = 0,
) -> BarFrame:
    """What a bar sees of the marker of the oracle's course; times from the start on."""
    own = sensors()[4 * bar : 4 * bar + 4]
    position = course(np.array([1e-9 * time_ns]), speed_mm_s)
    readings = read(own, position)[0]
    if rng is not None:
        readings = readings + SIGMA_PX * rng.standard_normal(4)
    stated_ns = START_NS + time_ns + stated_late_ns
    frame = LineFrame(
        ("left", "right")[bar], 0, time_ns, stated_ns, marker, np.empty((0, 0), np.uint16)
    )
    return BarFrame(frame, peak_batch(readings), stated_ns, 0.0, arrived_s)


def active_calibration() -> ActiveCalibration:
    """A joint calibration of both bars, by control points that both saw."""
    rng = np.random.default_rng(3)
    points = CENTRE + rng.uniform(-400.0, 400.0, (60, 3))
    readings = read(sensors(), points) + 0.003 * rng.standard_normal((60, 8))
    known = calibrate(
        points,
        readings,
        [SensorGeometry(name, 2048) for name in NAMES],
        np.full(readings.shape, 0.003),
    )
    return ActiveCalibration("joint", known)
