"""Grouping of peaks by the NumPy reconstruction, for tests."""

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidates import MatchSettings
from compute.reconstruction.correspondence.grouping import Correspondence, group_peaks
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import reconstruct
from compute.signal.peaks import PeakFlag

Array = NDArray[np.float64]


def merged_flags(merged: NDArray[np.bool_] | None) -> NDArray[np.int32] | None:
    """Return the flags of peaks, some of which are merged."""
    return None if merged is None else np.where(merged, PeakFlag.MERGED, 0).astype(np.int32)


def match_peaks(
    cameras: CameraStack,
    position_px: Array,
    sigma_px: Array,
    parameter_covariance: Array | None = None,
    corrections: CorrectionTable | None = None,
    *,
    merged: NDArray[np.bool_] | None = None,
    predicted: PredictedPoints | None = None,
    settings: MatchSettings | None = None,
) -> Correspondence:
    """Group the peaks (S, K) of S sensors to markers; see ``group_peaks``."""

    def solve(readings_px: Array, sigma_px: Array) -> PointBatch:
        return reconstruct(cameras, readings_px, sigma_px, parameter_covariance, corrections)

    return group_peaks(
        solve,
        Measurements.of(position_px, sigma_px, merged_flags(merged)),
        model=MeasurementModel(cameras, parameter_covariance, corrections),
        predicted=predicted,
        settings=settings or MatchSettings(),
    )
