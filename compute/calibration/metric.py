"""The seven parameters of all sensors from readings of control points, wherever they start."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.design import check_determined
from compute.calibration.labels.projective import ProjectiveCamera
from compute.calibration.levenberg import minimise
from compute.calibration.linear import normalisation
from compute.calibration.starts import starting_cameras
from compute.camera.dlt import matrix_of, model_from_matrix
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, InvalidParameter, NoConvergence

Array = NDArray[np.float64]

SEARCH_STEPS: Final = 60


def fit_metric(
    points_mm: Array,
    readings_px: Array,
    sigma_px: Array,
    sensors: Sequence[SensorGeometry],
    near: Sequence[SensorModel] | None = None,
) -> tuple[SensorModel, ...]:
    """Minimise each sensor's squared residuals over sigma from several starts; keep the lowest.

    All starts of all sensors are searched at once in the projective form, whose numerator is
    linear; the best of each is refined in the metric form.

    Args:
        points_mm: control points, shape (N, 3).
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sigma_px: their standard deviations, shape (N, S) [px], or ones.
        sensors: their geometry.
        near: cameras that may be close, searched from besides; what they have of distortion is
            left aside.

    Raises:
        DegeneratePoints: more than one camera fits.
        NoConvergence: no start led to a minimum with all points in front of the lens.
    """
    seen = np.isfinite(readings_px)
    weights = np.where(seen, 1.0 / np.where(seen, sigma_px, 1.0), 0.0)
    models: list[SensorModel | None] = [None] * len(sensors)
    patterns: dict[bytes, list[int]] = {}
    for column in range(len(sensors)):
        patterns.setdefault(seen[:, column].tobytes(), []).append(column)
    for alike in patterns.values():
        columns = np.array(alike)
        rows = seen[:, columns[0]]
        found = _search(
            points_mm[rows],
            readings_px[np.ix_(rows, columns)],
            weights[np.ix_(rows, columns)],
            [sensors[column] for column in columns],
            None if near is None else [near[column] for column in columns],
        )
        for column, model in zip(columns, found, strict=True):
            models[column] = model
    starts = [model for model in models if model is not None]
    ended = minimise(CameraStack.of(starts), points_mm, readings_px, weights)
    fitted = ended.cameras.models(starts)
    # First whether there is one camera: a search for none does not come to rest.
    check_determined(fitted, points_mm, weights)
    for column, model in enumerate(fitted):
        if not ended.settled[column]:
            raise NoConvergence(
                f"sensor {model.name}: no camera with all its {int(seen[:, column].sum())} control "
                "points in front of it fits the readings; look for exchanged or wrong labels",
                sensor=model.name,
            )
    return fitted


def _search(
    points_mm: Array,
    readings_px: Array,
    weights: Array,
    sensors: Sequence[SensorGeometry],
    near: Sequence[SensorModel] | None,
) -> list[SensorModel]:
    """Return the best camera of each sensor; all see all the points (N, 3)."""
    transform = normalisation(points_mm)
    points = points_mm @ transform[:3, :3].T + transform[:3, 3]
    camera = ProjectiveCamera(points, 0.0, 1.0)
    middle, scale = readings_px.mean(axis=0), readings_px.std(axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    readings = ((readings_px - middle) / scale).T
    weight = (weights * scale).T
    starts = starting_cameras(camera, readings, weight)
    if near is not None:
        inverse = np.linalg.inv(transform)
        given = [
            _projective(matrix_of(replace(model, distortion=None)) @ inverse, m, s)
            for model, m, s in zip(near, middle, scale, strict=True)
        ]
        starts = np.concatenate([starts, np.array(given)[:, None]], axis=1)
    count = starts.shape[1]
    rows = np.repeat(readings, count, axis=0)
    row_weights = np.repeat(weight, count, axis=0)
    theta = camera.fit(rows, row_weights, starts.reshape(-1, 7), SEARCH_STEPS)
    squares = (((camera.project(theta) - rows) * row_weights) ** 2).sum(axis=1)
    best = np.argmin(squares.reshape(-1, count), axis=1)
    chosen = theta.reshape(-1, count, 7)[np.arange(len(sensors)), best]
    middle_mm = points_mm.mean(axis=0)
    return [
        model_of_projective(values, transform, m, s, sensor, middle_mm)
        for values, sensor, m, s in zip(chosen, sensors, middle, scale, strict=True)
    ]


def model_of_projective(
    theta: Array,
    transform: Array,
    middle_px: float,
    scale_px: float,
    sensor: SensorGeometry,
    seen_mm: Array,
) -> SensorModel:
    """Return the metric camera of (a, b, g) in a normalised frame, shape (7,).

    Raises:
        DegeneratePoints: it reads the same of all points.
    """
    second = np.array([*theta[4:], 1.0])
    matrix = np.array([scale_px * theta[:4] + middle_px * second, second]) @ transform
    try:
        return model_from_matrix(matrix, sensor, seen_mm)
    except InvalidParameter as error:
        raise DegeneratePoints(
            f"sensor {sensor.name} reads the same of all its control points, as far as a "
            f"camera can tell ({error.detail})",
            sensor=sensor.name,
        ) from None


def _projective(matrix: Array, middle_px: float, scale_px: float) -> Array:
    """Return (a, b, g) of a 2x4 matrix in the normalised frame; its points are put in front."""
    first, second = matrix / matrix[1, 3]
    theta: Array = np.concatenate([(first - middle_px * second) / scale_px, second[:3]])
    return theta
