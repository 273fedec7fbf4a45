"""Point stage: peaks to measurements, correspondence, triangulation to points with covariance."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.flag_policy import FlagPolicy
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.grouping import group_peaks
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.signal.peaks import PeakBatch
from hardware.line_frame import LineFrame
from service.pipeline.active_calibration import PreparedCalibration

MAX_SIMULTANEOUS_MARKERS: Final = 12
"""Peaks of a sensor up to which markers lit together are told apart, in some milliseconds a frame.
On four sensors more of them are mostly ambiguous, and take longer than frames come."""


def weigh_peaks(
    active: PreparedCalibration, frames: Sequence[LineFrame], peaks: PeakBatch, policy: FlagPolicy
) -> Measurements:
    """Return the measurements of F frames, by which points, tracks and tools are found.

    The calibration's misfit is in the standard deviations, where no correction table takes it
    away.

    Args:
        active: the active calibration, of S sensors.
        frames: F frames.
        peaks: peaks of their F x S scans, K a scan at most.
        policy: what the peaks' flags mean.

    Returns:
        Measurements of shape (F, S, K).
    """
    noise = active.measurement_noise
    shape = (len(frames), len(noise.sensor_sigma_px), -1)
    position, flags = peaks.position_px.reshape(shape), peaks.flags.reshape(shape)
    # By frame, peak and sensor for the calibration's figures, which are by sensor.
    own = peaks.sigma_px.reshape(shape).astype(np.float64).transpose(0, 2, 1)
    sigma = noise.sigma(own)
    if active.table_id is not None:
        # The calibration's misfit, which would widen them, is what the table takes away.
        sigma = np.where(np.isfinite(own), own, sigma)
    amplitude = peaks.amplitude.reshape(shape)
    return Measurements.weigh(position, sigma.transpose(0, 2, 1), flags, amplitude, policy)


def solve_points(
    active: PreparedCalibration, frames: Sequence[LineFrame], measurements: Measurements
) -> tuple[PointBatch, NDArray[np.intp]]:
    """Return the points of F frames, and the index of the frame that each belongs to.

    Args:
        active: the active calibration, of S sensors.
        frames: F frames.
        measurements: of the frames, shape (F, S, K).
    """
    strobed = [index for index, frame in enumerate(frames) if frame.marker is not None]
    parts: list[tuple[int, PointBatch]] = []
    if len(strobed) == len(frames):
        points = _solve_strobed(active, measurements)
        return points, np.arange(len(frames), dtype=np.intp)
    if strobed:
        points = _solve_strobed(active, measurements.exposure(np.array(strobed)))
        parts += [(frame, points.part(row, row + 1)) for row, frame in enumerate(strobed)]
    for index, frame in enumerate(frames):
        if frame.marker is None:
            parts.append((index, _solve_simultaneous(active, measurements.exposure(index))))
    parts.sort(key=lambda part: part[0])
    owner = np.repeat([index for index, _ in parts], [len(points) for _, points in parts])
    return PointBatch.concatenate([points for _, points in parts]), owner.astype(np.intp)


def _solve_strobed(active: PreparedCalibration, measurements: Measurements) -> PointBatch:
    """Return one point for each of the frames, which are all strobed.

    A strobed exposure shows one marker: the brightest peak is it, weaker ones are reflections.
    """
    position = measurements.position_px
    frames, sensors, peaks = position.shape
    # Indices into the flattened arrays: only the chosen peaks are read.
    at = np.arange(0, position.size, peaks).reshape(frames, sensors)
    if peaks > 1:
        light = np.where(measurements.usable, measurements.amplitude, -1.0)
        at += light.argmax(axis=2)
    points = active.solver.solve(position.take(at), np.sqrt(measurements.variance_px2.take(at)))
    if not np.count_nonzero(measurements.suspect):
        return points
    return _flag_points(points, None, measurements.suspect.take(at))


def _solve_simultaneous(active: PreparedCalibration, measurements: Measurements) -> PointBatch:
    """Return the points of a frame in which all markers are lit."""
    few = int(measurements.count.max(initial=0)) <= MAX_SIMULTANEOUS_MARKERS
    groups = group_peaks(active.solver.solve, measurements, model=active.model if few else None)
    suspect = measurements.suspect
    if not np.count_nonzero(suspect):
        return _flag_points(groups.points, groups.ambiguous, None)
    sensor = np.arange(len(measurements))
    chosen = suspect[sensor, groups.peaks] & (groups.peaks >= 0)
    return _flag_points(groups.points, groups.ambiguous, chosen)


def _flag_points(
    points: PointBatch, ambiguous: NDArray[np.bool_] | None, suspect: NDArray[np.bool_] | None
) -> PointBatch:
    """Return the points with the flags of ambiguous groups (N,) and suspect peaks (N, S)."""
    flags = points.flags
    if ambiguous is not None and ambiguous.any():
        flags = flags | np.where(ambiguous, int(PointFlag.AMBIGUOUS), 0)
    if suspect is not None and suspect.any():
        flags = flags | np.where(suspect.any(axis=1), int(PointFlag.SUSPECT_PEAK), 0)
    return points if flags is points.flags else replace(points, flags=flags.astype(np.int32))
