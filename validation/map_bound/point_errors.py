"""Errors of points reconstructed with a camera and a map, beside the bound by noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration
from compute.calibration.settings import CalibrationSettings, Distortion
from compute.camera.model import SensorGeometry
from compute.camera.stack import CameraStack
from compute.mapping.build import build_table
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.result import MappingResult
from compute.planning.precision import point_precision
from compute.reconstruction.triangulation import reconstruct
from validation.map_bound.scene import Readings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fit:
    """A calibration, with or without a map, both from the same control points."""

    calibration: Calibration
    mapping: MappingResult | None

    @property
    def cameras(self) -> CameraStack:
        """The cameras."""
        return CameraStack.of(self.calibration.models)

    def expected_px(self, points_mm: Array) -> Array:
        """Return the readings that the fit expects of points (N, 3), shape (N, S) [px]."""
        projected = self.cameras.project(points_mm)
        if self.mapping is None:
            return projected
        return projected - self.mapping.table.at(points_mm).value_px


def fit(control: Readings, geometry: tuple[SensorGeometry, ...], distortion: Distortion) -> Fit:
    """Calibrate with control points."""
    settings = CalibrationSettings(distortion=distortion)
    return Fit(
        calibrate(control.points_mm, control.position_px, geometry, control.sigma_px, settings),
        None,
    )


def mapped(one: Fit, control: Readings) -> Fit:
    """Map with the control points that the calibration was made from."""
    measured = MappingMeasurements(control.points_mm, control.position_px, control.sigma_px)
    return Fit(one.calibration, build_table(one.calibration.models, "", measured))


@dataclass(frozen=True, eq=False)
class PointErrors:
    """Errors of reconstructed points.

    Args:
        difference_mm: reconstructed less true, shape (N, 3) [mm]; NaN where there is no point.
        nees: normalised error squared with the stated covariance, shape (N,).
        bound_mm2: trace of the covariance by the centroids' noise alone, shape (N,) [mm^2].
        supported: the table supports it, shape (N,).
    """

    difference_mm: Array
    nees: Array
    bound_mm2: Array
    supported: NDArray[np.bool_]

    def rms_mm(self, which: NDArray[np.bool_]) -> float:
        """Return the 3D RMS [mm] of those points that there are."""
        here = self.difference_mm[which & self.found]
        return float(np.sqrt((here**2).sum(axis=1).mean()))

    def bound_rms_mm(self, which: NDArray[np.bool_]) -> float:
        """Return the RMS that the noise alone leaves, of the same points [mm]."""
        return float(np.sqrt(self.bound_mm2[which & self.found].mean()))

    def mean_square(self, which: NDArray[np.bool_]) -> float:
        """Return the mean of the normalised errors squared: 3 where the covariance is right."""
        return float(self.nees[which & self.found].mean())

    @property
    def found(self) -> NDArray[np.bool_]:
        """Which points there are, shape (N,)."""
        found: NDArray[np.bool_] = np.isfinite(self.nees)
        return found


def point_errors(one: Fit, seen: Readings, bound: Array) -> PointErrors:
    """Reconstruct points and compare.

    Args:
        one: camera and map; with a map its variance holds the calibration's, without one the
            calibration's covariance counts.
        seen: readings of points that the fit never saw.
        bound: covariance by the noise alone, shape (N, 3, 3) [mm^2].
    """
    covariance = np.array(one.calibration.covariance) if one.mapping is None else None
    table = None if one.mapping is None else one.mapping.table
    found = reconstruct(one.cameras, seen.position_px, seen.sigma_px, covariance, table)
    difference = found.position_mm - seen.points_mm
    nees = np.full(len(difference), np.nan)
    there = np.isfinite(difference[:, 0])
    solved = np.linalg.solve(found.covariance_mm2[there], difference[there, :, None])[..., 0]
    nees[there] = (difference[there] * solved).sum(axis=1)
    supported: NDArray[np.bool_] = np.ones(len(nees), dtype=np.bool_)
    if table is not None:
        inside = table.at(seen.points_mm).inside
        fit_for_use: NDArray[np.bool_] = np.logical_or(inside, np.isnan(seen.position_px))
        supported = np.all(fit_for_use, axis=1)
    return PointErrors(difference, nees, np.trace(bound, axis1=1, axis2=2), supported)


def noise_bound(cameras: CameraStack, seen: Readings) -> Array:
    """Return the points' covariance by the centroids' noise alone, shape (N, 3, 3) [mm^2]."""
    return point_precision(cameras, seen.points_mm, seen.sigma_px).covariance_mm2


@dataclass(frozen=True)
class ErrorParts:
    """What the errors of points are made of, 3D RMS [mm].

    Args:
        noise: by the centroids' noise of the point itself.
        calibration: by that of the control points, through camera and map.
        model: what is left without any noise, because camera and map are of another shape.
    """

    noise: float
    calibration: float
    model: float


def error_parts(fits: list[Fit], seen: Readings, cameras: CameraStack, bound: Array) -> ErrorParts:
    """Take errors apart, from fits to several exposures of the same control points.

    The expected readings' errors at the points are propagated as the bound is; their mean over
    the exposures is the model's part, but for its own share of the spread about it.
    """
    slope = np.nan_to_num(cameras.linearise(seen.points_mm)[1])
    weight = np.nan_to_num(1.0 / seen.sigma_px**2)
    solve = np.einsum("nij,nsj,ns->nis", bound, slope, weight)
    errors = np.stack(
        [np.nan_to_num(one.expected_px(seen.points_mm) - seen.exact_px) for one in fits]
    )
    moved = np.einsum("nis,kns->kni", solve, errors)
    mean = moved.mean(axis=0)
    spread = float(((moved - mean) ** 2).sum(axis=2).mean(axis=1).sum() / (len(fits) - 1))
    nees = float((mean**2).sum(axis=1).mean()) - spread / len(fits)
    noise = float(np.sqrt(np.trace(bound, axis1=1, axis2=2).mean()))
    return ErrorParts(noise, float(np.sqrt(spread)), float(np.sqrt(max(nees, 0.0))))
