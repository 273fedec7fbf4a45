"""Diagnosis: weak parameters, coverage by control points, and the most useful further point."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import Diagnosis, SensorDiagnosis, Suggestion
from compute.calibration.result import Calibration, SensorFit, prior_strength
from compute.calibration.single_sensor.camera_fit import minimise
from compute.calibration.single_sensor.design_matrix import fitted_columns
from compute.calibration.single_sensor.lens_prior import LensPrior
from compute.camera.model import PARAMETER_COUNT, vector3
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

MAX_CONDITION: Final = 1e7
"""Condition of the sensors' planes above which they have no common point but a common line."""
MIN_EXTENT_MM: Final = 10.0
"""Extent of control points below which their coordinates may be in metres."""
MIN_PLANE_ANGLE: Final = 0.02
"""Sine of the smallest angle, as the planes of the sensors see a direction, at which a position is
determined along it: its standard deviation is then 50 times that of a plane."""
MAX_NONLINEARITY: Final = 0.2
"""Largest relative difference of a refit from what the covariance predicts linearly."""
MIN_ROBUST_REDUNDANCY: Final = 8
"""Readings beyond the parameters from which a robust loss with distortion terms tells two wrong
ones: with 15 for ten parameters one of 15 sensors kept one, with 19 none of 60."""
NONLINEARITY_GRID_NODES: Final = 3
NONLINEARITY_SIGMA: Final = 2.0
"""Standard deviations by which the readings are moved for it."""
MAX_FACTOR: Final = 1e4
"""Ratio of standard deviations above which none is stated."""

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
    pitch_um: Sequence[float | None] = (),
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
        pitch_um: the sensors' pixel pitches [um]; None, or empty: not known.
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
    remarks = (
        *_remarks(calibration, sensors),
        *_redundancy_remarks(calibration, np.isfinite(readings).sum(axis=0)),
        *_unit_remarks(calibration, points, pitch_um),
        *_geometry_remarks(calibration, points),
        *_nonlinearity_remarks(calibration, points, readings),
    )
    return Diagnosis(sensors, mean, largest, suggestions, remarks)


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
        visible = np.ones((len(points), 1), dtype=np.bool_)
        prior = LensPrior.of([recentred], [None], points - centre, visible, strength)
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
        # Of planes that share a line, no point follows.
        planes = np.where(inside[..., None], jacobian, 0.0) / self.sigma[:, None]
        keep[keep] = np.linalg.cond(planes[keep]) < MAX_CONDITION
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
        suggestions = []
        for position, row in zip(positions, rows, strict=True):
            sees = row.any(axis=1)
            jacobian = row[sees]
            noise = np.diag(self.sigma[sees] ** 2)
            gain = np.linalg.solve(
                noise + jacobian @ self.covariance @ jacobian.T, jacobian @ towards
            )
            lowered = (gain * (jacobian @ towards)).reshape(len(jacobian), -1, 3).sum(axis=(0, 2))
            mean, largest = _summary(np.maximum(before - lowered, 0.0))
            suggestions.append(Suggestion(vector3(position), mean, largest))
        suggestions.sort(key=lambda one: one.mean_sigma_mm)
        chosen: list[Suggestion] = []
        apart = MIN_SEPARATION_FRACTION * float(np.linalg.norm(self.high - self.low))
        for one in suggestions:
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
        uncertain = settings is not None and settings.position_sigma_mm is not None
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


def _redundancy_remarks(calibration: Calibration, counts: NDArray[np.intp]) -> list[str]:
    """Return which sensors have no more readings than their cameras have parameters."""
    remarks = []
    for fit, count in zip(calibration.sensors, counts.tolist(), strict=True):
        # Parameters with a scale were not asked for: the prior holds what readings leave open.
        estimated = calibration.distortion is not None and calibration.distortion.scale is not None
        needed = PARAMETER_COUNT if estimated else len(fitted_columns(fit.model))
        if count <= needed:
            remarks.append(
                f"Sensor {fit.model.name}: {count} readings for {needed} parameters leave no "
                "redundancy: its residuals are about zero whatever was read, and no error of a "
                f"reading can be noticed; give at least {needed + 3} points."
            )
            continue
        settings = calibration.settings
        robust = settings is not None and settings.loss == "robust"
        terms = robust and not estimated and bool(fit.model.terms)
        if terms and fit.points < needed + MIN_ROBUST_REDUNDANCY:
            remarks.append(
                f"Sensor {fit.model.name}: with {fit.points} readings for {needed} parameters the "
                "robust loss cannot always tell wrong readings: one may count as right. Give at "
                f"least {needed + MIN_ROBUST_REDUNDANCY} points, or take fewer distortion terms."
            )
    return remarks


def _unit_remarks(
    calibration: Calibration, points: Array, pitch_um: Sequence[float | None]
) -> list[str]:
    """Return whether the coordinates seem to be in metres."""
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if extent < MIN_EXTENT_MM:
        remark = (
            f"The control points lie within {extent:.3g} mm of each other: coordinates are in "
            "mm, and these may be in metres; multiply them by 1000 then, or all positions come "
            "out in metres."
        )
        return [remark]
    for model, pitch in zip(calibration.models, pitch_um, strict=False):
        focal = 0.0 if pitch is None else 1e-3 * pitch * model.principal_distance_px
        depth = float((points @ model.rotation[2]).mean()) + model.offset_z_mm
        if depth < focal:
            remark = (
                f"Sensor {model.name}: its lens would be {depth:.3g} mm from the control points, "
                f"less than the {focal:.3g} mm from lens to pixels: nothing is imaged there; "
                "check that the coordinates are in mm (and not in metres), and the pixel pitch."
            )
            return [remark]
    return []


def _geometry_remarks(calibration: Calibration, points: Array) -> list[str]:
    """Return in which direction the sensors' planes leave positions open, and why."""
    models = calibration.models
    if len(models) < 3:
        remark = (
            f"{len(models)} sensor{'s' if len(models) > 1 else ''} cannot locate a marker: each "
            "reading is a plane, and three planes meet in a point. The cameras are calibrated; "
            "for positions the device needs three sensors."
        )
        return [remark]
    corners = box_points(points.min(axis=0), points.max(axis=0), 2)
    positions = np.vstack([points.mean(axis=0), corners])
    reading, jacobian = CameraStack.of(models).linearise(positions)
    visible = np.isfinite(reading[0])
    normals = jacobian[:, visible] / np.linalg.norm(jacobian[:, visible], axis=2, keepdims=True)
    if normals.shape[1] < 3:
        return []
    _, singular, axes = np.linalg.svd(normals[0])
    if singular[2] >= MIN_PLANE_ANGLE:
        return []
    names = [model.name for model, is_visible in zip(models, visible, strict=True) if is_visible]
    alike = [
        f"{names[i]} and {names[j]}"
        for i, j in combinations(range(len(names)), 2)
        if not np.linalg.norm(np.cross(normals[:, i], normals[:, j]), axis=1).max()
        >= MIN_PLANE_ANGLE
    ]
    slits = np.array([model.rotation[1] for model in models])[visible]
    if np.linalg.norm(np.cross(slits, axes[2]), axis=1).max() < MIN_PLANE_ANGLE:
        cause = "the slits of all sensors are parallel"
    elif alike:
        cause = f"sensors {', '.join(alike)} see the same planes and count as one"
    else:
        cause = "the planes of all sensors nearly share a line"
    factor = 1.0 / max(float(singular[2]), 1e-12)
    bound = "without bound"
    if factor < MAX_FACTOR:
        bound = f"{factor:.0f} times as much as across one plane"
    direction = ", ".join(f"{value:.2f}" for value in axes[2] + 0.0)
    remark = (
        f"Positions along the direction ({direction}) are hardly determined: {cause}. Along it "
        f"they are uncertain {bound}; turn the row of a sensor by 30 degrees or more against "
        "the others."
    )
    return [remark]


def nonlinearity(calibration: Calibration, points_mm: Array, used: NDArray[np.bool_]) -> Array:
    """Return how far refits depart from the linear prediction of the covariance, shape (S,).

    The readings of the fitted camera are moved by two standard deviations, in both directions,
    along the combination that changes what the camera reads over the points' box most, and the
    camera is fitted again. Points near a critical surface (a quadric that contains the slit, on
    which a twisted cubic may lie) leave a curved valley; the covariance describes its bottom only.

    Args:
        calibration: the calibration of these points.
        points_mm: control points, shape (N, 3) [mm].
        used: which readings the fit used, shape (N, S).

    Returns:
        Relative difference of that change from the predicted one; infinite where a refit did not
        converge.
    """
    models = calibration.models
    centre = points_mm.mean(axis=0)
    points = points_mm - centre
    stack = CameraStack.of(models)
    stack = replace(stack, offset_mm=stack.offset_mm + stack.rotation @ centre)
    models = stack.models(models)
    sigma = np.array([fit.sigma_px for fit in calibration.sensors])
    weights = np.where(used, 1.0 / sigma, 0.0)
    prior, information = None, np.zeros((len(models), stack.width))
    if stack.has_distortion:
        strength = prior_strength(calibration)
        prior = LensPrior.of(models, [None] * len(models), points, used, strength)
        information = prior.gaussian(stack)[1]
    fitted, jacobian = stack.project_with_parameter_jacobian(points)
    volume = box_points(points.min(axis=0), points.max(axis=0), NONLINEARITY_GRID_NODES)
    expected, by_parameter = stack.project_with_parameter_jacobian(volume)
    by_parameter = np.where(np.isfinite(expected)[..., None], by_parameter, 0.0)
    steps = np.array([0.0, NONLINEARITY_SIGMA, -NONLINEARITY_SIGMA])
    moved, linear = [], []
    for column, weight in enumerate(weights.T):
        matrix = jacobian[:, column] * weight[:, None]
        matrix = np.concatenate([matrix, np.diag(np.sqrt(information[column]))])
        scale = np.linalg.norm(matrix, axis=0)
        scale = np.where(scale > 0.0, scale, np.inf)
        gain = np.linalg.pinv(matrix / scale)[:, : len(points)] / scale[:, None]
        left, singular, right = np.linalg.svd(by_parameter[:, column] @ gain, full_matrices=False)
        moved.append(fitted[:, column, None] + np.outer(right[0] * sigma[column], steps))
        linear.append(left[:, 0] * singular[0])
    index = np.repeat(np.arange(len(models)), len(steps))
    solution = minimise(
        stack.rows(index),
        points,
        np.concatenate(moved, axis=1),
        weights[:, index],
        None if prior is None else prior.rows(index),
    )
    readings = solution.cameras.project(volume).T.reshape(len(models), len(steps), -1)
    change = readings[:, 1:] - readings[:, :1]
    effect = np.array(linear)[:, None]
    difference = change - steps[1:, None] * effect
    along = np.nansum(difference * effect, axis=2) / (effect**2).sum(axis=2) / NONLINEARITY_SIGMA
    converged = np.asarray(solution.converged.reshape(len(models), len(steps)).all(axis=1))
    return np.where(converged, np.abs(along).max(axis=1), np.inf)


def _nonlinearity_remarks(calibration: Calibration, points: Array, readings: Array) -> list[str]:
    """Return of which sensors the covariance cannot be trusted."""
    values = nonlinearity(calibration, points, np.isfinite(readings))
    remarks = []
    for fit, value in zip(calibration.sensors, values.tolist(), strict=True):
        if value > MAX_NONLINEARITY:
            by = "so far that no camera settles"
            if np.isfinite(value):
                by = f"{value:.0%} otherwise than the covariance says"
            remarks.append(
                f"Sensor {fit.model.name}: its control points are near-critical: cameras that "
                "differ much fit nearly as well. Readings that change by two standard deviations "
                f"move the camera {by}; do not rely on the covariance, "
                "and add points away from the curve or surface on which these lie."
            )
    return remarks
