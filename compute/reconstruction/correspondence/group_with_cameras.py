"""Grouping of peaks with cameras: ``group_peaks`` with the reconstruction in NumPy."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.reconstruction.correspondence.grouping import group_peaks
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.reconstruction.correspondence.predictor import Predictor
from compute.reconstruction.correspondence.result import Correspondence
from compute.reconstruction.correspondence.settings import MatchSettings
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import reconstruct

Array = NDArray[np.float64]

_STANDARD: Final = MatchSettings()


def match_peaks(
    cameras: CameraStack,
    position_px: Array,
    sigma_px: Array,
    parameter_covariance: Array | None = None,
    corrections: CorrectionTable | None = None,
    *,
    merged: NDArray[np.bool_] | None = None,
    predicted: PredictedPoints | None = None,
    bodies_mm: Sequence[Array] = (),
    settings: MatchSettings = _STANDARD,
) -> Correspondence:
    """Group the peaks of S sensors to markers; see ``group_peaks``.

    Args:
        cameras: S calibrated cameras.
        position_px: peaks of each sensor, shape (S, K); NaN where there are fewer than K.
        sigma_px: their standard deviations, shape (S, K).
        parameter_covariance: as in ``reconstruct``.
        corrections: as in ``reconstruct``.
        merged: as in ``group_peaks``.
        predicted: as in ``group_peaks``.
        bodies_mm: as in ``group_peaks``.
        settings: as in ``group_peaks``.
    """

    def solve(readings_px: Array, sigma_px: Array) -> PointBatch:
        return reconstruct(cameras, readings_px, sigma_px, parameter_covariance, corrections)

    return group_peaks(
        solve,
        position_px,
        sigma_px,
        predict=Predictor(cameras, parameter_covariance, corrections),
        merged=merged,
        predicted=predicted,
        bodies_mm=bodies_mm,
        settings=settings,
    )
