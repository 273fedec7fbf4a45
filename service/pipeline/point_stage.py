"""Point stage: correspondence of measurements, then triangulation to points with covariance."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.correspondence import group_peaks
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.signal.peaks import PeakBatch, PeakFlag
from hardware.line_frame import LineFrame
from service.pipeline.active_calibration import PreparedCalibration
from service.pipeline.measurements import PeakFlagPolicy, PipelineMeasurements

Array = NDArray[np.float64]


MAX_SIMULTANEOUS_MARKERS: Final = 12
"""Peaks of a sensor up to which markers lit together are told apart, in some milliseconds a frame.
On four sensors more of them are mostly ambiguous, and take longer than frames come."""


def no_points(sensors: int) -> PointBatch:
    """Return an empty batch of points for this number of sensors."""
    return PointBatch(
        np.empty((0, 3)),
        np.empty((0, 3, 3)),
        np.empty(0),
        np.empty((0, sensors), dtype=np.bool_),
        np.empty(0, dtype=np.int32),
    )


def reconstruct_points(
    active: PreparedCalibration, frames: Sequence[LineFrame], peaks: PeakBatch, use: PeakFlagPolicy
) -> tuple[PointBatch, NDArray[np.intp]]:
    """Return the points of all frames and the frame that each belongs to.

    Args:
        active: the active calibration, of S sensors.
        frames: F frames.
        peaks: of their F x S lines.
        use: which of them are used, and which doubted.
    """
    return points_of(active, frames, usable_peaks(active, frames, peaks, use))


def usable_peaks(
    active: PreparedCalibration, frames: Sequence[LineFrame], peaks: PeakBatch, use: PeakFlagPolicy
) -> PipelineMeasurements:
    """Return the peaks that points are made of; arguments as of ``reconstruct_points``."""
    corrected = active.table_id is not None
    return PipelineMeasurements.of(active.trust, len(frames), peaks, use, corrected=corrected)


def points_of(
    active: PreparedCalibration, frames: Sequence[LineFrame], usable: PipelineMeasurements
) -> tuple[PointBatch, NDArray[np.intp]]:
    """Return the points of usable peaks, and the frame that each belongs to."""
    position, spread = usable.position_px, usable.sigma_px
    strobed, strobed_sigma = _select_brightest(position, spread, usable.amplitude)
    if all(frame.marker is not None for frame in frames):
        owners = np.arange(len(frames), dtype=np.intp)
        points = active.solver.solve(strobed, strobed_sigma)
        return _flag_ambiguous(points, strobed, usable, owners, []), owners
    rows: list[Array] = []
    sigmas: list[Array] = []
    owner: list[int] = []
    ambiguous: list[bool] = []
    few = (np.isfinite(position).sum(axis=2).max(axis=1) <= MAX_SIMULTANEOUS_MARKERS).tolist()
    for index, frame in enumerate(frames):
        if frame.marker is not None:
            rows.append(strobed[index])
            sigmas.append(strobed_sigma[index])
            owner.append(index)
            ambiguous.append(False)
            continue
        found = group_peaks(
            active.solver.solve,
            position[index],
            spread[index],
            predict=active.predictor if few[index] else None,
            merged=(usable.flags[index] & int(PeakFlag.MERGED)) != 0,
        )
        rows.extend(found.readings_px)
        sigmas.extend(found.sigma_px)
        owner.extend([index] * len(found.readings_px))
        ambiguous.extend(found.ambiguous.tolist())
    if not rows:
        return no_points(position.shape[1]), np.empty(0, dtype=np.intp)
    readings, owners = np.array(rows), np.array(owner, dtype=np.intp)
    points = active.solver.solve(readings, np.array(sigmas))
    return _flag_ambiguous(points, readings, usable, owners, ambiguous), owners


def _select_brightest(
    position: Array, spread: Array, amplitude: NDArray[np.floating]
) -> tuple[Array, Array]:
    """Return the brightest peak of each sensor and its deviation, (F, S) each.

    A strobed exposure shows one marker: the brightest peak is it, weaker ones are reflections.
    """
    if position.shape[2] == 1:
        return position[..., 0], spread[..., 0]
    brightest = np.where(np.isfinite(position), amplitude, -1.0).argmax(axis=2)
    frames, sensors, _ = position.shape
    at = np.arange(frames)[:, None], np.arange(sensors), brightest
    return position[at], spread[at]


def _flag_ambiguous(
    points: PointBatch,
    readings: Array,
    usable: PipelineMeasurements,
    owner: NDArray[np.intp],
    ambiguous: Sequence[bool],
) -> PointBatch:
    """Return the points with their flags: ambiguous ones, and those of doubtful peaks."""
    flags = points.flags
    if any(ambiguous):
        flags = flags | np.where(ambiguous, int(PointFlag.AMBIGUOUS), 0)
    if np.count_nonzero(np.isfinite(usable.suspect_px)):
        # Each against its own frame's: what else is in the batch must not matter.
        suspect = usable.suspect_px[owner]
        from_doubtful = (readings[..., None] == suspect).any(axis=(1, 2))
        flags = flags | np.where(from_doubtful, int(PointFlag.SUSPECT_PEAK), 0)
    return points if flags is points.flags else replace(points, flags=flags.astype(np.int32))
