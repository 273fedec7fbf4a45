"""Points in space from the readings of tracks, with a consistency test."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.grouping import Correspondence, group_peaks
from compute.reconstruction.point_batch import PointFlag
from validation.thesis_tracking.settings import MIN_SENSORS

Array = NDArray[np.float64]

_NO_POINT: Final = int(PointFlag.TOO_FEW_SENSORS | PointFlag.DEGENERATE | PointFlag.NO_CONVERGENCE)
_MAX_TOGETHER: Final = 12
"""Readings of a sensor up to which combinations of four are looked for by prediction."""


@dataclass(frozen=True, eq=False)
class SolvedPoints:
    """Points of N markers.

    Args:
        position_mm: shape (N, 3); NaN: none.
        covariance_mm2: shape (N, 3, 3).
        inconsistent: whether the sensors contradict one another, shape (N,).
        outside_map: whether the correction table does not support one, shape (N,).
        left_out: the sensor whose reading was left out as another target's; -1: none, (N,).
    """

    position_mm: Array
    covariance_mm2: Array
    inconsistent: NDArray[np.bool_]
    outside_map: NDArray[np.bool_]
    left_out: NDArray[np.intp]

    @property
    def found(self) -> NDArray[np.bool_]:
        """Which markers have a point, shape (N,)."""
        return np.isfinite(self.position_mm[:, 0])

    def row(self, row: int) -> "SolvedPoints":
        """Return one of them."""
        own = slice(row, row + 1)
        return SolvedPoints(
            self.position_mm[own],
            self.covariance_mm2[own],
            self.inconsistent[own],
            self.outside_map[own],
            self.left_out[own],
        )


class SpacePoints:
    """Reconstructs, predicts and groups readings of one calibration.

    Args:
        cameras, parameter_covariance, corrections, pixels: as of ``Tracker``.
    """

    def __init__(
        self,
        cameras: CameraStack,
        parameter_covariance: Array | None,
        corrections: CorrectionTable | None,
        pixels: tuple[int, ...] | None,
    ) -> None:
        # Here and not above: Warp takes a second to load, and the types are used without it.
        from compute.reconstruction.solver import PointSolver

        self.model = MeasurementModel(cameras, parameter_covariance, corrections, pixels)
        self._solver = PointSolver(cameras, parameter_covariance, corrections, "cpu", threads=1)

    def solve(
        self, readings_px: Array, sigma_px: Array, predicted_mm: Array, predicted_covariance: Array
    ) -> SolvedPoints:
        """Return the points of N markers' readings; section 6.3's "target-to-track verification".

        How tracks are verified the text does not say. Here: where the sensors contradict one
        another, the reading that is least like what the marker's motion predicts is left out; if
        the others agree, it was another target's.

        Args:
            readings_px: shape (N, S), NaN: none.
            sigma_px: shape (N, S).
            predicted_mm: where the markers are predicted, NaN: nowhere yet, shape (N, 3).
            predicted_covariance: shape (N, 3, 3).
        """
        used = np.isfinite(readings_px)
        sigma = np.where(used, sigma_px, 1.0)
        points = self._solver.solve(readings_px, sigma)
        position, covariance = points.position_mm.copy(), points.covariance_mm2.copy()
        flags = points.flags.copy()
        left_out = np.full(len(readings_px), -1, dtype=np.intp)
        doubt = (flags & (PointFlag.INCONSISTENT | PointFlag.NO_CONVERGENCE)) != 0
        doubt &= (used.sum(axis=1) > MIN_SENSORS) & np.isfinite(predicted_mm[:, 0])
        rows = np.flatnonzero(doubt)
        if len(rows):
            off = self.innovation(
                readings_px[rows], sigma[rows], predicted_mm[rows], predicted_covariance[rows]
            )
            worst = np.where(used[rows], np.nan_to_num(np.abs(off), nan=np.inf), -1.0).argmax(
                axis=1
            )
            kept = readings_px[rows].copy()
            kept[np.arange(len(rows)), worst] = np.nan
            again = self._solver.solve(kept, sigma[rows])
            agree = (again.flags & (_NO_POINT | PointFlag.INCONSISTENT)) == 0
            taken = rows[agree]
            position[taken], covariance[taken] = (
                again.position_mm[agree],
                again.covariance_mm2[agree],
            )
            flags[taken], left_out[taken] = again.flags[agree], worst[agree]
        missing = (flags & _NO_POINT) != 0
        position[missing] = np.nan
        return SolvedPoints(
            position,
            covariance,
            (flags & PointFlag.INCONSISTENT) != 0,
            (flags & PointFlag.OUTSIDE_MAP) != 0,
            left_out,
        )

    def innovation(
        self, readings_px: Array, sigma_px: Array, predicted_mm: Array, predicted_covariance: Array
    ) -> Array:
        """Return readings less predicted ones, in their standard deviations, shape (N, S).

        Shapes as of ``solve``; a marker's own readings, or all of a sensor's against one marker,
        as they broadcast.
        """
        predicted = self.model.predict(predicted_mm)
        spread = np.einsum(
            "nsi,nij,nsj->ns",
            predicted.jacobian_px_per_mm,
            predicted_covariance,
            predicted.jacobian_px_per_mm,
        )
        bias = np.diagonal(self.model.systematic_covariance(predicted_mm), axis1=1, axis2=2)
        off: Array = (readings_px - predicted.reading_px) / np.sqrt(spread + bias + sigma_px**2)
        return off

    def group(self, readings_px: Array, sigma_px: Array) -> Correspondence:
        """Return which of the sensors' readings (S, K) belong to one marker."""
        few = int(np.isfinite(readings_px).sum(axis=1).max()) <= _MAX_TOGETHER
        return group_peaks(
            lambda readings, sigma: self._solver.solve(readings, np.where(sigma > 0.0, sigma, 1.0)),
            Measurements.of(readings_px, sigma_px),
            model=self.model if few else None,
        )
