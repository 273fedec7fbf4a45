"""Points of frames from the peaks of their lines: who belongs together, and where it is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration
from compute.calibration.weights import reading_sigma
from compute.reconstruction.correspondence import group_peaks
from compute.reconstruction.estimate import PointBatch, PointFlag
from compute.reconstruction.solver import PointSolver
from compute.signal.peaks import PeakBatch, PeakFlag
from hardware.frame import LineFrame

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ActiveCalibration:
    """A calibration in the form that the live path uses, with its correction table, if any."""

    calibration_id: str
    calibration: Calibration
    table_id: str | None
    solver: PointSolver


@dataclass(frozen=True)
class PeakUse:
    """What flags of peaks mean for points.

    Args:
        unusable: such a peak is taken as not seen.
        doubtful: a point of such a peak is flagged.
    """

    unusable: PeakFlag
    doubtful: PeakFlag


def no_points(sensors: int) -> PointBatch:
    """Return the batch of no points, of so many sensors."""
    return PointBatch(
        np.empty((0, 3)),
        np.empty((0, 3, 3)),
        np.empty(0),
        np.empty((0, sensors), dtype=np.bool_),
        np.empty(0, dtype=np.int32),
    )


def frame_points(
    active: ActiveCalibration, frames: Sequence[LineFrame], peaks: PeakBatch, use: PeakUse
) -> tuple[PointBatch, NDArray[np.intp]]:
    """Return the points of all frames and the frame that each belongs to.

    Args:
        active: the calibration in force, of S sensors.
        frames: F frames.
        peaks: of their F x S lines.
        use: which of them are used, and which doubted.
    """
    sensors = len(active.calibration.sensors)
    shape = (len(frames), sensors, -1)
    position = peaks.position_px.reshape(shape).astype(np.float64)
    flags = np.where(np.isfinite(position), peaks.flags.reshape(shape), 0)
    position[(flags & use.unusable) != 0] = np.nan
    doubtful = np.where((flags & use.doubtful) != 0, position, np.nan)
    # By frame, peak and sensor for the calibration's figures, which are by sensor.
    own = peaks.sigma_px.reshape(shape).astype(np.float64).transpose(0, 2, 1)
    spread = reading_sigma(active.calibration, own, own)
    if active.table_id is not None:
        # The calibration's misfit, which would widen them, is what the table takes away.
        spread = np.where(np.isfinite(own), own, spread)
    spread = spread.transpose(0, 2, 1)
    amplitude = peaks.amplitude.reshape(shape)
    rows: list[Array] = []
    sigmas: list[Array] = []
    owner: list[int] = []
    ambiguous: list[bool] = []
    # A strobed exposure shows one marker: the brightest peak is it, weaker ones are reflections.
    brightest = np.where(np.isfinite(position), amplitude, -1.0).argmax(axis=2)[..., None]
    strobed = np.take_along_axis(position, brightest, axis=2)[..., 0]
    strobed_sigma = np.take_along_axis(spread, brightest, axis=2)[..., 0]
    for index, frame in enumerate(frames):
        if frame.marker is not None:
            rows.append(strobed[index])
            sigmas.append(strobed_sigma[index])
            owner.append(index)
            ambiguous.append(False)
            continue
        found = group_peaks(active.solver.solve, position[index], spread[index])
        rows.extend(found.readings_px)
        sigmas.extend(found.sigma_px)
        owner.extend([index] * len(found.readings_px))
        ambiguous.extend(found.ambiguous.tolist())
    if not rows:
        return no_points(sensors), np.empty(0, dtype=np.intp)
    readings, deviations = np.array(rows), np.array(sigmas)
    points = active.solver.solve(readings, deviations)
    found_flags = np.where(ambiguous, int(PointFlag.AMBIGUOUS), 0)
    if np.isfinite(doubtful).any():
        # Each against its own frame's: what else is in the batch must not matter.
        from_doubtful = (readings[..., None] == doubtful[owner]).any(axis=(1, 2))
        found_flags |= np.where(from_doubtful, int(PointFlag.DOUBTFUL_PEAK), 0)
    points = replace(points, flags=(points.flags | found_flags).astype(np.int32))
    return points, np.array(owner, dtype=np.intp)
