"""Geometric refinement of one sensor's seven parameters, with their covariance."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from compute.calibration.starts import starting_matrices
from compute.camera.dlt import model_from_matrix
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.stack import CameraStack, reading_slopes
from compute.errors import DegeneratePoints, NoConvergence

Array = NDArray[np.float64]

DETERMINED_RATIO = 1e-5
"""Smallest ratio of singular values of the Jacobian with columns of length 1. The measured and
simulated frames of the thesis have 1e-4 and more; the corners of a box that a sensor sees along
its edges, 1e-5 and less even with noise."""
PENALTY_PX = 1e6
"""Residual of a point that a trial camera has behind it: the search turns back."""


@dataclass(frozen=True, eq=False)
class RefinedSensor:
    """A refined camera and the inverse of its normal matrix, shape (7, 7), for unit weights."""

    model: SensorModel
    cofactor: Array
    residuals_px: Array
    """Fitted minus measured reading, shape (N,)."""
    iteration_change_px: float | None = None
    """See ``SensorFit``."""


def refine(
    points_mm: Array,
    readings_px: Array,
    sigma_px: Array,
    sensor: SensorGeometry,
    near: SensorModel | None = None,
) -> RefinedSensor:
    """Minimise the sum of squared residuals over sigma from several starts; keep the lowest.

    Args:
        points_mm: control points that the sensor saw, shape (N, 3).
        readings_px: its readings, shape (N,) [px].
        sigma_px: their standard deviations, shape (N,) [px], or ones.
        sensor: its geometry.
        near: a camera known to be close, the only start then; None: look everywhere.

    Raises:
        DegeneratePoints: more than one camera fits.
        NoConvergence: no start led to a minimum with all points in front of the lens.
    """
    weights = 1.0 / sigma_px
    seen = points_mm.mean(axis=0)
    best: tuple[float, SensorModel] | None = None
    starts = (
        [near]
        if near
        else [
            model_from_matrix(matrix, sensor, seen)
            for matrix in starting_matrices(points_mm, readings_px, weights, sensor.name)
        ]
    )
    for start in starts:
        found = _minimise(start, points_mm, readings_px, weights)
        if found is not None and (best is None or found[0] < best[0]):
            best = found
    if best is None:
        raise NoConvergence(
            f"sensor {sensor.name}: no camera with all {len(points_mm)} control points in front "
            "of it fits the readings; look for exchanged or wrong labels",
            sensor=sensor.name,
        )
    _check_determined(best[1], points_mm, weights)
    return at_solution(best[1], points_mm, readings_px, sigma_px)


def at_solution(
    model: SensorModel, points_mm: Array, readings_px: Array, sigma_px: Array
) -> RefinedSensor:
    """Return a fitted camera with its residuals and the inverse of its normal matrix."""
    cameras = CameraStack.of([model])
    residuals = (cameras.project(points_mm) - cameras.corrected(readings_px[:, None]))[:, 0]
    jacobian = cameras.parameter_jacobian(points_mm)[:, 0] / sigma_px[:, None]
    return RefinedSensor(model, cofactor(jacobian), residuals)


def _check_determined(model: SensorModel, points_mm: Array, weights: Array) -> None:
    """Raise DegeneratePoints when the readings leave a combination of parameters open.

    Seen from the points' centroid: from far away, a turn and a shift look alike.
    """
    middle = points_mm.mean(axis=0)
    here = replace(
        model,
        offset_x_mm=model.offset_x_mm + float(model.rotation[0] @ middle),
        offset_z_mm=model.offset_z_mm + float(model.rotation[2] @ middle),
    )
    slopes = CameraStack.of([here]).parameter_jacobian(points_mm - middle)[:, 0]
    jacobian = slopes * weights[:, None]
    singular = np.linalg.svd(jacobian / np.linalg.norm(jacobian, axis=0), compute_uv=False)
    ratio = float(singular[-1] / singular[0])
    if ratio < DETERMINED_RATIO:
        raise DegeneratePoints(
            f"sensor {model.name} cannot be calibrated with these {len(jacobian)} control points: "
            "seen along its slit they coincide or line up so that many cameras fit as well "
            f"(ratio of singular values {ratio:.1e}, at least {DETERMINED_RATIO:g} is needed); "
            "add points off their grid",
            sensor=model.name,
        )


def cofactor(jacobian: Array) -> Array:
    """Return (J'J)^-1, shape (7, 7), through QR with scaled columns."""
    scale = np.linalg.norm(jacobian, axis=0)
    triangle = np.linalg.qr(jacobian / scale, mode="r")
    inverse = np.linalg.inv(triangle) / scale[:, None]
    product: Array = inverse @ inverse.T
    return product


@dataclass(frozen=True, eq=False)
class ReadingResiduals:
    """Weighted residuals of one sensor as a function of a step from a starting camera.

    Args:
        start: the camera at step zero.
        points_mm: control points, shape (N, 3).
        readings_px: readings, shape (N,).
        weights: factors for the residuals, shape (N,).
    """

    start: SensorModel
    points_mm: Array
    readings_px: Array
    weights: Array

    def values(self, step: Array) -> Array:
        """Return the residuals at a step (7,) in the order of PARAMETERS, shape (N,)."""
        _, u, _ = self._frame(step)
        distance = self.start.principal_distance_px + step[0]
        fitted = self.start.principal_point_px + step[1] + distance * u
        return np.where(np.isnan(u), PENALTY_PX, fitted - self.readings_px) * self.weights

    def jacobian(self, step: Array) -> Array:
        """Return d residuals / d step, shape (N, 7)."""
        turned, u, depth = self._frame(step)
        slopes = reading_slopes(turned, u, (self.start.principal_distance_px + step[0]) / depth)
        # The step's rotation vector counts from the start, the slopes' from the trial.
        slopes[:, 2:5] = slopes[:, 2:5] @ left_jacobian(step[2:5])
        return np.nan_to_num(slopes) * self.weights[:, None]

    def _frame(self, step: Array) -> tuple[Array, Array, Array]:
        """Return the points turned into the trial's frame (N, 3), u and depth (N,)."""
        turned = self.points_mm @ (rotation_matrix(step[2:5]) @ self.start.rotation).T
        depth = turned[:, 2] + (self.start.offset_z_mm + step[6])
        depth = np.where(depth > 0.0, depth, np.nan)
        return turned, (turned[:, 0] + (self.start.offset_x_mm + step[5])) / depth, depth


def _minimise(
    start: SensorModel, points_mm: Array, readings_px: Array, weights: Array
) -> tuple[float, SensorModel] | None:
    """Levenberg-Marquardt from one start; the cost and the model, or None if it failed."""
    residuals = ReadingResiduals(start, points_mm, readings_px, weights)
    result = least_squares(
        residuals.values,
        np.zeros(PARAMETER_COUNT),
        jac=residuals.jacobian,
        method="lm",
        x_scale="jac",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=1000,
    )
    model = start.moved(result.x)
    behind = np.isnan(CameraStack.of([model]).project(points_mm)).any()
    if behind or model.principal_distance_px <= 0.0 or not np.isfinite(result.cost):
        return None
    return float(result.cost), model


def rotation_matrix(rotation_vector: Array) -> Array:
    """Return exp([w]x), shape (3, 3); scipy's Rotation costs more than the whole residual."""
    matrix: Array = np.eye(3) + _cross(rotation_vector) @ left_jacobian(rotation_vector)
    return matrix


def left_jacobian(rotation_vector: Array) -> Array:
    """Return the left Jacobian of SO(3), shape (3, 3): exp((w + dw)^) = exp((J dw)^) exp(w^)."""
    angle = float(np.linalg.norm(rotation_vector))
    cross = _cross(rotation_vector)
    if angle < 1e-5:
        first, second = 0.5, 1.0 / 6.0
    else:
        first = (1.0 - np.cos(angle)) / angle**2
        second = (angle - np.sin(angle)) / angle**3
    return np.eye(3) + first * cross + second * (cross @ cross)


def _cross(vector: Array) -> Array:
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
