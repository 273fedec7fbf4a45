"""Diagnosis: weak parameters, coverage by control points, and the most useful further point."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import Diagnosis, SensorDiagnosis, Suggestion
from compute.calibration.result import Calibration, SensorFit, prior_strength
from compute.calibration.single_sensor.camera_fit import LensPrior, fitted_columns
from compute.camera.model import vector3
from compute.camera.stack import CameraStack
from compute.progress import Progress, no_progress

Array = NDArray[np.float64]

VOLUME_GRID_NODES: Final = 5
"""Nodes along each axis of the grid over the control points' box for the precision."""
CANDIDATE_GRID_NODES: Final = 7
CANDIDATE_BOX_FACTOR: Final = 1.15
"""Box of the candidates over the control points' box."""
MAX_SUGGESTIONS: Final = 5
MIN_SEPARATION_FRACTION: Final = 0.2
"""Smallest distance between suggestions, as a fraction of the box's diagonal."""
MIN_PIXEL_SHARE: Final = 0.6
MIN_RELATIVE_DEPTH_RANGE: Final = 0.05
WEAK_CONDITION_THRESHOLD: Final = 1e-4
"""Condition below which a sensor's parameters depend on single readings."""

_PARAMETER_DESCRIPTIONS: Final = {
    "principal_distance_px": "the principal distance",
    "principal_point_px": "the principal point",
    "rotation_x_rad": "tilt about the row",
    "rotation_y_rad": "pan about the slit",
    "rotation_z_rad": "roll about the view",
    "offset_x_mm": "the position along the row",
    "offset_z_mm": "the distance from the points",
    "offset_y_mm": "the position along the slit",
}


def diagnose(
    calibration: Calibration,
    points_mm: Array,
    readings_px: Array,
    progress: Progress = no_progress,
) -> Diagnosis:
    """Diagnose how well control points determine a calibration, and where another helps most.

    The precision of a point is that of its reconstruction from all sensors that see it, propagated
    from the calibration's covariance. A candidate control point lowers that covariance as one more
    observation with the sensors' noise, in the linearised model.

    Args:
        calibration: the calibration of these points.
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings that the fit used, shape (N, S) [px]; NaN where not.
        progress: called with the fraction done and the stage.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings = np.asarray(readings_px, dtype=np.float64)
    sensors = tuple(
        _sensor(fit, points[rows], column[rows], prior_strength(calibration))
        for fit, column, rows in zip(
            calibration.sensors, readings.T, np.isfinite(readings).T, strict=True
        )
    )
    progress(0.2, "most useful further point")
    mean, largest, suggestions = _PrecisionPredictor(calibration, points).predict()
    return Diagnosis(sensors, mean, largest, suggestions, _remarks(calibration, sensors))


def _sensor(fit: SensorFit, points: Array, readings: Array, strength: float) -> SensorDiagnosis:
    model = fit.model
    columns = fitted_columns(model)
    # Far from the origin, a rotation and a translation have nearly the same effect.
    centre = points.mean(axis=0)
    shift = model.rotation @ centre
    distortion = model.distortion
    if distortion is not None:
        distortion = replace(distortion, offset_y_mm=distortion.offset_y_mm + float(shift[1]))
    recentred = replace(
        model,
        offset_x_mm=model.offset_x_mm + float(shift[0]),
        offset_z_mm=model.offset_z_mm + float(shift[2]),
        distortion=distortion,
    )
    stack = CameraStack.of([recentred])
    matrix = stack.parameter_jacobian(points - centre)[:, 0, columns]
    matrix = matrix * (1.0 / fit.sigma_px)
    if distortion is not None:
        seen = np.ones((len(points), 1), dtype=np.bool_)
        prior = LensPrior.of([recentred], [None], points - centre, seen, strength)
        information = prior.gaussian(stack)[1][0, columns]
        matrix = np.concatenate([matrix, np.diag(np.sqrt(information))])
    scale = np.linalg.norm(matrix, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, singular, right = np.linalg.svd(matrix / scale, full_matrices=False)
    # Shares of scaled parameters: columns of length 1.
    shares = right[-1] ** 2
    names = [model.parameter_names[column] for column in columns]
    order = np.argsort(-shares, kind="stable")[:4]
    weakest = tuple((names[k], float(np.sqrt(shares[k]))) for k in order)
    frame = points @ model.rotation.T
    depth = frame[:, 2] + model.offset_z_mm
    u = (frame[:, 0] + model.offset_x_mm) / depth
    field_v = None
    if model.distortion is not None:
        v = (frame[:, 1] + model.distortion.offset_y_mm) / (depth + model.distortion.row_behind_mm)
        field_v = (float(v.min()), float(v.max()))
    low, high = float(readings.min()), float(readings.max())
    return SensorDiagnosis(
        model.name,
        float(singular[-1] / singular[0]),
        weakest,
        _describe_combination(names, shares),
        (low, high),
        (high - low) / model.pixels,
        (float(u.min()), float(u.max())),
        field_v,
        (float(depth.min()), float(depth.max())),
    )


def _describe_combination(names: list[str], shares: Array) -> str:
    order = np.argsort(-shares, kind="stable")
    count = int(np.searchsorted(np.cumsum(shares[order]), 0.8)) + 1
    parts = []
    for k in order[: min(count, 4)]:
        description = _PARAMETER_DESCRIPTIONS.get(names[k], f"the distortion term {names[k]}")
        parts.append(f"{description} ({shares[k]:.0%})")
    if len(parts) == 1:
        return parts[0]
    return f"{', '.join(parts[:-1])} against {parts[-1]}"


class _PrecisionPredictor:
    """Precision over the volume from the calibration's covariance, and candidate control points."""

    def __init__(self, calibration: Calibration, points: Array) -> None:
        self.cameras = CameraStack.of(calibration.models)
        self.pixels = np.array([model.pixels for model in calibration.models])
        self.sigma = np.array([fit.sigma_px for fit in calibration.sensors])
        self.low, self.high = points.min(axis=0), points.max(axis=0)
        self.covariance = np.array(calibration.covariance)

    def predict(self) -> tuple[float | None, float | None, tuple[Suggestion, ...]]:
        """Return the mean and largest sigma over the volume [mm], and further control points."""
        volume, jacobian, rows = self._visible(box_points(self.low, self.high, VOLUME_GRID_NODES))
        if not len(volume):
            return None, None, ()
        by_parameter = self._point_jacobian(jacobian, rows)
        variances: Array = np.einsum(
            "mip,pq,miq->m", by_parameter, self.covariance, by_parameter, optimize=True
        )
        return *_summary(variances), self._suggestions(by_parameter, variances)

    def _visible(self, points: Array) -> tuple[Array, Array, Array]:
        """Return the points that three sensors see, with Jacobians by point and by parameters.

        Shapes (M, 3), (M, S, 3) and (M, S, P); both are 0 where a sensor does not see the point.
        """
        readings, jacobian = self.cameras.linearise(points)
        with np.errstate(invalid="ignore"):
            inside = (readings >= -0.5) & (readings <= self.pixels - 0.5)
        keep = inside.sum(axis=1) >= 3
        points, inside, jacobian = points[keep], inside[keep], jacobian[keep]
        by_parameter = self.cameras.parameter_jacobian(points)
        rows = np.zeros((*inside.shape, len(self.covariance)))
        for sensor, columns in enumerate(self.cameras.parameter_index):
            fitted = columns >= 0
            rows[:, sensor, columns[fitted]] = by_parameter[:, sensor, fitted]
        rows = np.where(inside[..., None], rows, 0.0)
        return points, np.where(inside[..., None], jacobian, 0.0), rows

    def _point_jacobian(self, jacobian: Array, rows: Array) -> Array:
        """Return d point / d parameters, shape (M, 3, P)."""
        weighted = jacobian / self.sigma[:, None] ** 2
        normal = np.einsum("msi,msj->mij", weighted, jacobian)
        gain = np.linalg.solve(normal, weighted.swapaxes(1, 2))
        return np.asarray(-gain @ rows)

    def _suggestions(self, by_parameter: Array, before: Array) -> tuple[Suggestion, ...]:
        centre, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        reach = CANDIDATE_BOX_FACTOR * half
        positions, _, rows = self._visible(
            box_points(centre - reach, centre + reach, CANDIDATE_GRID_NODES)
        )
        towards = self.covariance @ by_parameter.reshape(-1, len(self.covariance)).T
        found = []
        for position, row in zip(positions, rows, strict=True):
            sees = row.any(axis=1)
            jacobian = row[sees]
            noise = np.diag(self.sigma[sees] ** 2)
            gain = np.linalg.solve(
                noise + jacobian @ self.covariance @ jacobian.T, jacobian @ towards
            )
            lowered = (gain * (jacobian @ towards)).reshape(len(jacobian), -1, 3).sum(axis=(0, 2))
            mean, largest = _summary(np.maximum(before - lowered, 0.0))
            found.append(Suggestion(vector3(position), mean, largest))
        found.sort(key=lambda one: one.mean_sigma_mm)
        chosen: list[Suggestion] = []
        apart = MIN_SEPARATION_FRACTION * float(np.linalg.norm(self.high - self.low))
        for one in found:
            gaps = [np.linalg.norm(np.subtract(one.position_mm, o.position_mm)) for o in chosen]
            if not gaps or min(gaps) >= apart:
                chosen.append(one)
            if len(chosen) == MAX_SUGGESTIONS:
                break
        return tuple(chosen)


def _summary(variances: Array) -> tuple[float, float]:
    return float(np.sqrt(variances.mean())), float(np.sqrt(variances.max()))


def box_points(low_mm: Array, high_mm: Array, count: int) -> Array:
    """Return positions on a mesh over a box, shape (count^3, 3) [mm].

    Args:
        low_mm: the corner with the lowest coordinates, shape (3,) [mm].
        high_mm: the opposite corner, shape (3,) [mm].
        count: positions along each axis.
    """
    axes = np.linspace(low_mm, high_mm, count).T
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _remarks(calibration: Calibration, sensors: tuple[SensorDiagnosis, ...]) -> tuple[str, ...]:
    remarks = []
    for fit, one in zip(calibration.sensors, sensors, strict=True):
        if one.pixel_share < MIN_PIXEL_SHARE:
            remarks.append(
                f"Sensor {one.sensor}: the control points cover {one.pixel_share:.0%} of its "
                f"pixels ({one.pixels[0]:.0f} to {one.pixels[1]:.0f}); beyond them the "
                "calibration is an extrapolation."
            )
        near, far = one.depth_mm
        if far - near < MIN_RELATIVE_DEPTH_RANGE * near:
            remarks.append(
                f"Sensor {one.sensor}: its control points lie between {near:.0f} and {far:.0f} mm "
                "from the lens; over so little depth, the principal distance and the distance "
                "from the points are hardly distinguishable."
            )
        if one.condition < WEAK_CONDITION_THRESHOLD:
            remarks.append(
                f"Sensor {one.sensor}: {one.weakest_description} depend on small differences "
                f"between readings (condition {one.condition:.1e}); spread the points further in "
                "all three directions."
            )
        settings = calibration.settings
        uncertain = settings is not None and settings.control_sigma_mm is not None
        if uncertain and fit.sigma_source == "assumed":
            remarks.append(
                f"Sensor {one.sensor}: its readings count as uncertain by {fit.sigma_px:.2g} px, "
                "more than their own noise: with less, the joint adjustment of sensors and control "
                "points did not converge. The covariance is rather too large; measure the control "
                "points more precisely, or give more of them."
            )
        if fit.chi2_per_dof is not None and fit.chi2_per_dof > 2.0:
            remarks.append(
                f"Sensor {one.sensor}: its residuals are {fit.chi2_per_dof**0.5:.1f} times what "
                "the given standard deviations explain; check distortion, labels and noise."
            )
    return tuple(remarks)
