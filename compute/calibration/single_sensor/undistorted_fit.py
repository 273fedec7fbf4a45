"""Fit of the seven metric parameters of each sensor: least squares or robust."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import Loss
from compute.calibration.single_sensor.camera_fit import (
    minimise,
)
from compute.calibration.single_sensor.design_matrix import (
    EquationGroup,
    check_determined,
)
from compute.calibration.single_sensor.lens_prior import LensPrior
from compute.calibration.single_sensor.projective_camera import (
    ProjectiveCamera,
    metric_cameras,
    metric_models,
    normalisation,
    projective_matrices,
    search_starts,
)
from compute.calibration.single_sensor.sensor_fits import (
    SIGMA_FLOOR_PX,
    ControlObservations,
    SensorFits,
    refit,
)
from compute.calibration.single_sensor.trimmed_least_squares import robust_starts
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.observation_checks import MAX_RESIDUAL_SHARE, check_explained
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, NoConvergence
from compute.robust_statistics import biweight, mad_sigma

Array = NDArray[np.float64]

CONTRADICTED_SIGMA_FACTOR: Final = 3.0
"""Residuals over the given standard deviations above which these do not explain them."""
MAX_MAJORITY_SHARE: Final = 0.05
"""Noise of the readings that a robust camera fits, relative to the standard deviation of all, below
which the others are wrong, and not all unrelated."""
MAX_WRONG_SHARE: Final = 0.25
WRONG_READING_SIGMA: Final = 10.0
MAX_REWEIGHTINGS: Final = 60
WEIGHT_TOLERANCE: Final = 1e-6
STEPS_PER_REWEIGHTING: Final = 4


def fit_undistorted(
    observed: ControlObservations, loss: Loss, initial_models: Sequence[SensorModel] | None = None
) -> SensorFits:
    """Fit the seven metric parameters of each sensor.

    Args:
        observed: control points and readings.
        loss: "linear" or "robust".
        initial_models: cameras from which the search starts too; used with a linear loss only.

    Raises:
        ImplausibleReadings, DegeneratePoints, NoConvergence: see ``fit_metric_cameras``.
    """
    if loss == "linear":
        models, groups, stack = fit_metric_cameras(
            observed.points_mm,
            observed.readings_px,
            observed.sigma_px,
            observed.sensors,
            initial_models,
            observed.sigma_known,
        )
        weights = np.ones(observed.readings_px.shape)
    else:
        models, weights = _reweight(observed, _robust_start(observed))
        # What a robust loss leaves out does not count: the median of the residuals.
        squares = (
            mad_sigma(observed.residuals_px(models), observed.observed_mask, PARAMETER_COUNT) ** 2
        )
        squares *= np.maximum(observed.observed_mask.sum(axis=0) - PARAMETER_COUNT, 0)
        unit = observed.observed_mask.astype(np.float64)
        shares, _ = _residual_shares(squares, observed.points_mm, observed.readings_px, unit)
        check_explained(shares, observed.readings_px, observed.sensors)
        used = np.where(weights > 0.0, observed.weights, 0.0)
        stack = CameraStack.of(models)
        groups = check_determined(models, observed.points_mm, used, stack=stack)
    prior = LensPrior.of(
        models, observed.pitch_um, observed.points_mm, observed.observed_mask, stack=stack
    )
    return SensorFits(models, weights, prior, groups=groups, stack=stack)


def fit_metric_cameras(
    points_mm: Array,
    readings_px: Array,
    sigma_px: Array,
    sensors: Sequence[SensorGeometry],
    initial_models: Sequence[SensorModel] | None = None,
    sigma_known: bool = False,
) -> tuple[tuple[SensorModel, ...], list[EquationGroup], CameraStack]:
    """Minimise each sensor's squared normalised residuals from several starts; keep the lowest.

    All starts of all sensors are searched at once in the projective form, whose numerator is
    linear; the best of each is refined in the metric form.

    Args:
        points_mm: control points, shape (N, 3).
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sigma_px: their standard deviations, shape (N, S) [px], or ones.
        sensors: their geometry.
        initial_models: cameras from which the search starts too, one a sensor; their distortion
            is ignored. None: no others.
        sigma_known: whether ``sigma_px`` holds standard deviations, and not ones.

    Returns:
        The S cameras, their equations, and the cameras as a stack.

    Raises:
        ImplausibleReadings: the readings have nothing to do with the points.
        DegeneratePoints: more than one camera fits.
        NoConvergence: a few readings do not fit the camera of the others, or no start led to a
            minimum with all points in front of the lens.
    """
    measured = np.isfinite(readings_px)
    weights = np.where(measured, 1.0 / np.where(measured, sigma_px, 1.0), 0.0)
    matrices, centre_mm = np.empty((len(sensors), 2, 4)), np.empty((len(sensors), 3))
    patterns: dict[bytes, list[int]] = {}
    for column in range(len(sensors)):
        patterns.setdefault(measured[:, column].tobytes(), []).append(column)
    for members in patterns.values():
        columns = np.array(members)
        rows = measured[:, columns[0]]
        points = points_mm[rows]
        matrices[columns] = search_starts(
            points,
            readings_px[np.ix_(rows, columns)],
            weights[np.ix_(rows, columns)],
            None if initial_models is None else [initial_models[column] for column in columns],
        )
        centre_mm[columns] = points.mean(axis=0)
    starts = metric_cameras(matrices, sensors, centre_mm)
    solution = minimise(starts, points_mm, readings_px, weights)
    fitted = metric_models(solution.cameras, sensors)
    shares, unbiased = _residual_shares(solution.squares, points_mm, readings_px, weights)
    if sigma_known:
        # Noise as large as that would have been stated.
        dof = np.maximum(measured.sum(axis=0) - PARAMETER_COUNT, 1)
        contradicted = solution.squares > CONTRADICTED_SIGMA_FACTOR**2 * dof
        shares = np.where(contradicted, unbiased, 0.0)
    _check_related(shares, points_mm, readings_px, sensors)
    # First whether there is one camera: a search for none does not come to rest.
    try:
        groups = check_determined(fitted, points_mm, weights, stack=solution.cameras)
    except DegeneratePoints:
        _check_related(unbiased, points_mm, readings_px, sensors)
        raise
    for column, model in enumerate(fitted):
        if not solution.converged[column]:
            _check_related(unbiased, points_mm, readings_px, sensors)
            raise NoConvergence(
                f"sensor {model.name}: no camera with all its {int(measured[:, column].sum())} "
                "control points in front of it fits the readings; look for exchanged or wrong "
                "labels",
                sensor=model.name,
            )
    return fitted, groups, solution.cameras


def _check_related(
    shares: Array, points_mm: Array, readings_px: Array, sensors: Sequence[SensorGeometry]
) -> None:
    """Check that readings are related to the points.

    Args:
        shares: of ``_residual_shares``, shape (S,).
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, S) [px]; NaN where not seen.
        sensors: the S sensors.

    Raises:
        NoConvergence: a camera fits all but a few readings of a sensor.
        ImplausibleReadings: none does.
    """
    for column in np.flatnonzero(shares > MAX_RESIDUAL_SHARE).tolist():
        rows = np.flatnonzero(np.isfinite(readings_px[:, column]))
        values = readings_px[rows, column]
        camera = ProjectiveCamera.of(points_mm[rows], values)
        theta = robust_starts(camera, values, np.ones(len(values)), 1)
        residuals = np.abs(camera.project(theta)[0] - values)
        all_rows = np.ones((len(values), 1), dtype=np.bool_)
        scale = float(mad_sigma(residuals[:, None], all_rows, PARAMETER_COUNT)[0])
        wrong = rows[residuals > max(WRONG_READING_SIGMA * scale, 1.0)] + 1
        is_majority = len(wrong) <= MAX_WRONG_SHARE * len(values)
        if scale < MAX_MAJORITY_SHARE * values.std() and is_majority:
            name = sensors[column].name
            raise NoConvergence(
                f"sensor {name}: no camera fits all its {len(values)} readings; one fits the "
                f"others to {scale:.2g} px, but not those of points "
                f"{', '.join(map(str, wrong.tolist()))}: look for exchanged or wrong labels there, "
                "or leave these readings out",
                sensor=name,
                points=tuple(wrong.tolist()),
            )
    check_explained(shares, readings_px, sensors)


def _residual_shares(
    squares: Array, points_mm: Array, readings_px: Array, weights: Array
) -> tuple[Array, Array]:
    """Return RMS residuals over the readings' standard deviation, and unbiased by dof, both (S,).

    Where no camera has all points in front of it, the residuals are those from an affine function.

    Args:
        squares: weighted sums of squared residuals, shape (S,); infinite: no camera.
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, S) [px]; any value where the weight is 0.
        weights: 1 / standard deviation, shape (N, S) [1/px]; 0: not seen.
    """
    square_weights = weights**2
    readings = np.where(weights > 0.0, readings_px, 0.0)
    count = (weights > 0.0).sum(axis=0)
    mean = (square_weights * readings).sum(axis=0) / square_weights.sum(axis=0)
    variance = (square_weights * (readings - mean) ** 2).sum(axis=0) / (count - 1)
    squares = squares.copy()
    dof = count - PARAMETER_COUNT
    for column in np.flatnonzero(~np.isfinite(squares)).tolist():
        weight = weights[:, column]
        design = np.column_stack([points_mm, np.ones(len(points_mm))]) * weight[:, None]
        basis = np.linalg.qr(design)[0]
        values = readings[:, column] * weight
        residuals = values - basis @ (basis.T @ values)
        squares[column], dof[column] = residuals @ residuals, count[column] - 4
    shares = np.sqrt(squares / (count - 1) / variance)
    unbiased = np.sqrt(np.where(dof > 0, squares, 0.0) / np.maximum(dof, 1) / variance)
    return shares, unbiased


def _reweight(
    observed: ControlObservations, starts: Sequence[SensorModel]
) -> tuple[tuple[SensorModel, ...], Array]:
    """Iteratively reweighted least squares with Tukey's biweight, until the weights settle."""
    stack = CameraStack.of(starts)
    weights = np.zeros(observed.readings_px.shape)
    for _ in range(MAX_REWEIGHTINGS):
        residuals = stack.project(observed.points_mm) - observed.readings_px
        used = observed.observed_mask & np.isfinite(residuals)
        size = np.where(used, np.abs(residuals) * observed.weights, 0.0)
        scale = mad_sigma(size, used, PARAMETER_COUNT)
        # The known noise is the lower bound of its estimate; without it, rounding is.
        scale = np.maximum(scale, 1.0 if observed.sigma_known else SIGMA_FLOOR_PX)
        new = np.where(used, biweight(size / scale), 0.0)
        change = float(np.abs(new - weights).max())
        weights = new
        problem = observed.points_mm, observed.readings_px, observed.weights * np.sqrt(weights)
        stack = minimise(stack, *problem, None, STEPS_PER_REWEIGHTING).cameras
        if change < WEIGHT_TOLERANCE:
            break
    weighted = observed.weights * np.sqrt(weights)
    models = refit(observed, stack.models(starts), None, weighted)
    return models, np.where(observed.observed_mask, weights, 1.0)


def _robust_start(observed: ControlObservations) -> tuple[SensorModel, ...]:
    """Return each sensor's camera of least trimmed squares."""
    matrices, centres = [], []
    for column, rows in enumerate(observed.observed_mask.T):
        points, readings = observed.points_mm[rows], observed.readings_px[rows, column]
        camera = ProjectiveCamera.of(points, readings)
        theta = robust_starts(camera, readings, observed.sigma_px[rows, column], 1)
        centre, scale = np.array([camera.centre_px]), np.array([camera.scale_px])
        matrices.append(projective_matrices(theta, normalisation(points), centre, scale)[0])
        centres.append(points.mean(axis=0))
    cameras = metric_cameras(np.array(matrices), observed.sensors, np.array(centres))
    return metric_models(cameras, observed.sensors)
