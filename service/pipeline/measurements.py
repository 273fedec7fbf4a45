"""PipelineMeasurements: the usable peaks of frames with their standard deviations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.measurement_noise import MeasurementNoise
from compute.signal.peaks import PeakBatch, PeakFlag

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PeakFlagPolicy:
    """What flags of peaks mean for points.

    Args:
        unusable: such a peak is taken as not seen.
        doubtful: a point of such a peak is flagged.
    """

    unusable: PeakFlag
    suspect: PeakFlag


@dataclass(frozen=True, eq=False)
class PipelineMeasurements:
    """Up to K peaks of each of S sensors in F frames.

    Args:
        position_px: shape (F, S, K) [px]; NaN: no peak, or none to be used.
        sigma_px: standard deviation, the calibration's misfit included where no correction table
            takes it away, shape (F, S, K) [px].
        flags: PeakFlag values, 0 where there is no peak, int32, shape (F, S, K).
        amplitude: shape (F, S, K) [counts].
        doubtful_px: the positions of those that a point is doubtful for, else NaN, (F, S, K).
    """

    position_px: Array
    sigma_px: Array
    flags: NDArray[np.int32]
    amplitude: NDArray[np.floating]
    suspect_px: Array

    @classmethod
    def of(
        cls,
        trust: MeasurementNoise,
        frames: int,
        peaks: PeakBatch,
        use: PeakFlagPolicy,
        *,
        corrected: bool,
    ) -> "PipelineMeasurements":
        """Return those of so many frames.

        Args:
            trust: what the active calibration says of its S sensors' readings.
            frames: their number F.
            peaks: of their F x S lines.
            use: which of them are used, and which doubted.
            corrected: whether a correction table is active.
        """
        shape = (frames, len(trust.sensor_sigma_px), -1)
        position = peaks.position_px.reshape(shape).astype(np.float64)
        flags = np.where(np.isfinite(position), peaks.flags.reshape(shape), 0).astype(np.int32)
        suspect = np.full(position.shape, np.nan)
        if np.count_nonzero(flags):
            position[(flags & int(use.unusable)) != 0] = np.nan
            np.copyto(suspect, position, where=(flags & int(use.suspect)) != 0)
        # By frame, peak and sensor for the calibration's figures, which are by sensor.
        own = peaks.sigma_px.reshape(shape).astype(np.float64).transpose(0, 2, 1)
        spread = trust.sigma(own)
        if corrected:
            # The calibration's misfit, which would widen them, is what the table takes away.
            spread = np.where(np.isfinite(own), own, spread)
        amplitude = peaks.amplitude.reshape(shape)
        return cls(position, spread.transpose(0, 2, 1), flags, amplitude, suspect)
