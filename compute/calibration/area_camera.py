"""Calibrate a two-dimensional camera: one rotation, one centre, both readings of every point."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.control_data_checks import check_observations
from compute.calibration.single_sensor.fit_statistics import (
    QUANTISATION_PX,
    UNEXPLAINED_PROBABILITY,
)
from compute.calibration.single_sensor.levenberg_marquardt import ROUNDING_TOLERANCE
from compute.calibration.single_sensor.metric_fit import fit_metric_cameras
from compute.calibration.single_sensor.sensor_fits import SIGMA_FLOOR_PX
from compute.camera.area_camera import PlanarCamera
from compute.camera.model import SensorGeometry, SensorModel, vector3
from compute.camera.rotation import rotation_vector
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, InvalidParameter, NoConvergence, TooFewPoints
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

MAX_STEPS: Final = 200
STEP_TOLERANCE: Final = 1e-9
MIN_SINGULAR_RATIO: Final = 1e-7

SigmaSource = Literal["given", "residuals", "assumed"]


@dataclass(frozen=True, eq=False)
class PlanarFit:
    """A fitted camera, ready to be used as two linear sensors beside others.

    Args:
        camera: the camera.
        covariance: of its parameters in the order of ``PlanarCamera.sensor_jacobian``, (Q, Q).
        sensor_covariance: of both sensors' parameters together, shape (P, P): it has the rank of
            ``covariance``, which is what the constraints [2.10] and [2.11] are.
        residuals_px: fitted minus measured, shape (N, 2); NaN where not seen.
        sigma_source: whence the readings' deviation is: given, from the residuals, or, with at
            most two readings more than parameters, assumed to be quantisation's at least.
        chi2_per_dof: with given deviations, about 1 where they are right; else None.
    """

    camera: PlanarCamera
    covariance: Array
    sensor_covariance: Array
    residuals_px: Array
    sigma_source: SigmaSource
    chi2_per_dof: float | None

    @property
    def models(self) -> tuple[SensorModel, SensorModel]:
        """The sensors that read x and y."""
        return self.camera.sensors()


def calibrate_planar(
    points_mm: Array,
    readings_px: Array,
    name: str,
    pixels: tuple[int, int],
    sigma_px: Array | None = None,
    *,
    square: bool = True,
    radial: int = 0,
    decentring: bool = False,
) -> PlanarFit:
    """Calibrate one camera from control points, its constraints kept exactly.

    From two linear sensors fitted for themselves, the nearest camera with one rotation, and from
    it Levenberg-Marquardt over the camera's own parameters.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: x and y, shape (N, 2) [px]; NaN where not seen.
        name: the camera's name.
        pixels: numbers of columns and rows.
        sigma_px: standard deviations, shape (N, 2) [px]; None: one, from the residuals.
        square: the pixels are square: c_x = c_y, [2.10].
        radial: how many K of [2.12], 0 to 3.
        decentring: whether p1 and p2 of [2.14] are fitted.

    Raises:
        TooFewPoints, DegeneratePoints, NonFiniteValue, DuplicatePoint, ReadingOutsideSensor,
        InvalidParameter, NoConvergence: as for linear sensors.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings = np.asarray(readings_px, dtype=np.float64)
    sensors = [SensorGeometry(f"{name}.{axis}", n) for axis, n in zip("xy", pixels, strict=True)]
    if not 0 <= radial <= 3:
        raise InvalidParameter(f"radial is {radial}; it must be 0 to 3")
    check_observations(points, readings, sensors, sigma_px)
    seen = np.isfinite(readings)
    weights = np.where(seen, 1.0, 0.0)
    if sigma_px is not None:
        weights = np.where(seen, 1.0 / np.where(seen, sigma_px, 1.0), 0.0)
    unit = np.where(seen, 1.0 / np.where(seen, weights, 1.0), 1.0)
    alone = fit_metric_cameras(points, readings, unit, sensors)
    camera = _combine_sensors(alone, name, pixels, square, radial, decentring)
    camera, jacobian, residuals = _minimise(camera, points, readings, weights, square)
    dof = len(residuals) - jacobian.shape[1]
    if dof < 0:
        raise TooFewPoints(
            f"camera {name} has {len(residuals)} readings; its {jacobian.shape[1]} parameters "
            "need at least as many",
            points=len(points),
        )
    scale = np.linalg.norm(jacobian, axis=0)
    triangle = np.linalg.qr(jacobian / scale, mode="r")
    singular = np.linalg.svd(triangle, compute_uv=False)
    if singular[-1] < MIN_SINGULAR_RATIO * singular[0]:
        raise DegeneratePoints(
            f"camera {name} cannot be calibrated with these {len(points)} control points (ratio of "
            f"singular values {singular[-1] / singular[0]:.1e}, at least {MIN_SINGULAR_RATIO:g} is "
            "needed); spread them in all three directions, or fit fewer terms"
        )
    inverse = np.linalg.inv(triangle) / scale[:, None]
    chi2 = float((residuals**2).sum())
    factor, source = _covariance_factor(chi2, dof, sigma_px is not None)
    chi2_per_dof = chi2 / dof if source == "given" and dof else None
    covariance = inverse @ inverse.T * factor
    jacobian = camera.sensor_jacobian(square)
    misfit = np.where(seen, CameraStack.of(camera.sensors()).project(points) - readings, np.nan)
    return PlanarFit(
        camera, covariance, jacobian @ covariance @ jacobian.T, misfit, source, chi2_per_dof
    )


def _covariance_factor(chi2: float, dof: int, known: bool) -> tuple[float, SigmaSource]:
    """Return the factor from the equations' inverse to the covariance, and whence it is.

    Args:
        chi2: residuals squared, over the deviations where these are known [px^2 where not].
        dof: readings less parameters.
        known: whether deviations were given.
    """
    if known:
        unexplained = chi2 > chi2_limit(dof, UNEXPLAINED_PROBABILITY)
        return (chi2 / dof if unexplained else 1.0), "given"
    if dof > 2:
        return max(chi2 / (dof - 2), SIGMA_FLOOR_PX**2), "residuals"
    # As of a linear sensor: one or two residuals more than parameters say too little.
    return max(chi2 / max(dof, 1), QUANTISATION_PX**2), "assumed"


def _combine_sensors(
    alone: tuple[SensorModel, ...],
    name: str,
    pixels: tuple[int, int],
    square: bool,
    radial: int,
    decentring: bool,
) -> PlanarCamera:
    """Return the camera with one rotation that is nearest to two sensors."""
    x, y = alone
    rows = np.array([x.rotation[0], y.rotation[0], x.rotation[2] + y.rotation[2]])
    rows[2] /= np.linalg.norm(rows[2])
    left, _, right = np.linalg.svd(rows)
    if np.linalg.det(left @ right) < 0.0:
        raise InvalidParameter(
            f"camera {name}: x and y of its readings make a left-handed frame with the view; "
            "count the rows from the other side, or exchange x and y"
        )
    cx, cy = x.principal_distance_px, y.principal_distance_px
    if square:
        cx = cy = 0.5 * (cx + cy)
    return PlanarCamera(
        name,
        pixels,
        (cx, cy),
        (x.principal_point_px, y.principal_point_px),
        vector3(rotation_vector(left @ right)),
        (x.offset_x_mm, y.offset_x_mm, 0.5 * (x.offset_z_mm + y.offset_z_mm)),
        (0.0,) * radial,
        (0.0, 0.0) if decentring else (),
    )


def _minimise(
    camera: PlanarCamera, points: Array, readings: Array, weights: Array, square: bool
) -> tuple[PlanarCamera, Array, Array]:
    """Return the camera at the minimum, its Jacobian (M, Q) and residuals (M,), both weighted."""
    jacobian, residuals = _equations(camera, points, readings, weights, square)
    cost = float(residuals @ residuals)
    rounding = ROUNDING_TOLERANCE * float(np.linalg.norm(np.nan_to_num(readings) * weights))
    damping = 1e-4
    for _ in range(MAX_STEPS):
        scale = np.linalg.norm(jacobian, axis=0)
        scaled = jacobian / scale
        right = -scaled.T @ residuals
        normal = scaled.T @ scaled + (damping + 1e-15) * np.eye(len(right))
        step = np.linalg.solve(normal, right)
        promised = float(step @ right + damping * step @ step)
        trial = camera.retract(step / scale, square)
        new_jacobian, new = _equations(trial, points, readings, weights, square)
        new_cost = float(new @ new)
        if new_cost <= cost:
            camera, jacobian, residuals, cost = trial, new_jacobian, new, new_cost
        hidden = rounding * (2.0 * np.sqrt(cost) + rounding)
        if promised <= STEP_TOLERANCE * cost / len(residuals) + hidden and damping <= 1e-3:
            return camera, jacobian, residuals
        damping = max(damping * (0.1 if new_cost <= cost else 10.0), 1e-14)
        if damping > 1e12:
            break
    raise NoConvergence(
        f"camera {camera.name}: its readings fit no camera with one rotation and one centre; "
        "look for exchanged or wrong labels, and whether x and y are exchanged"
    )


def _equations(
    camera: PlanarCamera, points: Array, readings: Array, weights: Array, square: bool
) -> tuple[Array, Array]:
    models = camera.sensors()
    stack = CameraStack.of(models)
    fitted, jacobian = stack.project_with_parameter_jacobian(points)
    used = weights > 0.0
    chain = camera.sensor_jacobian(square)
    first, rows, values = 0, [], []
    for column, model in enumerate(models):
        own = np.flatnonzero(stack.parameter_mask[column])
        # The stack's columns hold all terms of both; each sensor's own order leads to them.
        order = own[np.argsort(stack.parameter_index[column, own])]
        last = first + model.parameter_count
        seen = used[:, column]
        weight = weights[seen, column]
        rows.append((jacobian[seen, column][:, order] * weight[:, None]) @ chain[first:last])
        values.append((fitted[seen, column] - readings[seen, column]) * weight)
        first = last
    jacobian, residuals = np.concatenate(rows), np.concatenate(values)
    if np.isnan(residuals).any():
        return np.zeros_like(jacobian), np.full(len(residuals), np.inf)
    return jacobian, residuals
