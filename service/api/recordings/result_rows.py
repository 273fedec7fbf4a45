"""Rows of peaks and points that a recording stores of a batch."""

import numpy as np
from numpy.typing import NDArray

from compute.signal.peaks import PeakBatch
from hardware.recording.layout import PEAK, point_dtype
from service.pipeline.frame_batch import FrameBatch

_OF_PEAKS = (
    "flags",
    "position_px",
    "sigma_px",
    "amplitude",
    "width_px",
    "reduced_chi2",
    "covariance_px2",
)


def peak_rows(peaks: PeakBatch, sensors: int) -> tuple[NDArray[np.void], NDArray[np.intp]]:
    """Return the peaks of F frames as rows of PEAK, and how many each frame has, shape (F,)."""
    count = peaks.count
    total = int(count.sum())
    line = np.repeat(np.arange(len(count)), count)
    number = np.arange(total) - np.repeat(np.cumsum(count) - count, count)
    rows = np.empty(total, PEAK)
    rows["frame"], rows["sensor"] = np.divmod(line, sensors)
    for name in _OF_PEAKS:
        rows[name] = getattr(peaks, name)[line, number]
    return rows, count.reshape(-1, sensors).sum(axis=1)


def point_rows(batch: FrameBatch) -> tuple[NDArray[np.void], NDArray[np.intp]]:
    """Return the points of F frames as rows, and how many each frame has, shape (F,)."""
    points = batch.points
    rows = np.empty(len(points), point_dtype(len(batch.sensor_names)))
    rows["frame"] = batch.owner
    for name in ("position_mm", "covariance_mm2", "chi2", "flags", "used"):
        rows[name] = getattr(points, name)
    return rows, np.bincount(batch.owner, minlength=len(batch.frames))
