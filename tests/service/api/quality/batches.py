"""Batches of two strobed markers, 292 mm from one another, as the live side makes them."""

import numpy as np

from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.signal.peaks import PeakBatch
from hardware.line_frame import LineFrame
from service.pipeline.frame_batch import FrameBatch

SIGMA_MM = 0.02
LENGTH_MM = 292.0
NAMES = ("vertical", "horizontal", "diagonal-rising", "diagonal-falling")


def strobed_batch(
    sequences: range,
    calibration: str | None = "sim-nominal",
    table: str | None = None,
    shift_mm: float = 0.0,
    chi2: float = 1.0,
    lit_together: bool = False,
) -> FrameBatch:
    """Frames 1 ms apart; marker 0 stands at (-146, 0, 1500) + shift, marker 1 opposite.

    Strobed, even frames show marker 0 and odd ones marker 1; lit together each shows both.
    """
    count = len(sequences)
    lines = np.zeros((4, 8), np.uint16)
    owner = np.repeat(np.arange(count), 2 if lit_together else 1)
    which = np.tile([0, 1], count) if lit_together else np.array([n % 2 for n in sequences])
    frames = tuple(
        LineFrame("sim", n, n * 1_000_000, n * 1_000_000, None if lit_together else n % 2, lines)
        for n in sequences
    )
    size = len(which)
    position = np.zeros((size, 3))
    position[:, 0] = (2 * which - 1) * LENGTH_MM / 2 + shift_mm
    position[:, 2] = 1500.0
    position += np.random.default_rng(sequences.start).normal(0.0, SIGMA_MM, (size, 3))
    points = PointBatch(
        position,
        np.broadcast_to(SIGMA_MM**2 * np.eye(3), (size, 3, 3)).copy(),
        np.full(size, chi2),
        np.full(size, np.inf),
        np.ones((size, 4), dtype=np.bool_),
        np.zeros(size, np.int32),
    )
    if calibration is None:
        points.position_mm[:] = np.nan
        points.flags[:] = int(PointFlag.TOO_FEW_SENSORS)
    peaks = PeakBatch.empty(4 * count, 1)
    return FrameBatch("sim", NAMES, calibration, table, frames, peaks, points, owner)
